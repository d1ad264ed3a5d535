"""Shorter ways: the pushes of a way in the order in which the robot walks least.

A way moves each box along a path of its own. In which order the boxes take the steps of their paths is free as far as
they are not in each other's way, and a search that was led to its pushes one by one walks to and fro between boxes. The
order of the fewest moves is found exactly, by Dijkstra's algorithm over how far each box has come: (n_1 + 1) * ... *
(n_K + 1) states for K boxes of n_k pushes, some hundreds, a tenth of a millisecond. The boxes' paths stay as they are.

Boards are those of `mujoban_sokoban.bitboard`. Shapes: T pushes, K boxes.
"""

from __future__ import annotations

from heapq import heappop, heappush
from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mujoban_sokoban.bitboard import NONE, SQUARE_STEP, SQUARES, Bits, Int, bit, count, lowest
from mujoban_sokoban.solver_labels import UNREACHED, walk_distances

MOST_STATES: Final = 1 << 17
"""States up to which a shorter order is sought."""
_FAR: Final = 1 << 30


def shorten(wall: Bits, box: Bits, agent: Int, pushes: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a way's pushes in the order of the fewest moves, or without those after which all is as at its end.

    Args:
        wall: Of the state that the way begins in; and so the next two.
        box: Boxes.
        agent: Square of the robot.
        pushes: The way, 4 * square + direction of each box that is pushed, [T]; the robot can walk to each in turn.
    """
    if len(pushes) < 2:
        return pushes
    ordered = np.empty_like(pushes)
    length = _shorten(np.uint64(~np.uint64(wall)), np.uint64(box), int(agent), pushes, ordered)
    return ordered[:length] if length else pushes


@njit(cache=True, nogil=True)
def _shorten(floor: Bits, box: Bits, agent: Int, pushes: NDArray[np.uint8], ordered: NDArray[np.uint8]) -> Int:
    """Write the pushes of the shortest order to `ordered`, [T], and return their number; 0 where it was not sought."""
    boxes = count(box)
    path, step = np.zeros((2, boxes, len(pushes) + 1), np.int64)
    length = np.zeros(boxes, np.int64)
    _follow(box, pushes, path, step, length)
    stride = np.ones(boxes + 1, np.int64)
    for k in range(boxes):
        stride[k + 1] = stride[k] * (length[k] + 1)
    if stride[boxes] > MOST_STATES:
        return 0
    before = np.full(stride[boxes] * (boxes + 1), -1, np.int64)
    at = _search(floor, agent, path, step, length, stride, before)
    return _collect(at, path, step, length, stride, before, ordered)


@njit(cache=True, nogil=True)
def _follow(
    box: Bits, pushes: NDArray[np.uint8], path: NDArray[np.int64], step: NDArray[np.int64], length: NDArray[np.int64]
) -> None:
    """Write each box's squares, [K, T + 1], the directions in which it leaves them, and its number of pushes, [K]."""
    for k in range(len(length)):
        path[k, 0] = lowest(box)
        box &= box - np.uint64(1)
    for push in pushes:
        square, direction = np.int64(push) // 4, np.int64(push) % 4
        k = 0
        while path[k, length[k]] != square:
            k += 1
        step[k, length[k]] = direction
        length[k] += 1
        path[k, length[k]] = square + SQUARE_STEP[direction]


@njit(cache=True, nogil=True)
def _boxes(come: Int, path: NDArray[np.int64], length: NDArray[np.int64], stride: NDArray[np.int64]) -> Bits:
    """Return where the boxes stand when they have come so far."""
    boxes = NONE
    for k in range(len(length)):
        boxes |= bit(path[k, come // stride[k] % (length[k] + 1)])
    return boxes


@njit(cache=True, nogil=True)
def _search(
    floor: Bits,
    agent: Int,
    path: NDArray[np.int64],
    step: NDArray[np.int64],
    length: NDArray[np.int64],
    stride: NDArray[np.int64],
    before: NDArray[np.int64],
) -> Int:
    """Return the state in which the boxes are first where they come to in the end, and write those before it.

    A state says how far each box has come, and which was pushed last, for the robot stands behind it; K at the start:
    (K + 1) * come + last.
    """
    boxes = len(length)
    end = _boxes(stride[boxes] - 1, path, length, stride)
    least = np.full(len(before), _FAR, np.int64)
    least[boxes] = 0
    distance = np.empty(SQUARES, np.int8)
    waiting: list[tuple[Int, Int]] = [(0, boxes)]
    while waiting:
        moves, state = heappop(waiting)
        if moves > least[state]:
            continue
        come, last = state // (boxes + 1), state % (boxes + 1)
        box = _boxes(come, path, length, stride)
        if box == end:
            return state
        free = floor & ~box
        if last < boxes:
            agent = path[last, come // stride[last] % (length[last] + 1) - 1]
        walk_distances(agent, free, distance)
        for k in range(boxes):
            n = come // stride[k] % (length[k] + 1)
            if n == length[k] or free & bit(path[k, n + 1]) == NONE:
                continue
            walk = distance[path[k, n] - SQUARE_STEP[step[k, n]]]
            following = (come + stride[k]) * (boxes + 1) + k
            total = moves + np.int64(walk) + 1
            if walk < UNREACHED and total < least[following]:
                least[following], before[following] = total, state
                heappush(waiting, (total, following))
    return -1


@njit(cache=True, nogil=True)
def _collect(
    state: Int,
    path: NDArray[np.int64],
    step: NDArray[np.int64],
    length: NDArray[np.int64],
    stride: NDArray[np.int64],
    before: NDArray[np.int64],
    ordered: NDArray[np.uint8],
) -> Int:
    """Write the pushes that lead to a state to `ordered` and return their number; 0 if there is no such state."""
    boxes, pushes = len(length), 0
    if state < 0:
        return 0
    while before[state] >= 0:
        come, k = state // (boxes + 1), state % (boxes + 1)
        n = come // stride[k] % (length[k] + 1) - 1
        ordered[pushes] = 4 * path[k, n] + step[k, n]
        pushes += 1
        state = before[state]
    ordered[:pushes] = ordered[:pushes][::-1].copy()
    return pushes
