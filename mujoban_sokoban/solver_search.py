"""A* over pushes that minimises the player's moves: the numba kernels behind `mujoban_sokoban.solver`.

A search state is the set of boxes and the player's square; an edge is a walk and one push, and costs its moves. The
heuristic is the least number of pushes that brings every box to a target of its own, boxes moving freely past each
other (assignment of boxes to targets): consistent, so with weight 1 the first solution is optimal. States with a box
on a dead square, with a frozen box off target, or without an assignment are pruned; all three are proofs.

Shapes: K boxes, S = `bitboard.SQUARES`.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mujoban_sokoban.bitboard import (
    NONE,
    ONE,
    SQUARES,
    Bits,
    Int,
    bit,
    count,
    frozen,
    lowest,
    pushable,
    pushed,
    shift,
    spread,
)

SOLVED: Final = 1
UNSOLVABLE: Final = 2
BUDGET: Final = 0

MAX_ASSIGNED: Final = 8
"""Boxes up to which the heuristic is the exact assignment; beyond, every box takes its nearest target."""
_INFINITE: Final = 10_000
_PRUNED: Final = -1
_BUCKETS: Final = 1 << 14
"""Largest estimate of a solution's length that the queue can hold."""


class Workspace(NamedTuple):
    """Memory of a search; reused from level to level. M states, Q queue entries."""

    boxes: NDArray[np.uint64]
    """Boxes of each state, [M]."""
    player: NDArray[np.uint8]
    """[M]."""
    cost: NDArray[np.int16]
    """Least moves known from the start, or `_PRUNED`, [M]."""
    bound: NDArray[np.int16]
    """Heuristic, [M]."""
    parent: NDArray[np.int32]
    """[M]."""
    push: NDArray[np.uint8]
    """4 * square of the box + direction of the push that led here, [M]; square in 0..63."""
    slot: NDArray[np.int32]
    """Place in `table`, [M]."""
    table: NDArray[np.int32]
    """Open-addressing hash table of states, -1 for free, [power of two]."""
    entry_state: NDArray[np.int32]
    """[Q]."""
    entry_cost: NDArray[np.int16]
    """Cost when it was queued; an entry is stale when its state's cost has fallen since, [Q]."""
    entry_walk: NDArray[np.uint8]
    """Walking distance of the pushes that are still to be generated, [Q]."""
    entry_next: NDArray[np.int32]
    """Next entry of the same bucket, [Q]."""
    bucket: NDArray[np.int32]
    """First entry of each estimate, -1 for none, [_BUCKETS + S]; a walk may lead beyond the largest."""


def make_workspace(max_nodes: int) -> Workspace:
    """Return memory for searches of at most `max_nodes` states."""
    states, entries = max_nodes + 1, 2 * max_nodes + 2
    table_size = 1 << max(8, (2 * states - 1).bit_length())
    return Workspace(
        boxes=np.empty(states, np.uint64),
        player=np.empty(states, np.uint8),
        cost=np.empty(states, np.int16),
        bound=np.empty(states, np.int16),
        parent=np.empty(states, np.int32),
        push=np.empty(states, np.uint8),
        slot=np.empty(states, np.int32),
        table=np.full(table_size, -1, np.int32),
        entry_state=np.empty(entries, np.int32),
        entry_cost=np.empty(entries, np.int16),
        entry_walk=np.empty(entries, np.uint8),
        entry_next=np.empty(entries, np.int32),
        bucket=np.full(_BUCKETS + SQUARES, -1, np.int32),
    )


@njit(cache=True, nogil=True)
def push_distances(floor: Bits, target: Bits) -> NDArray[np.int64]:
    """Return the pushes that bring a lone box from each square to each target, [S, K]; `_INFINITE` for never."""
    k_boxes = count(target)
    distance = np.full((SQUARES, k_boxes), _INFINITE, np.int64)
    queue = np.empty(SQUARES, np.int64)
    for goal in range(k_boxes):
        square = lowest(target)
        target &= target - ONE
        distance[square, goal] = 0
        queue[0] = square
        head, tail = 0, 1
        while head < tail:
            here = queue[head]
            head += 1
            for direction in range(4):
                # A box comes here by a push in `direction`: from the square behind, the player one further behind.
                behind = shift(bit(here), (direction + 2) % 4) & floor
                if behind == NONE or shift(behind, (direction + 2) % 4) & floor == NONE:
                    continue
                square = lowest(behind)
                if distance[square, goal] == _INFINITE:
                    distance[square, goal] = distance[here, goal] + 1
                    queue[tail] = square
                    tail += 1
    return distance


