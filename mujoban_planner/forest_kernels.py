"""The numba kernels behind `mujoban_planner.forest`: nodes, queues and hash tables of many trees.

Shapes: M trees, N nodes of a tree, R rows, X expanded nodes, D = 4 directions, I = 8.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mujoban_sokoban.bitboard import (
    NONE,
    ONE,
    SQUARE_STEP,
    SQUARES,
    Bits,
    Int,
    bit,
    count,
    flood,
    frozen,
    lowest,
    pushable,
    pushed,
)
from mujoban_sokoban.solver_labels import walk_distances
from mujoban_sokoban.solver_search import dead_squares, push_distances

DEAD_WEIGHT: Final = 1.0
"""Weight of log p(alive) in a node's cost."""
_DEAD: Final = -2
"""In place of a child: the push leads nowhere at sight. -1 stands for a state that no node was made for."""
_HOME: Final = -3
"""In place of a child: the push solves the level."""


class Trees(NamedTuple):
    """Memory of M searches."""

    wall: NDArray[np.uint64]
    """[M]; and so the next two."""
    target: NDArray[np.uint64]
    dead: NDArray[np.uint64]
    """Squares from which no target can be reached, [M]."""
    box: NDArray[np.uint64]
    """Boxes of each node, [M, N]."""
    agent: NDArray[np.uint8]
    """Square of the robot, [M, N]."""
    region: NDArray[np.uint8]
    """Lowest square that the robot can walk to, [M, N]."""
    cost: NDArray[np.float32]
    """[M, N]."""
    logp: NDArray[np.float32]
    """Log-probability of the pushes that lead to the node, [M, N]."""
    moves: NDArray[np.int16]
    """Moves of the way to the node, [M, N]."""
    depth: NDArray[np.int16]
    """Pushes of it, [M, N]."""
    parent: NDArray[np.int32]
    """[M, N]."""
    push: NDArray[np.uint8]
    """4 * square + direction of the push that leads here, [M, N]."""
    expanded: NDArray[np.bool_]
    """[M, N]."""
    heap: NDArray[np.int32]
    """Nodes that wait, the cheapest first, [M, N]."""
    table: NDArray[np.int32]
    """Open-addressing hash table of states, by their nodes; -1 for free, [M, power of two]."""
    nodes: NDArray[np.int64]
    """Number of nodes, [M]."""
    waiting: NDArray[np.int64]
    """Number of nodes in the heap, [M]."""
    solution: NDArray[np.int64]
    """Node in which the level is solved, -1 while there is none, [M]."""
    expansions: NDArray[np.int64]
    """Nodes that were expanded, [M]."""
    settled: NDArray[np.bool_]
    """Whether a node that `question` looks at is known to leave a solution, [M, N]."""
    branch: NDArray[np.int32]
    """Where the way from the first node to this one leaves what is settled, [M, N]."""


@njit(cache=True, nogil=True)
def region_of(wall: Bits, box: Bits, agent: Int) -> Int:
    """Return the lowest square that the robot can walk to: states that differ only within its region are alike."""
    return lowest(flood(bit(agent), ~wall & ~box))


@njit(cache=True, nogil=True)
def _place(heap: NDArray[np.int32], node: Int) -> Int:
    """Return where in a heap a node waits."""
    i = 0
    while heap[i] != node:
        i += 1
    return i


@njit(cache=True, nogil=True)
def _sift_up(heap: NDArray[np.int32], cost: NDArray[np.float32], place: Int, node: Int) -> None:
    """Put a node, for which there is room at a place of a heap, where its cost belongs, there or further up."""
    i = place
    while i > 0:
        above = (i - 1) >> 1
        if cost[heap[above]] <= cost[node]:
            break
        heap[i] = heap[above]
        i = above
    heap[i] = node


@njit(cache=True, nogil=True)
def _take_first(heap: NDArray[np.int32], cost: NDArray[np.float32], size: Int) -> Int:
    """Take the cheapest node out of a heap of `size` nodes."""
    first, node = np.int64(heap[0]), np.int64(heap[size - 1])
    size -= 1
    i = 0
    while 2 * i + 1 < size:
        child = 2 * i + 1
        if child + 1 < size and cost[heap[child + 1]] < cost[heap[child]]:
            child += 1
        if cost[node] <= cost[heap[child]]:
            break
        heap[i] = heap[child]
        i = child
    heap[i] = node
    return first


