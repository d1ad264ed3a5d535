"""Evaluate an agent of your own beside the stack: `python examples/evaluate_beside_the_stack.py [EPISODES]`.

Both play the same levels for validation, in one vectorised rollout, and are judged alike. From the command line:
`python bringup/evaluate.py --agent package.module:Class`, and the same without `--agent`.
"""

from __future__ import annotations

import sys

import numpy as np
from numpy.typing import NDArray

from bringup.command import Choice, Stack
from bringup.evaluate import evaluate
from bringup.results import report, summary
from mujoban_core.agent import Agent, AgentInput, AgentPolicy
from mujoban_core.interfaces import Memory
from mujoban_core.plugins import ROLES
from mujoban_sokoban.episodes import Episodes


class Wanderer(Agent):
    """Drives ahead, and turns where it no longer gets on; feels its own speed and sees nothing."""

    sees = ("proprio",)

    def initial_memory(self, batch: int) -> Memory:
        """Return the ticks that each robot still turns for, [B]."""
        return (np.zeros(batch, np.int64),)

    def step(self, inputs: AgentInput, state: Memory) -> tuple[NDArray[np.float32], Memory]:
        """Return torques, [B, 2], and how long to turn."""
        assert inputs.proprio is not None
        (turning,) = state
        stuck = (np.abs(inputs.proprio[:, 0]) < 0.02) & (turning < -20)
        turning = np.where(stuck, 15, turning - 1)
        return np.where((turning > 0)[:, None], (0.0, 0.6), (0.5, 0.0)).astype(np.float32), (turning,)


def main(episodes: int) -> None:
    """Play and print both reports."""
    levels = Episodes(episodes, 0, difficulty=1)
    oracles = Stack({role: Choice(role, "oracle") for role in ROLES})
    players = {"wanderer": AgentPolicy(Wanderer()), "stack of oracles": oracles.policy()}
    for name, policy in players.items():
        results = evaluate(policy, levels, time_limit=1200)
        print(name, *summary(report(results, {"player": name})), sep="\n  ")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 32)
