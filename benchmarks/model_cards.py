"""A model card for each weights file that ships, made from its record (Mitchell et al. 2019).

``python -m benchmarks.model_cards`` writes docs/models; ``--check`` only says which cards are not up to date.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from benchmarks.paper.runs import ALL, ROOT, load
from mujoban_core.files import write_atomically
from mujoban_core.program import read_options, run_command
from mujoban_core.text import readable

CARDS: Final = ROOT / "docs" / "models"
_WIDTH: Final = 112


@dataclass(frozen=True)
class Purpose:
    """What a record does not say: it is the same for all weights of a class."""

    title: str
    does: str
    sees: str
    limits: str
    guide: str
    """Page in docs/."""


_GRID_LIMITS: Final = "levels of up to 10 x 10 cells that look like the generator's; warehouses drawn by this renderer"

PURPOSES: Final[dict[str, Purpose]] = {
    "StateEstimator": Purpose(
        "State estimator",
        "Estimates the probability of wall, target, agent and box in each of the 10 x 10 cells (paper C.1).",
        "The camera frame and the robot's own pose, from the episode's start on. No ground truth.",
        f"Cells never in view are guesses. Made for {_GRID_LIMITS}.",
        "estimator",
    ),
    "ControlTermination": Purpose(
        "Control termination",
        "Says whether the instruction in force is completed (paper C.4).",
        "The camera frame, proprioception, the instruction and its own last answer. No pose, no ground truth.",
        "Relies on dead reckoning: a robot that slips for long, or is moved, misleads it. Knows no box that it "
        "does not see.",
        "estimator",
    ),
    "PrivilegedPolicy": Purpose(
        "Privileged teacher of the controller",
        "Drives a body to carry out instructions, as an oracle and as the teacher of a camera policy; learned from the "
        "goal task's rewards alone (paper C.3).",
        "The robot's pose and velocity, the boxes' positions, proprioception and the instruction: ground truth.",
        "Not for a robot that has only a camera. Made for the world that its record names.",
        "controller",
    ),
    "ResidualPlanner": Purpose(
        "Planner",
        "Turns an estimate of the abstract state into the next instruction (paper C.2).",
        "The estimate of the abstract state and its own decisions of the episode. No camera, no ground truth.",
        "Solves most levels, not all: what it loses ends nearly always in a state that only search proves dead. Boards "
        "of 8 x 8 inner cells; more than four boxes were not trained on.",
        "planner",
    ),
    "VisuomotorController": Purpose(
        "Controller",
        "Turns an instruction into motor torques (paper C.3).",
        "The camera frame, proprioception, the instruction and the termination signal. No pose, no ground truth.",
        "One body and the physics that it was trained in. A box that rests against pegs off its lane is lost to it.",
        "controller",
    ),
}


class CardError(ValueError):
    """A card cannot be made."""


def records() -> list[Path]:
    """Return the records of all weights that ship."""
    return sorted(ROOT.glob("mujoban_*/weights/*.json"))


def card(path: Path) -> str:
    """Return the model card for a record.

    Raises:
        CardError: If the record is of a class without a `Purpose`.
    """
    record = json.loads(path.read_text())
    purpose = PURPOSES.get(record["class"])
    if purpose is None:
        raise CardError(f"{path.relative_to(ROOT)}: no text about {record['class']}, expected one in PURPOSES")
    weights = path.with_suffix(".safetensors").relative_to(ROOT)
    parts = [
        f"# {purpose.title}: `{weights.name}`",
        "Generated from the weights' record by `python -m benchmarks.model_cards`; do not edit.",
        purpose.does,
        f"- **May see:** {purpose.sees}\n- **Limits:** {purpose.limits}\n"
        f"- **How it works and is trained:** [guide](../{purpose.guide}.md)",
        "## Weights\n\n" + _table(("what", "value"), _weights(record, weights)),
        "## Training\n\n" + _table(("what", "value"), _training(record)),
        f"The command, in which earlier weights of the same name may stand for where it began:\n\n{_command(record)}",
        "## Scores",
        *_scores(record),
        "## Configuration\n\n" + _table(("setting", "value"), _settings(record)),
    ]
    return "\n\n".join(parts) + "\n"


def _weights(record: Mapping[str, Any], weights: Path) -> list[tuple[str, str]]:
    return [
        ("file", f"`{weights}`"),
        ("class", f"`{record['class']}`"),
        ("parameters", f"{record['parameters']:,}"),
        ("digest", f"`{record['digest'][:16]}`"),
        ("license", "Apache-2.0"),
    ]


def _training(record: Mapping[str, Any]) -> list[tuple[str, str]]:
    data = record.get("data", "")
    rows = [("data", ", ".join(data) if isinstance(data, list) else str(data))]
    if record.get("bags"):
        bags = record["bags"]
        rows.append(("bags", str(bags if isinstance(bags, int) else len(bags))))
    for name in ("method", "teacher", "steps", "updates", "samples", "env_steps", "seconds", "commit", "torch"):
        if record.get(name) is not None:
            value = record[name]
            rows.append((name, f"{value:,}" if isinstance(value, int) else f"`{value}`"))
    return rows


def _command(record: Mapping[str, Any]) -> str:
    """Return the record's command as an indented block, broken before options."""
    lines = [""]
    for word in shlex.split(record["command"]):
        if word.startswith("--") and len(lines[-1]) + len(word) > _WIDTH - 24:
            lines.append("   ")
        lines[-1] = f"{lines[-1]} {shlex.quote(word)}"
    return " \\\n".join("   " + line for line in lines)