@njit(cache=True, nogil=True)
def _find(trees: Trees, row: Int, box: Bits, region: Int) -> Int:
    """Return the slot of a state in a tree's table, or the free slot where it belongs."""
    mask = np.uint64(trees.table.shape[1] - 1)
    mixed = (box ^ (np.uint64(region) * np.uint64(0xD6E8FEB86659FD93))) * np.uint64(0x9E3779B97F4A7C15)
    slot = (mixed ^ (mixed >> np.uint64(32))) & mask
    while True:
        node = trees.table[row, slot]
        if node < 0 or (trees.box[row, node] == box and trees.region[row, node] == region):
            return np.int64(slot)
        slot = (slot + ONE) & mask


@njit(cache=True, nogil=True)
def _add(trees: Trees, row: Int, slot: Int, box: Bits, agent: Int, region: Int) -> Int:
    """Add a node; the caller says how it was reached."""
    node = trees.nodes[row]
    trees.nodes[row] += 1
    trees.box[row, node], trees.agent[row, node], trees.region[row, node] = box, agent, region
    trees.expanded[row, node] = False
    trees.table[row, slot] = node
    return node


@njit(cache=True, nogil=True)
def plant(
    trees: Trees,
    rows: NDArray[np.int64],
    wall: NDArray[np.uint64],
    target: NDArray[np.uint64],
    box: NDArray[np.uint64],
    agent: NDArray[np.uint8],
) -> None:
    """Start searches from R states; see `forest.Forest.plant`."""
    for i in range(len(rows)):
        row = np.int64(rows[i])
        trees.table[row] = -1
        trees.wall[row], trees.target[row] = wall[i], target[i]
        trees.nodes[row], trees.waiting[row], trees.expansions[row], trees.solution[row] = 0, 0, 0, -1
        region = region_of(wall[i], box[i], agent[i])
        node = _add(trees, row, _find(trees, row, box[i], region), box[i], agent[i], region)
        trees.cost[row, node], trees.logp[row, node] = 0.0, 0.0
        trees.moves[row, node], trees.depth[row, node], trees.parent[row, node] = 0, 0, -1
        if box[i] == target[i]:
            trees.solution[row] = node
        elif target[i] != NONE and box[i] & wall[i] == NONE and count(box[i]) == count(target[i]):
            trees.dead[row] = dead_squares(push_distances(~wall[i], target[i]))
            trees.heap[row, 0], trees.waiting[row] = node, 1


@njit(cache=True, nogil=True)
def pop(trees: Trees, rows: NDArray[np.int64], nodes: NDArray[np.int64]) -> None:
    """Take the cheapest node out of each of R trees and write it to `nodes`, [R]."""
    for i in range(len(rows)):
        row = np.int64(rows[i])
        nodes[i] = _take_first(trees.heap[row], trees.cost[row], trees.waiting[row])
        trees.waiting[row] -= 1
        trees.expansions[row] += 1


@njit(cache=True, nogil=True)
def hopeless(box: Bits, wall: Bits, target: Bits, dead: Bits) -> bool:
    """Return whether a box stands where no target can be reached, or is frozen off the targets: a proof of no solution.

    Args:
        box: Boxes.
        wall: Walls.
        target: Targets.
        dead: Squares from which no target can be reached.
    """
    return box & dead != NONE or frozen(box, wall, dead) & ~target != NONE


