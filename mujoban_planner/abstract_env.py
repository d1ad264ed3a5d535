"""Thousands of Sokoban levels at once in torch, on CPU or GPU: the time-abstracted task of paper C.2.

What may be walked and pushed is what `mujoban_sokoban.bitboard` says, rewards are those of `mujoban_sokoban.rules`:
property tests hold it to both on random levels and instructions. They stand here once more because they must run on a
GPU, for all levels in a few tensor operations, where numba's bitboards cannot go. An instruction may fail, as with a
real controller: the state then stays as it is and the abstract episode ends early.

Shapes: B levels, N = `grid.GRID_SIZE`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import torch
from torch import Tensor

from mujoban_core.grid import GRID_SIZE, OFFSETS_RC, Instruction
from mujoban_planner.teacher import STEP_REWARD
from mujoban_rl.engine import State
from mujoban_sokoban.levels import Level
from mujoban_sokoban.rules import BOX_REWARD, SOLVED_REWARD

MOVE_LIMIT: Final = 120
"""Instructions of an abstract episode."""
_CELLS: Final = GRID_SIZE * GRID_SIZE
_CHANGING: Final = ("wall", "target", "box", "agent", "moves")


class AbstractStep(NamedTuple):
    """Outcome of an instruction, [B] each."""

    reward: Tensor
    """Environment reward during the instruction, plus `STEP_REWARD`; float32."""
    solved: Tensor
    """Whether the level is solved: the episode terminated; bool."""
    truncated: Tensor
    """Whether the episode ended otherwise: move limit or failed instruction; bool."""
    failed: Tensor
    """Whether the instruction did not complete; its experience is to be dropped (paper C.2); bool."""


class AbstractEnvironment:
    """A batch of levels under the abstract rules.

    Observation: abstract states, float32 [B, N, N, 4], binary. Action: instructions, int64 [B] in 0..4.
    Reward: +1 / -1 for a box pushed onto / off a target, +10 when solved, -0.01 per instruction.
    Episode end: `solved` (terminated); move limit or failed instruction (truncated). Ended episodes stay as they
    are until `reset`.
    """

    def __init__(
        self,
        batch: int,
        *,
        device: torch.device | str = "cpu",
        move_limit: int = MOVE_LIMIT,
        failure_rate: float = 0.0,
        generator: torch.Generator | None = None,
    ) -> None:
        """Make room for `batch` levels; `reset` fills them.

        Args:
            batch: B.
            device: Where the state lives.
            move_limit: Instructions until an episode is truncated.
            failure_rate: Probability that an instruction other than STAY fails.
            generator: Source of the failures, on `device`; needed when `failure_rate` > 0.

        Raises:
            ValueError: If the failure rate is not a probability or lacks a generator.
        """
        if not 0.0 <= failure_rate <= 1.0 or (failure_rate > 0.0 and generator is None):
            raise ValueError(f"failure_rate {failure_rate}: expected a probability, with a generator when above 0")
        self.batch = batch
        self.device = torch.device(device)
        self.move_limit = move_limit
        self.failure_rate = failure_rate
        self._generator = generator
        # Boards are flat; row-major as everywhere. Shape [B, N * N]
        self.wall = torch.ones(batch, _CELLS, dtype=torch.bool, device=self.device)
        self.target = torch.zeros_like(self.wall)
        self.box = torch.zeros_like(self.wall)
        self.agent = torch.zeros(batch, dtype=torch.int64, device=self.device)
        self.moves = torch.zeros_like(self.agent)
        offsets = OFFSETS_RC[:, 0] * GRID_SIZE + OFFSETS_RC[:, 1]
        self._offset = torch.from_numpy(offsets).to(self.device)
        self._rows = torch.arange(batch, device=self.device)

    def reset(self, rows: Tensor, levels: Sequence[Level]) -> None:
        """Start `levels` in the given rows, int64 [M].

        Raises:
            ValueError: If the numbers of rows and levels differ.
        """
        if len(rows) != len(levels):
            raise ValueError(f"{len(rows)} rows for {len(levels)} levels: expected as many")
        if not levels:
            return
        states = torch.from_numpy(np.stack([level.abstract_state() for level in levels]))
        self.reset_to(rows, states)

    def reset_to(self, rows: Tensor, states: Tensor) -> None:
        """Start from binary abstract states, [M, N, N, 4], in the given rows, int64 [M]."""
        flat = states.to(self.device).flatten(1, 2) > 0.5
        wall, target, agent, box = flat.unbind(-1)
        rows = rows.to(self.device)
        self.wall[rows], self.target[rows], self.box[rows] = wall, target, box
        self.agent[rows] = agent.to(torch.uint8).argmax(1)
        self.moves[rows] = 0

    def observe(self) -> Tensor:
        """Return the abstract states, float32 [B, N, N, 4]."""
        agent = torch.zeros_like(self.wall)
        agent[self._rows, self.agent] = True
        layers = torch.stack([self.wall, self.target, agent, self.box], -1)
        return layers.to(torch.float32).view(self.batch, GRID_SIZE, GRID_SIZE, -1)

    @property
    def solved(self) -> Tensor:
        """Whether every box is on a target, bool [B]."""
        return ~(self.box & ~self.target).any(1)

    def step(self, instruction: Tensor) -> AbstractStep:
        """Execute an instruction in every level, int64 [B].

        Raises:
            ValueError: If the instructions have another shape or are none of the five.
        """
        known = (instruction >= 0) & (instruction < len(Instruction))
        if instruction.shape != (self.batch,) or not bool(known.all()):
            raise ValueError(f"instruction of shape {tuple(instruction.shape)}: expected [{self.batch}] of 0..4")
        rows = self._rows
        over = self.solved | (self.moves >= self.move_limit)
        failed = self._failures(instruction) & ~over
        offset = torch.where(over | failed, 0, self._offset[instruction])
        # Walls surround every level, so that one step stays on the board; two steps from there are clipped.
        ahead = (self.agent + offset).clamp(0, _CELLS - 1)
        beyond = (ahead + offset).clamp(0, _CELLS - 1)
        pushed = self.box[rows, ahead] & (offset != 0)
        blocked = self.wall[rows, ahead] | (pushed & (self.wall[rows, beyond] | self.box[rows, beyond]))
        push = pushed & ~blocked
        gain = self.target[rows, beyond].float() - self.target[rows, ahead].float()
        self.box[rows, ahead] &= ~push
        self.box[rows, beyond] |= push
        self.agent = torch.where(blocked, self.agent, ahead)
        self.moves += (~over).long()
        solved = self.solved
        reward = torch.where(push, BOX_REWARD * gain, 0.0) + SOLVED_REWARD * (solved & ~over).float()
        reward = torch.where(over, 0.0, reward + STEP_REWARD)
        truncated = (failed | (self.moves >= self.move_limit)) & ~solved
        return AbstractStep(reward, solved, truncated, failed)

    def state(self) -> State:
        """Return all that changes."""
        tensors = {name: getattr(self, name) for name in _CHANGING}
        if self._generator is not None:
            tensors["generator"] = self._generator.get_state()
        return State(tensors=tensors)

    def restore(self, state: State) -> None:
        """Take over what `state` of an environment of as many levels returned."""
        for name in _CHANGING:
            setattr(self, name, state.tensors[name].to(self.device))
        if self._generator is not None:
            self._generator.set_state(state.tensors["generator"])

    def _failures(self, instruction: Tensor) -> Tensor:
        if self.failure_rate == 0.0:
            return torch.zeros_like(instruction, dtype=torch.bool)
        draw = torch.rand(self.batch, generator=self._generator, device=self.device)
        return (draw < self.failure_rate) & (instruction != Instruction.STAY)
