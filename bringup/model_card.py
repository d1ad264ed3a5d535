"""A model card for weights, made from their record (Mitchell et al. 2019)."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

from mujoban_core.files import brief
from mujoban_core.text import readable

_WIDTH: Final = 112
_SPENT: Final = ("steps", "updates", "samples", "env_steps", "seconds")
"""What a record counts up to the end of its run."""
_ORIGINS: Final = ("init", "initial", "start", "teacher", "critic", "bags_digest")
"""Digests, in a record, of what weights began with and learned from."""
_STALE: Final = "†"
_NAMED_TEACHERS: Final = ("scripted driver",)
"""What a record's `teacher` may be beside a digest."""


@dataclass(frozen=True)
class Purpose:
    """What a record does not say: it is the same for all weights of a class."""

    title: str
    does: str
    sees: str
    limits: str
    beside: str
    """Rules that no training changes and that decide with the network, or what they prepare for it."""
    learned: Mapping[str, str]
    """How it learned, by what `_ways` reads in the record."""
    guide: str
    """Page in docs/."""
    own: tuple[str, ...] = ("",)
    """How the names of its metrics begin: trainers of two modules note those of both."""
    terms: str = ""
    """What names of metrics mean."""

    def how(self, record: Mapping[str, Any]) -> str:
        """Return how the weights of a record learned."""
        return "; then ".join(self.learned.get(way, f"by {way}") for way in _ways(record))


_MAP_TERMS: Final = (
    "A cell is *in view* in this frame, was *seen before* in an earlier one of the episode, or was *never seen*; "
    "*seen* are the former two. The outer wall does not count. Accuracy is the share of cells that are right, "
    "precision of what is named that is there, recall of what is there that is named. *Boxes all right* is the share "
    "of frames in which no cell is wrong about boxes, *if seen* of those frames in which every box is in view or was "
    "before. Frames are those that it takes in, one in `network.update_every` ticks."
)
_END_TERMS: Final = (
    "Precision is the share of the instructions that it ended which were completed by then; *early by over 2 ticks* "
    "the share that it ended more than 2 ticks before, or that never were. *On time* is the share of those "
    "completed, and of those ended that never were, whose end it told within 2 ticks of it; recall is of those that it "
    "did not end early."
)
_GRID_LIMITS: Final = "levels of up to 10 x 10 cells that look like the generator's; warehouses drawn by this renderer"

