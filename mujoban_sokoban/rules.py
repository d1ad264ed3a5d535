"""The rules of Sokoban and the rewards of paper appendix B, on arrays.

Player and boxes are (row, column); a box at a negative row is absent, which pads a batch of levels with different
numbers of boxes. Boxes keep their order. What may be walked and pushed is said by `bitboard`, for which the outermost
cells are wall; a box there, as an uncertain estimate may have it, counts as absent, and a player there stays. A box in
a wall does not move.

Shapes: B levels, K boxes, N = `grid.GRID_SIZE`.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from mujoban_core.grid import AGENT, BOX, GRID_SIZE, OFFSETS_RC, TARGET, WALL, Instruction
from mujoban_sokoban.bitboard import (
    NONE,
    SQUARE_STEP,
    bit,
    count,
    from_grid,
    on_board,
    pushed,
    squares_of,
    stepped,
    to_square,
)

BOX_REWARD: Final = 1.0
"""Reward of pushing a box onto a target, and penalty of pushing it off."""
SOLVED_REWARD: Final = 10.0
"""Reward on top for the push after which every box is on a target."""

_MAX_INSTRUCTION: Final = max(Instruction)


class Transition(NamedTuple):
    """What an instruction leads to; without the batch axis for a single level."""

    boxes: NDArray[np.int64]
    """(row, column), [B, K, 2]."""
    player: NDArray[np.int64]
    """(row, column), [B, 2]."""
    reward: NDArray[np.float32]
    """[B]."""
    solved: NDArray[np.bool_]
    """Whether every box is on a target, [B]."""
    moved: NDArray[np.bool_]
    """Whether the player changed its cell, [B]; false when it stays or the way is blocked."""


@njit(cache=True, nogil=True)
def _apply_in_place(
    wall: NDArray[np.bool_],
    target: NDArray[np.bool_],
    boxes: NDArray[np.int64],
    player: NDArray[np.int64],
    instruction: NDArray[np.int64],
    reward: NDArray[np.float32],
    solved: NDArray[np.bool_],
    moved: NDArray[np.bool_],
) -> None:
    for i in range(player.shape[0]):
        targets, box = from_grid(target[i]), squares_of(boxes[i])
        solved[i] = box & ~targets == NONE
        direction = np.int64(instruction[i]) - 1
        if direction < 0 or not on_board(player[i, 0], player[i, 1]):
            continue
        here, floor = to_square(player[i, 0], player[i, 1]), ~from_grid(wall[i])
        there = stepped(bit(here), floor & ~box, box & floor, direction)
        if there == NONE:
            continue
        d_row, d_col = OFFSETS_RC[direction + 1, 0], OFFSETS_RC[direction + 1, 1]
        player[i, 0] += d_row
        player[i, 1] += d_col
        moved[i] = True
        if there & box == NONE:
            continue
        for k in range(boxes.shape[1]):
            if boxes[i, k, 0] == player[i, 0] and boxes[i, k, 1] == player[i, 1]:
                boxes[i, k, 0] += d_row
                boxes[i, k, 1] += d_col
                break
        after = pushed(box, here + SQUARE_STEP[direction], direction)
        reward[i] = BOX_REWARD * np.float32(count(after & targets) - count(box & targets))
        was_solved, solved[i] = solved[i], after & ~targets == NONE
        if solved[i] and not was_solved:
            reward[i] += SOLVED_REWARD


def apply(
    wall: NDArray[np.bool_], target: NDArray[np.bool_], boxes: ArrayLike, player: ArrayLike, instruction: ArrayLike
) -> Transition:
    """Apply one instruction to each level of a batch, or to a single level.

    Args:
        wall: bool [B, N, N] or [N, N].
        target: bool like `wall`.
        boxes: (row, column), [B, K, 2] or [K, 2]; not modified.
        player: (row, column), [B, 2] or [2]; not modified.
        instruction: values of `grid.Instruction`, [B] or a scalar.

    Raises:
        ValueError: If an instruction is none of the five, or shapes do not fit each other.
    """
    single = np.ndim(player) == 1
    walls, targets = np.asarray(wall, np.bool_), np.asarray(target, np.bool_)
    new_boxes, new_player = np.array(boxes, np.int64), np.array(player, np.int64)
    instructions = np.asarray(instruction, np.int64)
    if single:
        walls, targets, new_boxes, new_player = walls[None], targets[None], new_boxes[None], new_player[None]
        instructions = instructions[None]
    batch = len(new_player)
    grids = (batch, GRID_SIZE, GRID_SIZE)
    shapes = (walls.shape, targets.shape, new_boxes.shape[:1], new_boxes.shape[2:], instructions.shape)
    if shapes != (grids, grids, (batch,), (2,), (batch,)):
        raise ValueError(
            f"wall {walls.shape}, target {targets.shape}, boxes {new_boxes.shape}, player {new_player.shape} and "
            f"instruction {instructions.shape}: expected [B, N, N], [B, N, N], [B, K, 2], [B, 2] and [B]"
        )
    if batch and not (instructions.min() >= 0 and instructions.max() <= _MAX_INSTRUCTION):
        raise ValueError(f"instruction outside 0..{_MAX_INSTRUCTION}: expected values of grid.Instruction")
    reward = np.zeros(batch, np.float32)
    solved, moved = np.zeros((2, batch), np.bool_)
    _apply_in_place(walls, targets, new_boxes, new_player, instructions, reward, solved, moved)
    result = Transition(new_boxes, new_player, reward, solved, moved)
    return Transition(*(array[0] for array in result)) if single else result


def abstract_successor(state: NDArray[np.bool_], instruction: int) -> NDArray[np.bool_]:
    """Return the abstract state to which an instruction leads from one with a single agent, [N, N, 4] each."""
    boxes, player = np.argwhere(state[..., BOX]), np.argwhere(state[..., AGENT])[0]
    after = apply(state[..., WALL], state[..., TARGET], boxes, player, int(instruction))
    successor = state.copy()
    successor[..., [AGENT, BOX]] = False
    successor[after.player[0], after.player[1], AGENT] = True
    successor[after.boxes[:, 0], after.boxes[:, 1], BOX] = True
    return successor