def _scores(record: Mapping[str, Any]) -> Iterator[str]:
    rows = []
    for run in ALL:
        report = load(run)
        if report and record["digest"] in report["weights"].values():
            low, high = report["success_interval"]
            rows.append((
                run.title, ", ".join(run.oracle) or "none", str(len(report["episodes"])),
                f"{100 * report['success_rate']:.1f} %", f"{100 * low:.1f} to {100 * high:.1f} %",
            ))  # fmt: skip
    if rows:
        yield "As part of the stack, on levels that no training saw ([results](../results/README.md)):"
        yield _table(("configuration", "oracles", "levels", "solved", "95 % interval"), rows)
    metrics = [(name, readable(value)) for name, value in _numbers(record.get("metrics") or {})]
    if metrics:
        yield "On its own, by its trainer's last evaluation:"
        yield _table(("metric", "value"), metrics)
    if not rows and not metrics:
        yield "Not measured yet with these weights."


def _settings(record: Mapping[str, Any]) -> list[tuple[str, str]]:
    return [(name, f"`{value}`") for name, value in _leaves({"network": record["config"], **record["training"]})]


def _numbers(tree: Mapping[str, Any]) -> Iterator[tuple[str, float]]:
    for name, value in _leaves(tree):
        if isinstance(value, int | float) and not isinstance(value, bool):
            yield name, value


def _leaves(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in tree.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{name}.")
        elif not isinstance(value, list) or len(value) <= 8:
            yield f"{prefix}{name}", value


def _table(header: tuple[str, ...], rows: list[Any]) -> str:
    lines = [header, ("---",) * len(header), *rows]
    return "\n".join("| " + " | ".join(str(cell).replace("|", r"\|") for cell in line) + " |" for line in lines)


def stale() -> list[Path]:
    """Return the cards that are missing or not what their records say, and those whose weights are gone."""
    expected = {CARDS / f"{path.stem}.md": path for path in records()}
    found = set(CARDS.glob("*.md"))
    return sorted(
        {file for file, path in expected.items() if file not in found or file.read_text() != card(path)}
        | (found - expected.keys())
    )


PROG: Final = "benchmarks.model_cards"


@dataclass(frozen=True)
class Options:
    """What to do."""

    check: bool = False
    """Only say which cards are not up to date, with status 1 if there are any."""


def main(command_line: Sequence[str] | None = None) -> int:
    """Run the command."""
    options = read_options(Options, command_line, PROG, __doc__)
    old = stale()
    if not options.check:
        CARDS.mkdir(parents=True, exist_ok=True)
        for file in old:
            file.unlink(missing_ok=True)
        for path in records():
            write_atomically(CARDS / f"{path.stem}.md", card(path).encode())
    for file in old:
        print(f"{file.relative_to(ROOT)} {'is not up to date' if options.check else 'renewed'}")
    return int(options.check and bool(old))


if __name__ == "__main__":
    run_command(PROG, main)
