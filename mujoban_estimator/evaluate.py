"""Evaluate state estimator and control termination on recorded bags: `python -m mujoban_estimator.evaluate --bags DIR`.

Both see what was recorded, the instructions and terminations included, whatever they would have said themselves.
"""

from __future__ import annotations

if __name__ == "__main__":
    from mujoban_core.early import end_at_once

    end_at_once()

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mujoban_core.files import check_file, digest
from mujoban_core.interfaces import INSTRUCTION_LIMIT, renew_rows
from mujoban_core.program import read_options, run_command
from mujoban_core.reports import give_report
from mujoban_core.threads import set_threads
from mujoban_estimator import SHIPPED, SHIPPED_TERMINATION, load, load_termination
from mujoban_estimator.bag_stream import TOPICS, stretches
from mujoban_estimator.data import Batch, Batcher, Stretch, choose_windows
from mujoban_estimator.encoder import FrameEncoder
from mujoban_estimator.estimator import Belief, StateEstimator, probabilities
from mujoban_estimator.metrics import MapScores, TerminationScores
from mujoban_estimator.odometry import Track
from mujoban_estimator.termination import ControlTermination
from mujoban_msgs_py.bags.training import ReadReport, bags_digest, find_bags, open_training_bag, require_about
from mujoban_rl.sealed_levels import noted_use
from mujoban_sokoban.generator import TEST_SEEDS

PROG = "mujoban_estimator.evaluate"

_LENGTH = 480
_STREAMS = 8
_CHUNK = 256
"""Frames encoded at once."""


def evaluate(
    estimator: StateEstimator,
    termination: ControlTermination,
    bags: Sequence[Path],
    *,
    max_ticks: int | None = None,
    skip_damaged: bool = False,
    report: ReadReport | None = None,
) -> dict[str, float]:
    """Return rates of both modules on the given bags, also on those of levels that are not for training.

    Args:
        estimator: on any device.
        termination: on the same.
        bags: paths of bags.
        max_ticks: stop after about so many ticks.
        skip_damaged: leave out damaged parts of bags.
        report: counts what is read.

    Raises:
        mujoban_msgs_py.bags.BagError: if a bag cannot be read or is of another body.
        ValueError: if the two modules are of different bodies.
    """
    report = ReadReport() if report is None else report
    body, other = estimator.body.name, termination.config.body
    if other != body:
        raise ValueError(f"an estimator of the body {body} and a termination of {other}: expected both of one body")
    streams = [_chain(bags[i::_STREAMS], body, report, skip_damaged) for i in range(min(_STREAMS, len(bags)))]
    score = _Scoring(estimator, termination, len(streams))
    for batch in Batcher(streams, _LENGTH, estimator.body):
        score.add(batch)
        if max_ticks is not None and report.ticks >= max_ticks:
            break
    return {**score.maps.report(), **score.ends.report(), "ticks": float(report.ticks)}


def _chain(bags: Sequence[Path], body: str, report: ReadReport, skip_damaged: bool) -> Iterator[Stretch]:
    for path in bags:
        bag = open_training_bag(path, TOPICS, skip_damaged=skip_damaged)
        require_about(bag, {"body": body}, "the {} of the weights")
        yield from stretches(bag, _LENGTH, report, allow_test_seeds=True)


class _Place(NamedTuple):
    """What control termination remembers of its way from batch to batch."""

    track: Track
    needles: tuple[Tensor, ...]