@njit(cache=True, nogil=True)
def expand(
    trees: Trees,
    rows: NDArray[np.int64],
    nodes: NDArray[np.int64],
    push: NDArray[np.float32],
    alive: NDArray[np.float32],
    limit: Int,
) -> None:
    """Put what R nodes lead to into their trees; see `forest.Forest.expand`."""
    distance = np.empty(SQUARES, np.int8)
    direction_of, square_of = np.empty((2, 4 * SQUARES), np.int64)
    for i in range(len(rows)):
        row, node = np.int64(rows[i]), np.int64(nodes[i])
        wall, target, dead, box = trees.wall[row], trees.target[row], trees.dead[row], trees.box[row, node]
        trees.expanded[row, node] = True
        free = ~wall & ~box
        start = np.int64(trees.agent[row, node])
        reached = flood(bit(start), free)
        asked = trees.solution[row] >= 0
        options, largest = 0, -np.inf
        for direction in range(4):
            ready = pushable(reached, free, box, direction)
            while ready != NONE:
                square = lowest(ready)
                ready &= ready - ONE
                if not hopeless(pushed(box, square, direction), wall, target, dead):
                    direction_of[options], square_of[options] = direction, square
                    options += 1
                    largest = max(largest, push[i, direction, square])
        # The network's probabilities over what is worth a node.
        total = 0.0
        for k in range(options):
            total += np.exp(push[i, direction_of[k], square_of[k]] - largest)
        if options:
            walk_distances(start, free, distance)
        base = trees.parent[row, trees.branch[row, node]] if asked else 0
        depth, scale = trees.depth[row, node] + 1, largest + np.log(total) if options else 0.0
        for k in range(options):
            direction, square = direction_of[k], square_of[k]
            moves = trees.moves[row, node] + distance[square - SQUARE_STEP[direction]] + 1
            after = pushed(box, square, direction)
            if moves > limit or trees.nodes[row] == trees.box.shape[1]:
                continue
            region = region_of(wall, after, square)
            slot = _find(trees, row, after, region)
            seen = trees.table[row, slot]
            if asked and (after == target or (seen >= 0 and trees.settled[row, seen])):
                _settle(trees, row, node)
                break
            if after == target and trees.solution[row] >= 0:
                continue  # the first solution stands
            logp = trees.logp[row, node] + push[i, direction, square] - scale
            cost = _cost(trees, row, base, depth, logp) - DEAD_WEIGHT * alive[i]
            # What was evaluated says the same of its state by any way, and questions ask which way a node came by.
            if seen >= 0 and (asked or trees.expanded[row, seen] or trees.cost[row, seen] <= cost):
                continue
            child = seen if seen >= 0 else _add(trees, row, slot, after, square, region)
            trees.agent[row, child], trees.parent[row, child] = square, node
            trees.push[row, child], trees.moves[row, child] = 4 * square + direction, moves
            trees.depth[row, child], trees.logp[row, child], trees.cost[row, child] = depth, logp, cost
            if after == target:
                trees.solution[row] = child
                continue
            if asked:
                trees.settled[row, child], trees.branch[row, child] = False, trees.branch[row, node]
            place = trees.waiting[row] if seen < 0 else _place(trees.heap[row], child)
            _sift_up(trees.heap[row], trees.cost[row], place, child)
            trees.waiting[row] += seen < 0
        if asked:
            _forget_settled(trees, row)


@njit(cache=True, nogil=True)
def wander(
    trees: Trees, rows: NDArray[np.int64], chance: NDArray[np.float64], children: NDArray[np.int64]
) -> None:
    """Choose a push out of the first node of each of R trees; see `forest.Forest.wander`."""
    for i in range(len(rows)):
        row = np.int64(rows[i])
        total = 0.0
        for child in range(1, trees.nodes[row]):
            total += np.exp(trees.logp[row, child])
        children[i] = -1
        left = chance[i] * total
        for child in range(1, trees.nodes[row]):
            children[i] = child
            left -= np.exp(trees.logp[row, child])
            if left < 0.0:
                break


@njit(cache=True, nogil=True)
def _cost(trees: Trees, row: Int, base: Int, depth: Int, logp: float) -> float:
    """Return the cost of a node so deep and so likely in a search from node `base`, before the verdict on it counts."""
    return np.log(depth - trees.depth[row, base] + 1.0) - (logp - trees.logp[row, base])


@njit(cache=True, nogil=True)
def _settle(trees: Trees, row: Int, node: Int) -> None:
    """Note that a solution is left from a node, and so from all before it."""
    while node >= 0 and not trees.settled[row, node]:
        trees.settled[row, node] = True
        node = np.int64(trees.parent[row, node])