@njit(cache=True, nogil=True)
def dead_squares(distance: NDArray[np.int64]) -> Bits:
    """Return the squares from which a lone box reaches no target."""
    dead = NONE
    for square in range(SQUARES):
        if distance[square].min() >= _INFINITE:
            dead |= bit(square)
    return dead


@njit(cache=True, nogil=True)
def assignment(boxes: Bits, distance: NDArray[np.int64], best: NDArray[np.int64]) -> Int:
    """Return the least pushes that assign every box a target of its own; `_INFINITE` or more if there is none.

    Args:
        boxes: K boxes.
        distance: pushes to each target, [S, K].
        best: scratch, [2^K + K] for K <= `MAX_ASSIGNED`.
    """
    k_boxes = distance.shape[1]
    if k_boxes > MAX_ASSIGNED:
        total = 0
        while boxes != NONE:
            total += distance[lowest(boxes)].min()
            boxes &= boxes - ONE
        return total
    # best[used]: the first |used| boxes assigned to the set `used` of targets.
    best[0] = 0
    squares = best[1 << k_boxes :]
    for k in range(k_boxes):
        squares[k] = lowest(boxes)
        boxes &= boxes - ONE
    for used in range(1, 1 << k_boxes):
        square = squares[count(np.uint64(used)) - 1]
        least = 2 * _INFINITE
        members = np.uint64(used)
        while members != NONE:
            goal = lowest(members)
            members &= members - ONE
            least = min(least, best[used ^ (1 << goal)] + distance[square, goal])
        best[used] = least
    return np.int64(best[(1 << k_boxes) - 1])


@njit(cache=True, nogil=True)
def _find(work: Workspace, boxes: Bits, player: Int) -> Int:
    """Return the table's slot of a state, or the free slot where it belongs."""
    mask = np.uint64(len(work.table) - 1)
    mixed = (boxes ^ (np.uint64(player) * np.uint64(0xD6E8FEB86659FD93))) * np.uint64(0x9E3779B97F4A7C15)
    slot = (mixed ^ (mixed >> np.uint64(32))) & mask
    while True:
        state = work.table[slot]
        if state < 0 or (work.boxes[state] == boxes and work.player[state] == player):
            return np.int64(slot)
        slot = (slot + ONE) & mask


@njit(cache=True, nogil=True)
def _clean(work: Workspace, states: Int, buckets: Int) -> None:
    """Empty table and queue after a search that used so many of each."""
    for state in range(states):
        work.table[work.slot[state]] = -1
    work.bucket[:buckets] = -1


@njit(cache=True, nogil=True)
def _stands(boxes: Bits, landing: Bits) -> Bits:
    """Return the squares from which a box is pushed onto a square of `landing`."""
    stands = NONE
    for direction in range(4):
        back = (direction + 2) % 4
        stands |= shift(shift(landing, back) & boxes, back)
    return stands


@njit(cache=True, nogil=True)
def _read_pushes(work: Workspace, state: Int) -> NDArray[np.uint8]:
    """Return the pushes that lead to a state, in order."""
    length, at = 0, state
    while work.parent[at] >= 0:
        length += 1
        at = work.parent[at]
    pushes = np.empty(length, np.uint8)
    at = state
    for i in range(length - 1, -1, -1):
        pushes[i] = work.push[at]
        at = work.parent[at]
    return pushes


