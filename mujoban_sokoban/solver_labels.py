"""What imitation learns from solutions: the numba kernels that walk through a solution and label its states.

Shapes: B levels, K boxes, N = `grid.GRID_SIZE`, S labelled states.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mujoban_sokoban.bitboard import (
    NONE,
    SIDE,
    SQUARE_STEP,
    SQUARES,
    Bits,
    Int,
    bit,
    from_grid,
    lowest,
    pushed,
    shift,
    spread,
    squares_of,
    to_square,
)
from mujoban_sokoban.solver_search import SOLVED, Workspace, search

ABSENT: Final = 255
"""Cell of a box that a level lacks."""
UNREACHED: Final = 127
"""Distance of a square that cannot be walked to."""


@njit(cache=True, nogil=True)
def walk_distances(goal: Int, free: Bits, distance: NDArray[np.int8]) -> None:
    """Write the walking distance of every square of `free` to a goal square, [SQUARES]; `UNREACHED` elsewhere."""
    distance[:] = UNREACHED
    frontier = bit(goal)
    reached = frontier
    steps = 0
    while frontier != NONE:
        layer = frontier
        while layer != NONE:
            distance[lowest(layer)] = steps
            layer &= layer - np.uint64(1)
        steps += 1
        frontier = spread(frontier) & free & ~reached
        reached |= frontier


@njit(cache=True, nogil=True)
def _optimal_directions(square: Int, free: Bits, distance: NDArray[np.int8]) -> Int:
    """Return the directions, as bits, that begin a shortest walk from a square."""
    mask = 0
    for direction in range(4):
        beside = shift(bit(square), direction) & free
        if beside != NONE and distance[lowest(beside)] == distance[square] - 1:
            mask |= 1 << direction
    return mask


@njit(cache=True, nogil=True)
def _choose(mask: Int, rng: np.random.Generator) -> Int:
    """Return one direction of a mask, uniformly."""
    chosen, options = -1, 0
    for direction in range(4):
        if mask >> direction & 1:
            options += 1
            if rng.random() * options < 1.0:
                chosen = direction
    return chosen


@njit(cache=True, nogil=True)
def moves_of(
    floor: Bits, boxes: Bits, player: Int, pushes: NDArray[np.uint8], rng: np.random.Generator, moves: NDArray[np.int64]
) -> None:
    """Write the instructions of a solution, walks included, to `moves` [its length]."""
    distance = np.empty(SQUARES, np.int8)
    written = 0
    for push in pushes:
        square, direction = np.int64(push) // 4, np.int64(push) % 4
        behind = square - SQUARE_STEP[direction]
        free = floor & ~boxes
        walk_distances(behind, free, distance)
        while player != behind:
            step = _choose(_optimal_directions(player, free, distance), rng)
            moves[written] = step + 1
            written += 1
            player += SQUARE_STEP[step]
        moves[written] = direction + 1
        written += 1
        boxes = pushed(boxes, square, direction)
        player = square


@njit(cache=True, nogil=True)
def count_moves(
    wall: NDArray[np.bool_],
    boxes: NDArray[np.int64],
    player: NDArray[np.int64],
    pushes: NDArray[np.uint8],
    first: NDArray[np.int64],
    moves: NDArray[np.int64],
) -> None:
    """Write the moves of B solutions, walks included; the pushes of level i go from `first[i]` to `first[i + 1]`."""
    distance = np.empty(SQUARES, np.int8)
    for i in range(len(wall)):
        floor, occupied = from_grid(~wall[i]), squares_of(boxes[i])
        at = to_square(player[i, 0], player[i, 1])
        for push in pushes[first[i] : first[i + 1]]:
            square, direction = np.int64(push) // 4, np.int64(push) % 4
            walk_distances(at, floor & ~occupied, distance)
            moves[i] += distance[square - SQUARE_STEP[direction]] + 1
            occupied = pushed(occupied, square, direction)
            at = square


@njit(cache=True, nogil=True)
def search_batch(
    wall: NDArray[np.bool_],
    target: NDArray[np.bool_],
    boxes: NDArray[np.int64],
    player: NDArray[np.int64],
    weight: float,
    max_nodes: Int,
    work: Workspace,
    status: NDArray[np.int64],
    length: NDArray[np.int64],
    nodes: NDArray[np.int64],
    first: NDArray[np.int64],
) -> NDArray[np.uint8]:
    """Solve B levels; return their pushes one after another, those of level i from `first[i]` to `first[i + 1]`."""
    pushes = np.empty(32 * len(wall) + 64, np.uint8)
    first[0] = 0
    for i in range(len(wall)):
        status[i], found, length[i], nodes[i] = search(
            from_grid(~wall[i]),
            from_grid(target[i]),
            squares_of(boxes[i]),
            to_square(player[i, 0], player[i, 1]),
            weight,
            max_nodes,
            work,
        )
        first[i + 1] = first[i] + len(found)
        while first[i + 1] > len(pushes):
            grown = np.empty(2 * len(pushes), np.uint8)
            grown[: first[i]] = pushes[: first[i]]
            pushes = grown
        pushes[first[i] : first[i + 1]] = found
    return pushes[: first[-1]]


@njit(cache=True, nogil=True)
def label_solution(
    wall: NDArray[np.bool_],
    boxes: NDArray[np.int64],
    player: NDArray[np.int64],
    pushes: NDArray[np.uint8],
    rng: np.random.Generator,
    out_player: NDArray[np.uint8],
    out_boxes: NDArray[np.uint8],
    out_optimal: NDArray[np.bool_],
    out_to_go: NDArray[np.int16],
    out_plan: NDArray[np.uint8],
) -> None:
    """Label the first S states of one solution; the outputs' first axis is S.

    Args:
        wall: [N, N].
        boxes: (row, column), [K, 2].
        player: (row, column), [2].
        pushes: the solution.
        rng: chooses among shortest walks.
        out_player: cell, row * N + column, [S].
        out_boxes: cells, [S, K]; `ABSENT` for those that the level lacks.
        out_optimal: which instructions begin a shortest walk to the next push, or are that push, [S, 5].
        out_to_go: moves from here to the solution, [S]; on entry the first holds the solution's moves.
        out_plan: instruction of the next push out of each cell, 0 for none, [S, N, N].
    """
    size, states = len(wall), len(out_player)
    floor, occupied = from_grid(~wall), squares_of(boxes)
    square_of = np.full(len(boxes), -1, np.int64)
    for k in range(len(boxes)):
        if boxes[k, 0] >= 0:
            square_of[k] = to_square(boxes[k, 0], boxes[k, 1])
    at = to_square(player[0], player[1])
    distance = np.empty(SQUARES, np.int8)
    # First state of each push's walk, to paint the plan backwards afterwards.
    begin = np.empty(len(pushes) + 1, np.int64)
    moves = np.int64(out_to_go[0])
    s = 0
    for i in range(len(pushes)):
        begin[i] = min(s, states)
        if s >= states:
            continue
        square, direction = np.int64(pushes[i]) // 4, np.int64(pushes[i]) % 4
        behind = square - SQUARE_STEP[direction]
        free = floor & ~occupied
        walk_distances(behind, free, distance)
        while s < states:
            out_player[s] = (at // SIDE + 1) * size + at % SIDE + 1
            for k in range(len(boxes)):
                box = square_of[k]
                out_boxes[s, k] = ABSENT if box < 0 else (box // SIDE + 1) * size + box % SIDE + 1
            out_to_go[s] = moves - s
            mask = 1 << direction if at == behind else _optimal_directions(at, free, distance)
            out_optimal[s, 0] = False
            for d in range(4):
                out_optimal[s, d + 1] = mask >> d & 1
            s += 1
            if at == behind:
                break
            at += SQUARE_STEP[_choose(mask, rng)]
        landing = square + SQUARE_STEP[direction]
        occupied = pushed(occupied, square, direction)
        for k in range(len(boxes)):
            if square_of[k] == square:
                square_of[k] = landing
        at = square
    begin[len(pushes)] = min(s, states)
    plan = np.zeros((size, size), np.uint8)
    for i in range(len(pushes) - 1, -1, -1):
        square = np.int64(pushes[i]) // 4
        plan[square // SIDE + 1, square % SIDE + 1] = np.int64(pushes[i]) % 4 + 1
        for s in range(begin[i], begin[i + 1]):
            out_plan[s] = plan


@njit(cache=True, nogil=True)
def label_batch(
    wall: NDArray[np.bool_],
    boxes: NDArray[np.int64],
    player: NDArray[np.int64],
    status: NDArray[np.int64],
    first_push: NDArray[np.int64],
    pushes: NDArray[np.uint8],
    first_state: NDArray[np.int64],
    rng: np.random.Generator,
    out_level: NDArray[np.int64],
    out_player: NDArray[np.uint8],
    out_boxes: NDArray[np.uint8],
    out_optimal: NDArray[np.bool_],
    out_to_go: NDArray[np.int16],
    out_plan: NDArray[np.uint8],
    length: NDArray[np.int64],
) -> None:
    """Label the states `first_state[i]` to `first_state[i + 1]` of every solved level i; see `label_solution`."""
    for i in range(len(wall)):
        a, b = first_state[i], first_state[i + 1]
        if status[i] != SOLVED or a == b:
            continue
        out_level[a:b] = i
        out_to_go[a] = length[i]
        label_solution(
            wall[i],
            boxes[i],
            player[i],
            pushes[first_push[i] : first_push[i + 1]],
            rng,
            out_player[a:b],
            out_boxes[a:b],
            out_optimal[a:b],
            out_to_go[a:b],
            out_plan[a:b],
        )
