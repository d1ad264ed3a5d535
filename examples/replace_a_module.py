"""Replace a module: `python examples/replace_a_module.py [EPISODES]`.

The planner here walks at random and pushes what is in its way; the one that it is compared with is the oracle. The rest
of the stack stays as it is: estimator, termination and controller are oracles as well, which are told the ground truth,
so that nothing but the planner is judged. Needs no more than Mujoban itself. Of either planner is printed how many of
the same easy levels were solved, with the interval, the mean return, and the seeds of the others by cause.

A module is one class with a batch axis and explicit memory. From the command line: `--planner package.module:Class`,
with every program; docs/swap_a_planner.md says more.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import tyro
from numpy.typing import NDArray

from bringup.command import Choice, Stack
from bringup.evaluate import evaluate
from bringup.options import whole
from bringup.results import report, summary
from mujoban_core.grid import Instruction
from mujoban_core.interfaces import Memory, Planner
from mujoban_core.plugins import ROLES
from mujoban_core.program import exit_status, read_options
from mujoban_sokoban.episodes import Episodes
from mujoban_sokoban.generator import VALIDATION_SEEDS

PROG = "replace_a_module.py"


class RandomPlanner(Planner):
    """Says north, east, south or west, whatever it is told of the map."""

    def initial_memory(self, batch: int) -> Memory:
        """Return the number of decisions so far, [B]."""
        return (np.zeros(batch, np.int64),)

    def decide(self, abstract_state: NDArray[np.float32], memory: Memory) -> tuple[NDArray[np.int64], Memory]:
        """Return an instruction for each robot, [M]."""
        (decisions,) = memory
        moves = [np.random.default_rng(n).integers(Instruction.NORTH, Instruction.WEST + 1) for n in decisions]
        return np.array(moves, np.int64), (decisions + 1,)


@dataclass(frozen=True)
class Options:
    """Play the same easy levels for validation with either planner."""

    episodes: Annotated[int, whole("EPISODES"), tyro.conf.Positional] = 32
    """Number of levels."""


def main(command_line: Sequence[str] | None = None) -> int:
    """Play and print both reports."""
    options = read_options(Options, command_line, PROG, __doc__)
    levels = Episodes(options.episodes, VALIDATION_SEEDS.start, difficulty=1)
    stack = Stack({role: Choice(role, "oracle") for role in ROLES})
    oracles = stack.policy()
    for name, policy in {"oracle": oracles, "random": replace(oracles, planner=RandomPlanner())}.items():
        results = evaluate(policy, levels, time_limit=1200)
        weights = {**stack.identities(), "planner": name}
        print(f"{name} planner", *summary(report(results, weights)), sep="\n  ")
    return 0


if __name__ == "__main__":
    sys.exit(exit_status(PROG, main))
