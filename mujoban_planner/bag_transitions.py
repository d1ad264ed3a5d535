"""Instruction-level transitions of recorded bags: what really happened when the stack executed an instruction.

Shapes: S transitions, N = `grid.GRID_SIZE`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mujoban_msgs_py import topics
from mujoban_msgs_py.bags.training import EpisodeTick, episode_ticks, find_bags, open_training_bag
from mujoban_planner.abstract_env import STEP_REWARD

_TOPICS = (topics.TRUE_EPISODE, topics.TRUE_ABSTRACT_STATE, topics.INSTRUCTION, topics.TERMINATION)


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
            ValueError: If a bag is damaged, lacks a topic or holds a test level, or no transition is found.
        """
        opened = [open_training_bag(bag, _TOPICS) for bag in find_bags(bags)]
        found = [row for bag in opened for row in transitions(episode_ticks(bag, _TOPICS, endings=True))]
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

    sequence: int
    state: NDArray[np.float32]
    instruction: int


Transition = tuple[NDArray[np.float32], int, float, NDArray[np.float32], bool]
"""(state, instruction, reward, next state, solved)."""


def transitions(ticks: Iterable[EpisodeTick]) -> list[Transition]:
    """Return a transition for each instruction that was completed.

    Args:
        ticks: With values (episode, true abstract state, instruction, termination), the last two None behind an
            episode's end, as `episode_ticks` yields them.
    """
    found: list[Transition] = []
    pending: _Pending | None = None
    reward = 0.0
    for episode, (_, state, instruction, termination) in ticks:
        if episode.step == 0:
            pending = None
        if pending is not None:
            reward += float(episode.reward)
            if episode.solved:
                found.append((pending.state, pending.instruction, reward + STEP_REWARD, state, True))
            elif instruction is not None and instruction.sequence != pending.sequence:
                if not termination.timed_out:
                    found.append((pending.state, pending.instruction, reward + STEP_REWARD, state, False))
                pending = None
        if pending is None and instruction is not None:
            pending, reward = _Pending(instruction.sequence, state, instruction.direction), 0.0
    return found
