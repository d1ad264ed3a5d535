"""The rules of Sokoban and the rewards of paper appendix B, on arrays.

Player and boxes are (row, column); a box at a negative row is absent, which pads a batch of levels with different
numbers of boxes. Boxes keep their order.

Shapes: B levels, K boxes, N = `grid.GRID_SIZE`.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from mujoban_core.grid import AGENT, BOX, OFFSETS_RC, TARGET, WALL, Instruction

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
def _box_at(boxes: NDArray[np.int64], row: int, col: int) -> int:
    for k in range(boxes.shape[0]):
        if boxes[k, 0] == row and boxes[k, 1] == col:
            return k
    return -1


@njit(cache=True, nogil=True)
def _all_on_target(target: NDArray[np.bool_], boxes: NDArray[np.int64]) -> bool:
    for k in range(boxes.shape[0]):  # noqa: SIM110 - numba has no all() over generators
        if boxes[k, 0] >= 0 and not target[boxes[k, 0], boxes[k, 1]]:
            return False
    return True


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
    size = wall.shape[1]
    for i in range(player.shape[0]):
        d_row, d_col = OFFSETS_RC[instruction[i], 0], OFFSETS_RC[instruction[i], 1]
        row, col = player[i, 0] + d_row, player[i, 1] + d_col
        solved[i] = _all_on_target(target[i], boxes[i])
        if (d_row == 0 and d_col == 0) or not (0 <= row < size and 0 <= col < size) or wall[i, row, col]:
            continue
        k = _box_at(boxes[i], row, col)
        if k >= 0:
            to_row, to_col = row + d_row, col + d_col
            if not (0 <= to_row < size and 0 <= to_col < size):
                continue
            if wall[i, to_row, to_col] or _box_at(boxes[i], to_row, to_col) >= 0:
                continue
            boxes[i, k, 0], boxes[i, k, 1] = to_row, to_col
            reward[i] = BOX_REWARD * (np.float32(target[i, to_row, to_col]) - np.float32(target[i, row, col]))
            was_solved = solved[i]
            solved[i] = _all_on_target(target[i], boxes[i])
            if solved[i] and not was_solved:
                reward[i] += SOLVED_REWARD
        player[i, 0], player[i, 1] = row, col
        moved[i] = True


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
    shapes = (walls.shape[:1], targets.shape, new_boxes.shape[:1], new_boxes.shape[2:], instructions.shape)
    if walls.ndim != 3 or shapes != ((batch,), walls.shape, (batch,), (2,), (batch,)):
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
