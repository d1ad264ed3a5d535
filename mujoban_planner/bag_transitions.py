"""Instruction-level transitions of recorded bags: what really happened when the stack executed an instruction.

Shapes: S transitions, N = `grid.GRID_SIZE`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mujoban_estimator.bag_stream import find_bags
from mujoban_msgs_py import topics
from mujoban_msgs_py.bags import open_bag
from mujoban_planner.abstract_env import STEP_REWARD

_TOPICS = (topics.EPISODE, topics.TRUE_ABSTRACT_STATE, topics.INSTRUCTION, topics.TERMINATION)


class BagTransitions(NamedTuple):
    """Completed instructions; those that failed are dropped (paper C.2)."""

    state: Tensor
    """Abstract state when the instruction was issued, float32 [S, N, N, 4]."""
    instruction: Tensor
    """int64 [S]."""
    reward: Tensor
    """Environment reward during the instruction, plus `STEP_REWARD`, float32 [S]."""
    next_state: Tensor
    """Abstract state when the next one was issued, float32 [S, N, N, 4]."""
    terminated: Tensor
    """Whether the level was solved, bool [S]."""

    @classmethod
    def read(cls, bags: Sequence[Path], device: torch.device | str = "cpu") -> BagTransitions:
        """Read the transitions of bags, or of folders of bags.

        Raises:
            ValueError: If a bag is damaged, lacks a topic, or no transition is found.
        """
        found = [row for bag in find_bags(bags) for row in transitions(open_bag(bag).ticks(_TOPICS))]
        if not found:
            raise ValueError(f"{', '.join(map(str, bags))}: no completed instruction, expected bags of played episodes")
        states, instructions, rewards, successors, terminated = zip(*found, strict=True)
        return cls(
            torch.from_numpy(np.stack(states)).to(device),
            torch.tensor(instructions, device=device),
            torch.tensor(rewards, dtype=torch.float32, device=device),
            torch.from_numpy(np.stack(successors)).to(device),
            torch.tensor(terminated, device=device),
        )

    def sample(self, n: int, generator: torch.Generator) -> BagTransitions:
        """Return `n` random transitions, with replacement."""
        rows = torch.randint(0, len(self.instruction), (n,), generator=generator).to(self.instruction.device)
        return BagTransitions._make(x[rows] for x in self)


class _Pending(NamedTuple):
    """The instruction in force."""

    episode: int
    sequence: int
    state: NDArray[np.float32]
    instruction: int


def transitions(ticks: Iterable[Any]) -> list[tuple[NDArray[np.float32], int, float, NDArray[np.float32], bool]]:
    """Return (state, instruction, reward, next state, solved) of each instruction that was completed.

    Args:
        ticks: Each with values (episode, true abstract state, instruction, termination), as `Bag.ticks` yields them.
    """
    found = []
    pending: _Pending | None = None
    reward = 0.0
    for tick in ticks:
        episode, state, instruction, termination = tick.values
        if pending is not None and episode.episode != pending.episode:
            pending = None
        if pending is not None:
            reward += float(episode.reward)
            solved = bool(episode.solved)
            issued = instruction.sequence != pending.sequence
            if (issued or solved) and not termination.timed_out:
                found.append((pending.state, pending.instruction, reward + STEP_REWARD, state, solved))
            if issued or solved or episode.truncated:
                pending = None
        if pending is None and not (episode.solved or episode.truncated):
            pending = _Pending(episode.episode, instruction.sequence, state, instruction.direction)
            reward = 0.0
    return found