PURPOSES: Final[dict[str, Purpose]] = {
    "StateEstimator": Purpose(
        "State estimator",
        "Estimates the probability of wall, target, agent and box in each of the 10 x 10 cells (paper C.1).",
        "The camera frame and the robot's own pose, from the episode's start on. No ground truth.",
        f"Cells never in view are guesses. Made for {_GRID_LIMITS}.",
        "its attention starts from the camera's known geometry",
        {"": "supervised, by the ground truth in recorded bags"},
        "estimator",
        ("agent_", "wall_", "target_", "box", "ticks"),
        _MAP_TERMS,
    ),
    "ControlTermination": Purpose(
        "Control termination",
        "Says whether the instruction in force is completed (paper C.4).",
        "The camera frame, proprioception, the instruction and its own last answer. No pose, no ground truth.",
        "Relies on dead reckoning: a robot that slips for long, or is moved, misleads it. Knows no box that it "
        "does not see.",
        "an instruction ends after 120 ticks at the latest; dead reckoning and the instruction's frame feed it, and, "
        "where no heading is felt, filters of the heading and of the place in a cell that it reads from frames",
        {"": "supervised, by the rule of completion in recorded bags"},
        "estimator",
        ("termination_", "ticks"),
        _END_TERMS,
    ),
    "PrivilegedPolicy": Purpose(
        "Privileged teacher of the controller",
        "Drives a body to carry out instructions, as an oracle and as the teacher of a camera policy; learned from the "
        "goal task's shaped rewards, without demonstrations (paper C.3).",
        "The robot's pose and velocity, the boxes' positions, proprioception and the instruction: ground truth.",
        "Not for a robot that has only a camera. Made for the world that its record names.",
        "none",
        {
            "teacher": "by reward, from no demonstration, in the goal task, whose reward is shaped and whose "
            "instructions come from an optimal solver in a share of the episodes (`task.planned` below)"
        },
        "controller",
    ),
    "ResidualPlanner": Purpose(
        "Planner",
        "Turns an estimate of the abstract state into the next instruction (paper C.2).",
        "The estimate of the abstract state and its own decisions of the episode. No camera, no ground truth.",
        "Solves most levels, not all: an estimate that is wrong misleads it, and without the search ahead it also "
        "pushes, on a right one, into states from which there is no way to the end. Boards of 8 x 8 inner cells; more "
        "than four boxes were not trained on.",
        "(1) what was tried loses attraction; (2) verdicts on pushes are moved to the safe side and weighed, by "
        "constants; (3) before a push that may be deadly it looks at the board from every side; (4) a fixed "
        "recursion by the rules of Sokoban tells what can be reached and the way to a push; (5) a tree search by "
        "these rules, guided by the network, looks ahead for a way to the end (`--look-ahead 0`: none); (6) a rule "
        "says where to look before each decision, for up to 30 instructions an episode after the first look",
        {
            "imitation": "supervised, by an optimal solver, also on its own play",
            "expert-iteration": "by its own play and search, without a solver",
            "mpo": "by reward, over moves, by MPO",
            "mpo over pushes": "by reward, over pushes, by MPO",
            "ppo over pushes": "by reward, over pushes, by PPO",
        },
        "planner",
    ),
    "Explorer": Purpose(
        "Scout",
        "Says where to look before pushing.",
        "The estimate of the abstract state and the cells that have been in view. No camera, no ground truth.",
        f"Trained in a grid model of what a camera sees behind walls. Made for {_GRID_LIMITS}.",
        "it is asked before each decision, for up to 30 instructions an episode after the first look; a fixed "
        "recursion tells what a turn at each place would show, and the way there",
        {"mpo, reward for cells that come into view": "by reward, for cells seen for the first time, by MPO"},
        "estimator",
    ),
    "VisuomotorController": Purpose(
        "Controller",
        "Turns an instruction into motor torques (paper C.3).",
        "The camera frame, proprioception, the instruction and the termination signal. No pose, no ground truth.",
        "One body and the physics that it was trained in. A box that rests against pegs off its lane is lost to it.",
        "turns on the spot while the robot looks around, where one action does it; angles and dead reckoning feed it, "
        "and filters of what it reads from frames: of the heading, where none is felt, and of the place in a cell",
        {
            "scripted driver": "supervised, by a scripted driver that knows the truth, on its own play",
            "distil": "supervised, by a teacher that knows the truth, on its own play",
            "mpo": "by reward, with a critic that knows the truth",
            "mpo, nothing gained": "by reward, with a critic that knows the truth, which solved no more levels: the "
            "weights from before were kept",
        },
        "controller",
    ),
}
for _network in ("ThinkingPlanner", "RecurrentPlanner"):
    PURPOSES[_network] = PURPOSES["ResidualPlanner"]


class CardError(ValueError):
    """A card cannot be made."""


class Score(NamedTuple):
    """What the stack solved with the weights in it."""

    configuration: str
    oracles: str
    levels: int
    success_rate: float
    interval: tuple[float, float]
    """Of 95 %."""
    stale: bool = False
    """Whether what played beside the weights had others than it has now."""


class Place(NamedTuple):
    """Where a card stands, and what is said there."""

    made_by: str
    """The command that writes it."""
    docs: str | None
    """Path from the card to the folder docs/, if it is in the same repository."""
    levels: str
    """Which levels the scores are of."""


def card(path: Path, file: str, place: Place, scores: Sequence[Score] = ()) -> str:
    """Return the model card for a record.

    Args:
        path: The record.
        file: The weights, as the card names them.
        place: Of the card.
        scores: What is known of the weights beside their record.

    Raises:
        CardError: If the record is of a class without a `Purpose`.
    """
    record = json.loads(path.read_text())
    purpose = PURPOSES.get(record["class"])
    if purpose is None:
        raise CardError(f"{path}: no text about {record['class']}, expected one in PURPOSES")
    parts = [
        f"# {purpose.title}: `{Path(file).name}`",
        f"Generated from the weights' record by `{place.made_by}`; do not edit.",
        purpose.does,
        f"- **May see:** {purpose.sees}\n- **Limits:** {purpose.limits}\n"
        f"- **Learned:** {purpose.how(record)}.\n- **Rules beside it:** {purpose.beside}.\n"
        f"- **How it works and is trained:** {_guide(purpose.guide, place.docs)}",
        "## Weights\n\n" + _table(("what", "value"), _weights(record, file)),
        "## Training\n\n" + _table(("what", "value"), _training(record)),
        "The command, with the options of the commit above, which may have other names today; earlier weights of the "
        f"same name may stand for where it began:\n\n{_command(record)}",
        "## Scores",
        *_scores(record, purpose, place, scores),
        "## Configuration\n\n" + _table(("setting", "value"), _settings(record)),
    ]
    return "\n\n".join(parts) + "\n"