@njit(cache=True, nogil=True)
def _forget_settled(trees: Trees, row: Int) -> None:
    """Take the cheapest nodes out of a tree as long as the push that they are to judge is judged."""
    while trees.waiting[row] and trees.settled[row, trees.branch[row, trees.heap[row, 0]]]:
        _take_first(trees.heap[row], trees.cost[row], trees.waiting[row])
        trees.waiting[row] -= 1


@njit(cache=True, nogil=True)
def question(trees: Trees, rows: NDArray[np.int64]) -> None:
    """Let R solved trees search on from every push beside the way; see `forest.Forest.question`."""
    for i in range(len(rows)):
        row = np.int64(rows[i])
        nodes = trees.nodes[row]
        trees.settled[row, :nodes] = False
        _settle(trees, row, trees.solution[row])
        trees.waiting[row] = 0
        for node in range(1, nodes):
            if trees.settled[row, node]:
                continue
            branch = np.int64(node)
            while not trees.settled[row, trees.parent[row, branch]]:
                branch = np.int64(trees.parent[row, branch])
            trees.branch[row, node] = branch
            if not trees.expanded[row, node]:
                base, depth, logp = trees.parent[row, branch], trees.depth[row, node], trees.logp[row, node]
                trees.cost[row, node] = _cost(trees, row, base, depth, logp)
                _sift_up(trees.heap[row], trees.cost[row], trees.waiting[row], node)
                trees.waiting[row] += 1


@njit(cache=True, nogil=True)
def judge(
    trees: Trees,
    row: Int,
    node: NDArray[np.int64],
    solvable: NDArray[np.bool_],
    lost: NDArray[np.bool_],
    known: NDArray[np.uint64],
    dead: NDArray[np.uint64],
    searched: NDArray[np.bool_],
) -> None:
    """Fill `Verdicts` of the nodes that were expanded; all pushes of these, and where they lead, are found again."""
    wall, target = trees.wall[row], trees.target[row]
    source, direction_of, square_of, child_of = np.empty((4, 4 * SQUARES * len(node)), np.int64)
    edges = 0
    # Of states, by the node that stands for them in the table.
    is_live, solves = np.ones(trees.nodes[row], np.bool_), np.zeros(trees.nodes[row], np.bool_)
    state_of = np.empty(len(node), np.int64)
    for x in range(len(node)):
        at = np.int64(node[x])
        box = trees.box[row, at]
        state_of[x] = trees.table[row, _find(trees, row, box, trees.region[row, at])]
        is_live[state_of[x]] = False
        free = ~wall & ~box
        reached = flood(bit(trees.agent[row, at]), free)
        for direction in range(4):
            ready = pushable(reached, free, box, direction)
            while ready != NONE:
                square = lowest(ready)
                ready &= ready - ONE
                after = pushed(box, square, direction)
                child = _HOME if after == target else _DEAD
                if child == _DEAD and not hopeless(after, wall, target, trees.dead[row]):
                    region = region_of(wall, after, square)
                    child = np.int64(trees.table[row, _find(trees, row, after, region)])
                source[edges], direction_of[edges] = x, direction
                square_of[edges], child_of[edges] = square, child
                edges += 1
    changed = True
    while changed:
        changed = False
        for e in range(edges - 1, -1, -1):
            state, child = state_of[source[e]], child_of[e]
            if child == _DEAD:
                continue
            if not is_live[state] and (child < 0 or is_live[child]):
                is_live[state] = changed = True
            if not solves[state] and (child == _HOME or (child >= 0 and solves[child])):
                solves[state] = changed = True
    for e in range(edges):
        x, child = source[e], child_of[e]
        deadly = child == _DEAD or (child >= 0 and not is_live[child])
        if deadly or child == _HOME or (child >= 0 and solves[child]):
            known[x, direction_of[e]] |= bit(square_of[e])
        if deadly:
            dead[x, direction_of[e]] |= bit(square_of[e])
            searched[x] |= child >= 0
    for x in range(len(node)):
        solvable[x], lost[x] = solves[state_of[x]], not is_live[state_of[x]]
