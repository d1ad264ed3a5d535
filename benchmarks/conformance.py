"""How near the world's physics comes to recorded runs of the reference: ``python -m benchmarks.conformance DIR``.

DIR holds ``runs.json``: runs of the reference environment at physics steps of 5 ms and 1 ms, with robot and boxes at
rest at the start and torques at 20 Hz. The world plays the same torques. A run conforms when robot and boxes end
within twice the difference between the reference's own two runs plus 3 cm. Where a box is off its lane or is pushed
off its middle, the outcome is compared as well: untouched, pushed or jammed, in the lane or off it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import tyro
from numpy.typing import NDArray

from mujoban_core.grid import CELL_SIZE, cell_to_xy, xy_to_cell
from mujoban_core.program import read_options, run_command
from mujoban_sim.presets import REFERENCE
from mujoban_sim.world import World
from mujoban_sokoban.episodes import EpisodeSpec
from mujoban_sokoban.levels import Level

OUTCOME_KINDS: Final = ("off_lane", "push_offset")
"""Kinds of runs whose outcome is compared."""
_SLACK: Final = 0.03
"""Metres that a run may end beyond twice the reference's own difference."""
_POSE: Final = 3
"""Leading columns of a state: x, y, psi; then x and y of each box."""
_REST: Final = 0.02
"""Metres and metres per second below which a box counts as unmoved."""
_LAST: Final = 5
"""Control steps over which the speed at the end is taken."""


PROG: Final = "benchmarks.conformance"


@dataclass(frozen=True)
class Options:
    """Compare the world's physics with recorded runs of the reference."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Holds runs.json."""
    world: str = REFERENCE.name
    """The world to judge."""
    json: bool = False
    """Print JSON instead of a table."""


@dataclass(frozen=True)
class Run:
    """A recorded run with K boxes and T control steps.

    Attributes:
        kind: what happens in it.
        level: its level.
        start: x, y [m], psi [rad], then x and y [m] of each box, [3 + 2 K].
        torque: normalised, [T, 2].
        states: as `start`, of every control step, at a physics step of 5 ms, [T + 1, 3 + 2 K].
        fine_states: the same at 1 ms.
    """

    kind: str
    level: Level
    start: NDArray[np.float64]
    torque: NDArray[np.float32]
    states: NDArray[np.float64]
    fine_states: NDArray[np.float64]

    @classmethod
    def from_json(cls, entry: dict[str, Any]) -> Run:
        """Read a run.

        Raises:
            ValueError: if its arrays do not fit together.
        """
        start = np.concatenate([entry["pose"], np.ravel(entry["boxes"])]).astype(np.float64)
        torque = np.array(entry["torque"], np.float32)
        states, fine = (np.array(entry[name], np.float64) for name in ("states", "states_1ms"))
        expected = (len(torque) + 1, len(start))
        if torque.ndim != 2 or states.shape != expected or fine.shape != expected:
            raise ValueError(f"states have shapes {states.shape} and {fine.shape}: expected {expected}")
        return cls(entry["kind"], Level.from_text(entry["level"]), start, torque, states, fine)

    @property
    def bound(self) -> NDArray[np.float64]:
        """How far from the recorded end robot and boxes may end [m], [1 + K]."""
        return 2 * distances(self.fine_states[-1], self.states[-1]) + _SLACK


def read_runs(folder: Path) -> list[Run]:
    """Return the recorded runs in a folder.

    Raises:
        OSError: if there are none.
        ValueError: if they are malformed.
    """
    path = folder / "runs.json"
    entries = json.loads(path.read_text())
    try:
        return [Run.from_json(entry) for entry in entries]
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: not a list of recorded runs: {error!r}") from error