@njit(cache=True, nogil=True)
def search(
    floor: Bits, target: Bits, boxes: Bits, player: Int, weight: float, max_nodes: Int, work: Workspace
) -> tuple[Int, NDArray[np.uint8], Int, Int]:
    """Solve a level.

    Args:
        floor: squares without wall.
        target: K squares.
        boxes: K squares.
        player: the player's square.
        weight: factor on the heuristic; 1 is optimal, more is faster.
        max_nodes: states to store at most.
        work: from `make_workspace(max_nodes)` or more.

    Returns:
        Status, pushes (4 * square + direction), the solution's moves, and states stored.
    """
    # One function: numba hands a Workspace on field by field, and split up the search ran at half the speed.
    distance = push_distances(floor, target)
    dead = dead_squares(distance)
    wall = ~floor
    scratch = np.empty((1 << min(distance.shape[1], MAX_ASSIGNED)) + distance.shape[1], np.int64)
    bound = assignment(boxes, distance, scratch)
    estimate = int(weight * bound)
    if bound >= _INFINITE or estimate >= _BUCKETS:
        return UNSOLVABLE if bound >= _INFINITE else BUDGET, np.empty(0, np.uint8), 0, 0
    max_nodes = min(max_nodes, len(work.boxes) - 1)
    slot = _find(work, boxes, player)
    work.table[slot] = 0
    work.boxes[0], work.player[0], work.slot[0] = boxes, player, slot
    work.cost[0], work.bound[0], work.parent[0] = 0, bound, -1
    work.entry_state[0], work.entry_cost[0], work.entry_next[0] = 0, 0, -1
    work.entry_walk[0], work.bucket[estimate] = 0, 0
    states, entries, last = 1, 1, estimate
    status, end = UNSOLVABLE, -1
    while status == UNSOLVABLE:
        while estimate <= last and work.bucket[estimate] < 0:
            estimate += 1
        if estimate > last:
            break
        entry = work.bucket[estimate]
        work.bucket[estimate] = work.entry_next[entry]
        state = np.int64(work.entry_state[entry])
        cost = np.int64(work.cost[state])
        if work.entry_cost[entry] != cost:
            continue
        if work.bound[state] == 0 and work.boxes[state] == target:
            status, end = SOLVED, state
            break
        here = np.uint64(work.boxes[state])
        free = floor & ~here
        landing = free & ~dead
        stands = _stands(here, landing)
        frontier = bit(np.int64(work.player[state]))
        reached = frontier
        walk, due = 0, np.int64(work.entry_walk[entry])
        base = cost + int(weight * work.bound[state])
        while frontier != NONE:
            if walk < due or frontier & stands == NONE:
                frontier = spread(frontier) & free & ~reached
                reached |= frontier
                walk += 1
                continue
            if base + walk > estimate:
                # What else the state leads to has its turn later.
                work.entry_walk[entry], work.entry_next[entry] = walk, work.bucket[base + walk]
                work.bucket[base + walk] = entry
                last = max(last, base + walk)
                break
            cost = np.int64(work.entry_cost[entry]) + walk + 1
            for direction in range(4):
                ready = pushable(frontier, landing, here, direction)
                while ready != NONE:
                    square = lowest(ready)
                    ready &= ready - ONE
                    after = pushed(here, square, direction)
                    slot = _find(work, after, square)
                    child = np.int64(work.table[slot])
                    if child < 0:
                        if states >= max_nodes:
                            status = BUDGET
                            break
                        child = states
                        states += 1
                        work.table[slot] = child
                        work.boxes[child], work.player[child], work.slot[child] = after, square, slot
                        work.cost[child] = _PRUNED
                        if frozen(after, wall, dead) & ~target != NONE:
                            continue
                        bound = assignment(after, distance, scratch)
                        if bound >= _INFINITE:
                            continue
                        work.bound[child] = bound
                    elif work.cost[child] <= cost:
                        continue
                    total = cost + int(weight * work.bound[child])
                    if total >= _BUCKETS or entries >= len(work.entry_state):
                        status = BUDGET
                        break
                    work.cost[child], work.parent[child] = cost, state
                    work.push[child] = 4 * square + direction
                    work.entry_state[entries], work.entry_cost[entries] = child, cost
                    work.entry_walk[entries], work.entry_next[entries] = 0, work.bucket[total]
                    work.bucket[total] = entries
                    entries += 1
                    estimate, last = min(estimate, total), max(last, total)
            due = walk + 1
    pushes = np.empty(0, np.uint8)
    moves = 0
    if status == SOLVED:
        pushes = _read_pushes(work, end)
        moves = np.int64(work.cost[end])
    _clean(work, states, last + 1)
    return status, pushes, moves, states