class _Scoring:
    """Runs both modules over batches and counts."""

    def __init__(self, estimator: StateEstimator, termination: ControlTermination, streams: int) -> None:
        self.maps, self.ends = MapScores(), TerminationScores()
        self._estimator, self._termination = estimator, termination
        self._belief = estimator.initial_belief(streams)
        self._place = _start_of(termination, streams)
        self._rng = np.random.default_rng(0)

    @torch.inference_mode()
    def add(self, batch: Batch) -> None:
        """Count a batch, which continues the one before."""
        streams = len(batch.valid)
        self._belief = renew_rows(self._belief, self._estimator.initial_belief(streams), batch.first)
        self._place = renew_rows(self._place, _start_of(self._termination, streams), batch.first)
        self._add_maps(batch)
        self._add_ends(batch)

    def _add_maps(self, batch: Batch) -> None:
        updates = np.arange(0, batch.valid.shape[1], self._estimator.config.update_every)
        features = _encode(self._estimator.encoder, batch.frame[:, updates], self._estimator.device)
        output = self._estimator(features, batch.pose[:, updates], self._belief)
        self._belief = Belief(*output.belief)
        valid = batch.valid[:, updates]
        self.maps.add(
            probabilities(output.logits).cpu().numpy()[valid],
            batch.abstract_state[:, updates][valid],
            batch.in_view[:, updates][valid],
            batch.seen[:, updates][valid],
        )

    def _add_ends(self, batch: Batch) -> None:
        module = self._termination
        device = module.device
        proprio, instruction, terminated = (
            torch.from_numpy(x).to(device) for x in (batch.proprio, batch.instruction, batch.terminated)
        )
        seen, shown = self._look(batch.frame, proprio)
        progress = module.progress(shown, proprio, instruction, terminated, *self._place)
        self._place = _Place(progress.track, progress.needles)
        windows = choose_windows(batch, batch.valid.size, INSTRUCTION_LIMIT + 1, self._rng)
        for start in range(0, len(windows.stream), _STREAMS):
            part = slice(start, start + _STREAMS)
            at = (windows.stream[part, None], windows.tick[part])
            recurrence = module.initial_recurrence(len(windows.stream[part]))
            output = module(seen[at], progress.features[at], proprio[at], *recurrence)
            probability = torch.sigmoid(output.logits).cpu().numpy()
            for p, completed, valid in zip(probability, batch.completed[at], windows.valid[part], strict=True):
                self.ends.add(p[valid], completed[valid], module.threshold)

    def _look(self, frames: NDArray[np.uint8], proprio: Tensor) -> tuple[Tensor, Tensor | None]:
        """Return what control termination sees in frames [B, T, ...], and what they show it, both [B, T, ...]."""
        module, size = self._termination, frames.shape[:2]
        looked, shown = [], []
        chunks, parts = (x.flatten(0, 1).split(_CHUNK) for x in (torch.from_numpy(frames), proprio))
        for chunk, felt in zip(chunks, parts, strict=True):
            image = chunk.to(module.device)
            looked.append(module.look(module.encoder(image)))
            shown.append(module.read(image, looked[-1], felt))
        told = None if module.bearings is None else torch.cat(shown).unflatten(0, size)
        return torch.cat(looked).unflatten(0, size), told


def _start_of(termination: ControlTermination, streams: int) -> _Place:
    track = termination.odometry.initial(streams, termination.device)
    return _Place(track, termination.initial_needles(streams))


def _encode(encoder: FrameEncoder, frames: NDArray[np.uint8], device: torch.device) -> Tensor:
    """Return features of frames [B, T, ...], [B, T, C, H, W]."""
    flat = torch.from_numpy(frames.reshape(-1, *frames.shape[2:]))
    features = torch.cat([encoder(chunk.to(device)) for chunk in flat.split(_CHUNK)])
    return features.unflatten(0, frames.shape[:2])


@dataclass(frozen=True)
class Options:
    """Options of the command."""

    bags: tuple[Path, ...]
    """Bags, or folders of bags."""
    estimator: Path = SHIPPED
    termination: Path = SHIPPED_TERMINATION
    max_ticks: int | None = None
    threads: int = 1
    device: str = "cpu"
    skip_damaged: bool = False
    """Leave damaged parts of bags out instead of refusing them."""
    json: Path | None = None
    """Write the report there instead of printing it."""


def main(command_line: Sequence[str] | None = None) -> int:
    """Run the command."""
    options = read_options(Options, command_line, PROG, __doc__)
    check_file("--json", options.json)
    set_threads(options.threads)
    read = ReadReport()
    rates = evaluate(
        load(options.estimator, options.device, compiled=False),
        load_termination(options.termination, options.device, compiled=False),
        find_bags(options.bags), max_ticks=options.max_ticks, skip_damaged=options.skip_damaged, report=read,
    )  # fmt: skip
    result: dict[str, Any] = {k: None if v != v else round(v, 5) for k, v in rates.items()}
    result["weights"] = {"estimator": digest(options.estimator), "termination": digest(options.termination)}
    if tested := [seed for seed in read.seeds if seed in TEST_SEEDS]:
        how = {"program": PROG, "bags_digest": bags_digest(options.bags), "max_ticks": options.max_ticks}
        result |= noted_use(tested, result["weights"], how)
    give_report(result, options.json)
    return 0


if __name__ == "__main__":
    run_command(PROG, main)