def _ways(record: Mapping[str, Any]) -> list[str]:
    """Return what a record says of how its weights learned: a teacher that is no network, methods or the stage."""
    if record.get("teacher") in _NAMED_TEACHERS:
        return [record["teacher"]]
    stage = record.get("training", {}).get("stage")
    if stage == "mpo" and record.get("initial"):
        return ["distil", "mpo, nothing gained" if record.get("evaluation") == 0 else "mpo"]
    return str(record.get("method") or stage or "").split(" then ")


def _guide(page: str, docs: str | None) -> str:
    return f"docs/{page}.md" if docs is None else f"[guide]({docs}{page}.md)"


def _weights(record: Mapping[str, Any], weights: str) -> list[tuple[str, str]]:
    return [
        ("file", f"`{weights}`"),
        ("class", f"`{record['class']}`"),
        ("parameters", f"{record['parameters']:,}"),
        ("digest", f"`{brief(record['digest'])}`"),
        ("license", "Apache-2.0"),
    ]


def _training(record: Mapping[str, Any]) -> list[tuple[str, str]]:
    data = record.get("data", "")
    rows = [("data", ", ".join(data) if isinstance(data, list) else str(data))]
    if record.get("world"):
        rows.append(("world", f"`{record['world']}`"))
    if record.get("bags"):
        bags = record["bags"]
        rows.append(("bags", str(bags if isinstance(bags, int) else len(bags))))
    rows += [(name, _told(record[name])) for name in _ORIGINS if record.get(name)]
    # The best of a run's evaluations is kept, and what it had taken by then is not noted.
    whole = " of the whole run" if record.get("validation") else ""
    for name in ("method", "steps", "updates", "samples", "env_steps", "seconds", "commit", "torch"):
        if record.get(name) is not None:
            value = record[name]
            of = whole if name in _SPENT else ""
            rows.append((name + of, f"{value:,}" if isinstance(value, int) else f"`{value}`"))
    if whole and record.get("evaluation") is not None:
        begun = record.get("initial") or record.get("start") or record.get("training", {}).get("init")
        nothing = ": what it began with, as training made it no better" if begun and record["evaluation"] == 0 else ""
        rows.append(("kept", f"what the run had at its evaluation {record['evaluation']}, counted from 0{nothing}"))
    return rows


def _told(origin: str | Mapping[str, str]) -> str:
    """Return the digest of an origin, or those of several by name, as a cell."""
    if isinstance(origin, str):
        return f"`{origin if origin in _NAMED_TEACHERS else brief(origin)}`"
    return ", ".join(f"{name} {_told(digest)}" for name, digest in origin.items())


def _command(record: Mapping[str, Any]) -> str:
    """Return the record's command as an indented block, broken before options."""
    lines = [""]
    for word in shlex.split(record["command"]):
        if word.startswith("--") and len(lines[-1]) + len(word) > _WIDTH - 24:
            lines.append("   ")
        lines[-1] = f"{lines[-1]} {shlex.quote(word)}"
    return " \\\n".join("   " + line for line in lines)


def _scores(record: Mapping[str, Any], purpose: Purpose, place: Place, scores: Sequence[Score]) -> Iterator[str]:
    if scores:
        yield f"As part of the stack, on {place.levels}:"
        yield _table(("configuration", "oracles", "levels", "solved", "95 % interval"), [_cells(s) for s in scores])
        if any(score.stale for score in scores):
            yield (
                f"{_STALE} Measured with these weights, but with others than ship now beside them; it may come to "
                "something else today."
            )
    kept = record.get("validation")
    numbers = _numbers(kept or record.get("metrics") or {})
    metrics = [(name, readable(value)) for name, value in numbers if name.startswith(purpose.own)]
    if metrics:
        which = "the evaluation for which it was kept" if kept else "its trainer's last evaluation"
        yield f"On its own, by {which}:"
        yield _table(("metric", "value"), metrics)
        if purpose.terms:
            yield purpose.terms
    if not scores and not metrics:
        yield "Not measured yet with these weights."


def _cells(score: Score) -> tuple[str, ...]:
    low, high = (100 * bound for bound in score.interval)
    solved = f"{100 * score.success_rate:.1f} %"
    configuration = f"{score.configuration} {_STALE}" if score.stale else score.configuration
    return configuration, score.oracles, str(score.levels), solved, f"{low:.1f} to {high:.1f} %"


def _settings(record: Mapping[str, Any]) -> list[tuple[str, str]]:
    # The network is that of the weights, whatever options say that did not apply.
    options = {name: value for name, value in record["training"].items() if name != "network"}
    return [(name, f"`{value}`") for name, value in _leaves({"network": record["config"], **options})]


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
