"""How often the estimator is wrong about what it has seen: `python -m mujoban_planner.measure_errors --bags DIR`.

Counted are the states in which the running stack decided to move. `--errors` of the trainings draws errors as often.
"""

from __future__ import annotations

if __name__ == "__main__":
    from mujoban_core.early import end_at_once

    end_at_once()

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from mujoban_core.bodies import BALL, Body, get_body
from mujoban_core.files import check_file
from mujoban_core.grid import WALL, Instruction
from mujoban_core.program import read_options, run_command
from mujoban_core.reports import give_report
from mujoban_msgs_py import topics
from mujoban_msgs_py.bags import Bag, BagError
from mujoban_msgs_py.bags.training import bags_digest, episode_ticks, find_bags, open_training_bag, require_about
from mujoban_planner.bag_lessons import DECISION_TOPICS, with_issues
from mujoban_planner.estimator_errors import KINDS, ErrorCounts, Seen, look, nothing_seen

PROG = "mujoban_planner.measure_errors"

_TOPICS: Final = (*DECISION_TOPICS, topics.TRUE_POSE)


@dataclass(frozen=True)
class Options:
    """Count the cells that an estimator has seen and is wrong about."""

    bags: tuple[Path, ...]
    """Recorded bags, or folders of bags, all of one body."""
    json: Path | None = None
    """Where the rates are written."""


def count_errors(bags: Sequence[Path]) -> ErrorCounts:
    """Return how often the estimates were wrong on which the robot was told to move.

    Raises:
        BagError: If a bag is damaged, lacks a topic, is of another body than the first, or holds a level that is not
            for training.
        ValueError: If there is no such body.
    """
    counts, opened = ErrorCounts(), [open_training_bag(path, _TOPICS) for path in find_bags(bags)]
    body = get_body(opened[0].about.get("body", BALL.name))
    for bag in opened:
        require_about(bag, {"body": body.name}, "the {} of the first bag")
        for estimate, truth, seen in _decisions(bag, body):
            counts.add(estimate[None], truth[None] > 0.5, seen)
    if not counts.states:
        raise BagError(f"{', '.join(map(str, bags))}: no instruction to move, expected bags of played episodes")
    return counts


def _decisions(bag: Bag, body: Body) -> Iterator[tuple[Any, Any, Seen]]:
    """Yield estimate and truth, [N, N, 4], and what was seen in an episode so far, for each instruction to move."""
    seen = nothing_seen(1)
    for (episode, (_, truth, estimate, instruction, pose)), issued in with_issues(episode_ticks(bag, _TOPICS)):
        if episode.step == 0:
            seen = nothing_seen(1)
        at = np.asarray(pose, np.float64)[None]
        seen = look(seen, truth[None, ..., WALL] > 0.5, at, body.camera, cell_size=body.cell_size)
        if issued and instruction.direction != Instruction.STAY:
            yield estimate, truth, seen


def main(command_line: Sequence[str] | None = None) -> int:
    """Run the command line."""
    options = read_options(Options, command_line, PROG, __doc__)
    check_file("--json", options.json)
    counts = count_errors(options.bags)
    for kind, cells, wrong in zip(KINDS, counts.cells, counts.wrong, strict=True):
        found, of = int(wrong.sum()), int(cells.sum())
        print(f"{kind}: {found / counts.states:.3f} a state, {found / max(of, 1):.2%} of the cells where it can be")
    print(f"{counts.states} decisions to move, an error in {counts.share_with_errors:.1%} of them")
    if options.json is not None:
        about = {"decisions": counts.states, "with_errors": round(counts.share_with_errors, 4)}
        give_report({**about, "bags_digest": bags_digest(options.bags), **counts.rates().report}, options.json)
    return 0


if __name__ == "__main__":
    run_command(PROG, main)