def distances(state: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how far robot and boxes are apart in two states [3 + 2 K], in metres, [1 + K]."""
    apart = state - other
    return np.hypot(*np.concatenate([apart[:2], apart[_POSE:]]).reshape(-1, 2).T)


def outcome(run: Run, states: NDArray[np.float64]) -> str:
    """Return what became of the box: untouched, pushed or jammed; and whether it is in its lane.

    The lane is the line of cells in the direction in which the robot started.
    """
    axis = 0 if abs(math.cos(run.start[2])) > abs(math.sin(run.start[2])) else 1
    box = states[:, _POSE : _POSE + 2]
    off = abs(box[-1] - cell_to_xy(xy_to_cell(box[0])))[1 - axis]
    lane = "in lane" if off < 0.05 * CELL_SIZE else "off lane"
    if np.linalg.norm(box[-1] - box[0]) < _REST:
        return f"untouched, {lane}"
    # Control steps are a twentieth of a second.
    speed = np.linalg.norm(box[-1] - box[-1 - _LAST]) * 20 / _LAST
    jammed = speed < _REST and run.torque[-_LAST:, 0].mean() > 0
    return f"{'jammed' if jammed else 'pushed'}, {lane}"


def play(runs: Sequence[Run], world_name: str) -> list[NDArray[np.float64]]:
    """Play the torques of recorded runs in a world; return the states of each, as in `Run`."""
    max_boxes = max((len(run.start) - _POSE) // 2 for run in runs)
    world = World(len(runs), world=world_name, max_boxes=max_boxes)
    world.reset(np.arange(len(runs)), [EpisodeSpec(_unsolvable(run.level), 0) for run in runs])
    pose = np.array([run.start[:_POSE] for run in runs])
    boxes = np.zeros((len(runs), max_boxes, 2))
    for row, run in enumerate(runs):
        placed = run.start[_POSE:].reshape(-1, 2)
        boxes[row, : len(placed)] = placed
    world.place(np.arange(len(runs)), pose, boxes)
    steps = max(len(run.torque) for run in runs)
    torque = np.zeros((steps, len(runs), world.body.action_size), np.float32)
    for row, run in enumerate(runs):
        torque[: len(run.torque), row] = run.torque
    states = [np.concatenate([pose, boxes.reshape(len(runs), -1)], 1)]
    for applied in torque:
        world.step(applied)
        seen = np.concatenate([world.pose, world.box_position.reshape(len(runs), -1)], 1)
        states.append(seen.astype(np.float64))
    played = np.array(states)
    return [played[: len(run.torque) + 1, row, : len(run.start)] for row, run in enumerate(runs)]


def _unsolvable(level: Level) -> Level:
    """Return the level with its targets as far from the boxes as can be: a solved episode would stand still."""
    free = np.argwhere(~level.wall)
    nearest = np.abs(free[:, None] - level.boxes).sum(-1).min(1)
    target = np.zeros_like(level.target)
    target[tuple(free[np.argsort(-nearest, kind="stable")[: len(level.boxes)]].T)] = True
    return replace(level, target=target)


def compare(runs: Sequence[Run], played: Sequence[NDArray[np.float64]]) -> dict[str, Any]:
    """Return how many runs conform, by kind, and those that do not."""
    kinds: dict[str, dict[str, int]] = {}
    entries = []
    for number, (run, states) in enumerate(zip(runs, played, strict=True)):
        error, bound = distances(states[-1], run.states[-1]), run.bound
        conforms = bool((error <= bound).all())
        entry: dict[str, Any] = {
            "run": number,
            "kind": run.kind,
            "conforms": conforms,
            "error": error.round(4).tolist(),
            "bound": bound.round(4).tolist(),
        }
        counts = kinds.setdefault(run.kind, {"runs": 0, "conform": 0})
        counts["runs"] += 1
        counts["conform"] += conforms
        if run.kind in OUTCOME_KINDS:
            entry |= {"outcome": outcome(run, states), "expected_outcome": outcome(run, run.states)}
            same = entry["outcome"] == entry["expected_outcome"]
            counts["same_outcome"] = counts.get("same_outcome", 0) + same
        entries.append(entry)
    judged = [entry for entry in entries if "outcome" in entry]
    same_outcome = sum(entry["outcome"] == entry["expected_outcome"] for entry in judged)
    return {
        "runs": len(runs),
        "conform": sum(entry["conforms"] for entry in entries),
        "outcomes": len(judged),
        "same_outcome": same_outcome,
        "largest_share_of_bound": max(
            float(np.max(np.divide(entry["error"], entry["bound"]))) for entry in entries
        ),
        "kinds": kinds,
        "entries": entries,
    }


def table(report: dict[str, Any]) -> str:
    """Return a report as text, one line a kind."""
    lines = [f"{'kind':14}{'runs':>6}{'conform':>9}{'same outcome':>14}"]
    for kind, counts in report["kinds"].items():
        lines.append(f"{kind:14}{counts['runs']:6}{counts['conform']:9}{counts.get('same_outcome', ''):>14}")
    lines.append(f"{'all':14}{report['runs']:6}{report['conform']:9}{report['same_outcome']:14}")
    for entry in report["entries"]:
        outcomes = entry.get("outcome"), entry.get("expected_outcome")
        if not entry["conforms"] or outcomes[0] != outcomes[1]:
            what = f"run {entry['run']} ({entry['kind']}): {entry['error']} m off, bound {entry['bound']}"
            lines.append(what if outcomes[0] == outcomes[1] else f"{what}; {outcomes[0]} instead of {outcomes[1]}")
    return "\n".join(lines)


def main(command_line: Sequence[str] | None = None) -> int:
    """Run the command."""
    options = read_options(Options, command_line, PROG, __doc__)
    runs = read_runs(options.folder)
    if not runs:
        raise ValueError(f"{options.folder}/runs.json has no run: expected at least one")
    report = {"world": options.world, **compare(runs, play(runs, options.world))}
    print(json.dumps(report, indent=2) if options.json else table(report))
    return 0


if __name__ == "__main__":
    run_command(PROG, main)
