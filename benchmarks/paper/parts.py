"""Runs an evaluation in parts, some at the same time, so that it can be ended and gone on with."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from benchmarks.paper.runs import ROOT, SEED, TRAINED, Options, Run, is_stale
from bringup.results import EpisodeResult, Failure, report
from mujoban_core.files import digest
from mujoban_core.reports import noted_uses, write_report

PARTS: Final = ROOT / "runs" / "paper"
"""Where parts lie until their evaluation is whole."""
_POLL: Final = 1.0


@dataclass(frozen=True)
class Part:
    """Some of the levels of an evaluation."""

    run: Run
    first: int
    episodes: int

    @property
    def file(self) -> Path:
        """Where the part's JSON lies."""
        return PARTS / self.run.name / f"{SEED + self.first}_{self.episodes}.json"

    def load(self) -> dict[str, Any] | None:
        """Return the part's report, or None if it has not been measured as a whole with the weights that ship now.

        An evaluation that is interrupted reports what it has.
        """
        try:
            content = json.loads(self.file.read_text())
        except (OSError, json.JSONDecodeError):
            return None
        return None if len(content["episodes"]) != self.episodes or is_stale(content, self.run) else content

    def forget(self) -> None:
        """Have it measured anew; that its levels were used stays noted."""
        if uses := noted_uses(self.file):
            write_report({"episodes": [], "test_uses": uses}, self.file)

    def note_trained(self) -> None:
        """Note which weights an agent that is given by its name has loaded by itself, if it is one that does."""
        if self.run.trained is not None:
            content = json.loads(self.file.read_text())
            write_report({**content, TRAINED: digest(self.run.trained)}, self.file)

    def start(self) -> subprocess.Popen[bytes]:
        """Measure it in a process of its own."""
        command = [sys.executable, "bringup/evaluate.py", *self.run.options(), "--seed", str(SEED + self.first)]
        command += ["--episodes", str(self.episodes), "--json", str(self.file)]
        if "--graph" not in command:
            command += ["--first-number", str(self.first + 1)]
        self.file.parent.mkdir(parents=True, exist_ok=True)
        with self.file.with_suffix(".log").open("wb") as log:
            return subprocess.Popen(command, cwd=ROOT, stderr=log, env={**os.environ, "OMP_NUM_THREADS": "1"})


def evaluate(run: Run, options: Options) -> None:
    """Measure what is missing of an evaluation and write its JSON.

    Raises:
        ValueError: If a part fails.
    """
    parts = [
        Part(run, first, min(options.part, options.episodes - first))
        for first in range(0, options.episodes, options.part)
    ]
    if options.again:
        for part in parts:
            part.forget()
    waiting = [part for part in parts if part.load() is None]
    running: list[tuple[Part, subprocess.Popen[bytes]]] = []
    start = time.monotonic()
    _tell(run, parts, options.episodes, start, len(waiting))
    try:
        while waiting or running:
            while waiting and len(running) < options.processes:
                part = waiting.pop(0)
                running.append((part, part.start()))
            time.sleep(_POLL)
            ended = [(part, process) for part, process in running if process.poll() is not None]
            running = [pair for pair in running if pair not in ended]
            # What has ended well is noted before one that failed is complained of.
            for part, process in sorted(ended, key=lambda pair: pair[1].returncode != 0):
                if process.returncode != 0:
                    raise ValueError(f"{run.name}: evaluate.py ended with status {process.returncode}; see "
                                     f"{part.file.with_suffix('.log')}")  # fmt: skip
                part.note_trained()
                _tell(run, parts, options.episodes, start, len(waiting) + len(running))
    finally:
        for _, process in running:
            process.terminate()
            process.wait()
    write_report(_join(parts), run.file)


def _join(parts: list[Part]) -> dict[str, Any]:
    """Return the report of all parts together.

    Raises:
        ValueError: If they were not measured with the same weights, or otherwise not alike.
    """
    reports = [content for part in parts if (content := part.load()) is not None]
    weights = {json.dumps(content["weights"], sort_keys=True) for content in reports}
    if len(reports) < len(parts) or len(weights) != 1:
        raise ValueError(f"{parts[0].run.name}: the weights changed while it ran; the same command goes on")
    episodes = [_episode(entry) for content in reports for entry in content["episodes"]]
    joined = report(episodes, json.loads(weights.pop()), **_common(parts[0].run, reports))
    # Also of parts of another size, or of other weights, that were measured before.
    uses = [use for file in sorted((PARTS / parts[0].run.name).glob("*.json")) for use in noted_uses(file)]
    return {**joined, "test_uses": uses} if uses else joined


def _common(run: Run, reports: list[dict[str, Any]]) -> dict[str, Any]:
    """Return what all parts say of how they were played; those that an earlier version measured may say less.

    Raises:
        ValueError: If they were played otherwise than each other.
    """
    shared = ("body", "world", "played", TRAINED)
    said = [{key: content[key] for key in shared if key in content} for content in reports]
    for entry in said:
        if "played" in entry:
            entry["played"] = {**entry["played"], "seed": SEED}  # of the first part
    common = {key: value for key, value in said[0].items() if all(key in entry for entry in said)}
    if any(entry[key] != value for entry in said for key, value in common.items()):
        raise ValueError(f"{run.name}: its parts were played differently; --again measures them anew")
    return common


def _episode(entry: dict[str, Any]) -> EpisodeResult:
    fields = dict(entry)
    failure = fields.pop("failure")
    return EpisodeResult(
        episode_return=fields.pop("return"), failure=None if failure is None else Failure(failure), **fields
    )


def _tell(run: Run, parts: list[Part], total: int, start: float, left: int) -> None:
    """Print how far it is: levels, success so far, and how long the rest may take."""
    measured = [content for part in parts if (content := part.load()) is not None]
    episodes = [entry for content in measured for entry in content["episodes"]]
    solved = sum(entry["solved"] for entry in episodes)
    text = f"{run.name}: {len(episodes)} of {total} levels"
    if episodes:
        text += f", solved {solved} ({100 * solved / len(episodes):.1f} %)"
    print(f"{text}, {left} of {len(parts)} parts left after {(time.monotonic() - start) / 60:.0f} min", flush=True)
