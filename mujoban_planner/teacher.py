"""The teacher of imitation: solver demonstrations as labelled states.

From each start the solver's plan is walked through; every state on the way becomes a sample, and all moves that begin
a shortest walk to the next push count as right. Some wrong pushes on the way are tried out, and a solver proof that no
solution is left makes a sample of a dead state. What cannot be decided within the node budget teaches nothing.

Boards are those of `mujoban_sim.bitboard`. Shapes: M starts, S samples.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mujoban_planner.play import Boards
from mujoban_planner.samples import CELLS, Samples, pack_boards, take
from mujoban_sim.bitboard import NONE, SQUARE_STEP, Bits, bit, count, shift, spread
from mujoban_sim.grid import OFFSETS_RC, Instruction
from mujoban_sim.rules import BOX_REWARD, SOLVED_REWARD
from mujoban_sim.solver_search import SOLVED, UNSOLVABLE, Workspace, make_workspace, search

DISCOUNT: Final = 0.99
"""Discount of the planner's returns, per instruction."""
_STEP_REWARD: Final = -0.01
_ALL: Final = (1 << len(Instruction)) - 1
LONGEST: Final = 400
"""States of one demonstration at most; the rest is cut."""


class Starts(NamedTuple):
    """States to demonstrate from."""

    wall: NDArray[np.uint64]
    """[M]."""
    target: NDArray[np.uint64]
    """[M]."""
    box: NDArray[np.uint64]
    """[M]."""
    agent: NDArray[np.uint8]
    """Squares, [M]."""

    def take(self, rows: NDArray[np.int64] | NDArray[np.bool_]) -> Starts:
        """Return the given rows."""
        return Starts(*(x[rows] for x in self))


def starts_of(boards: Boards) -> Starts:
    """Return the starts of levels given as arrays."""
    box = np.zeros(boards.wall.shape, np.bool_)
    level, index = np.nonzero(boards.boxes[..., 0] >= 0)
    cells = boards.boxes[level, index]
    box[level, cells[:, 0], cells[:, 1]] = True
    agent = (boards.player[:, 0] - 1) * 8 + boards.player[:, 1] - 1
    return Starts(pack_boards(boards.wall), pack_boards(boards.target), pack_boards(box), agent.astype(np.uint8))


class Teacher:
    """Solver with its memory, reused from call to call."""

    def __init__(self, max_nodes: int = 60_000, trial_nodes: int = 15_000) -> None:
        """Allow `max_nodes` states for a demonstration and `trial_nodes` to judge a wrong push."""
        self.max_nodes = max_nodes
        self.trial_nodes = trial_nodes
        self._work = make_workspace(max_nodes)

    def judge(self, starts: Starts) -> NDArray[np.int64]:
        """Return the solver's status of each state, [M]: SOLVED, UNSOLVABLE or BUDGET."""
        return _judge(starts, self.max_nodes, self._work)

    def demonstrate(
        self, starts: Starts, rng: np.random.Generator, *, trials: int = 2, keep: int = LONGEST
    ) -> tuple[Samples, NDArray[np.int64]]:
        """Return the samples of demonstrations from each start, and the solver's status of each start, [M].

        Args:
            starts: States; unsolvable ones become a dead sample each.
            rng: Chooses among equal walks and the wrong pushes.
            trials: Wrong pushes tried out per demonstration.
            keep: States kept of each demonstration, from its start.
        """
        parts, status = [], np.empty(len(starts.agent), np.int64)
        chunk = 256
        for first in range(0, len(status), chunk):
            part = starts.take(np.arange(first, min(first + chunk, len(status))))
            storage = _storage(len(part.agent) * (keep + trials + 1) + LONGEST)
            used, status[first : first + chunk] = _demonstrate(
                part, trials, keep, self.max_nodes, self.trial_nodes, self._work, rng, storage
            )
            parts.append(take(storage, np.arange(used)))
        return Samples(*(np.concatenate(columns) for columns in zip(*parts, strict=True))), status


def _storage(capacity: int) -> Samples:
    return Samples(
        np.empty(capacity, np.uint64),
        np.empty(capacity, np.uint64),
        np.empty(capacity, np.uint64),
        np.empty(capacity, np.uint8),
        np.empty(capacity, np.uint8),
        np.empty((capacity, CELLS), np.uint8),
        np.empty(capacity, np.float32),
        np.empty(capacity, np.uint8),
        np.empty(capacity, np.uint8),
        np.empty(capacity, np.bool_),
        np.empty(capacity, np.uint8),
    )


@njit(cache=True, nogil=True)
def _judge(starts: Starts, max_nodes: int, work: Workspace) -> NDArray[np.int64]:
    status = np.empty(len(starts.agent), np.int64)
    for i in range(len(status)):
        status[i], _, _, _ = search(
            ~starts.wall[i], starts.target[i], starts.box[i], np.int64(starts.agent[i]), 2.0, max_nodes, work
        )
    return status


@njit(cache=True, nogil=True)
def _demonstrate(
    starts: Starts,
    trials: int,
    keep: int,
    max_nodes: int,
    trial_nodes: int,
    work: Workspace,
    rng: np.random.Generator,
    out: Samples,
) -> tuple[int, NDArray[np.int64]]:
    """Fill `out` with samples; return how many, and the status of each start."""
    used = 0
    all_status = np.empty(len(starts.agent), np.int64)
    for i in range(len(all_status)):
        wall, target, boxes = starts.wall[i], starts.target[i], starts.box[i]
        agent = np.int64(starts.agent[i])
        status, pushes, _, _ = search(~wall, target, boxes, agent, 1.0, max_nodes, work)
        all_status[i] = status
        if status == UNSOLVABLE:
            _write_dead(out, used, wall, target, boxes, agent)
            used += 1
        if status != SOLVED or len(pushes) == 0:
            continue
        length = _walk_through(out, used, wall, target, boxes, agent, pushes, rng)
        length = min(length, keep)
        first, used = used, used + length
        for _ in range(trials):
            row = first + np.int64(rng.random() * length)
            used += _try_wrong_push(out, row, used, trial_nodes, work, rng)
    return used, all_status


@njit(cache=True, nogil=True)
def _write_dead(out: Samples, row: int, wall: Bits, target: Bits, boxes: Bits, agent: int) -> None:
    out.wall[row], out.target[row], out.box[row], out.agent[row] = wall, target, boxes, agent
    out.right[row], out.plan[row], out.push[row], out.next_push[row] = 0, 0, False, 0
    # Nothing but the cost of moving is left to gain.
    out.value[row] = _STEP_REWARD / (1.0 - DISCOUNT)
    out.dead_known[row], out.dead[row] = _ALL, _ALL


@njit(cache=True, nogil=True)
def _distances(start: int, free: Bits) -> NDArray[np.int64]:
    """Return the steps from every square to `start` over free squares, [64]; -1 for unreachable."""
    distance = np.full(CELLS, -1, np.int64)
    frontier = bit(start)
    reached = frontier
    steps = 0
    while frontier != NONE:
        for square in range(CELLS):
            if frontier & bit(square) != NONE:
                distance[square] = steps
        frontier = spread(frontier) & free & ~reached
        reached |= frontier
        steps += 1
    return distance


@njit(cache=True, nogil=True)
def _walk_through(
    out: Samples,
    first: int,
    wall: Bits,
    target: Bits,
    boxes: Bits,
    agent: int,
    pushes: NDArray[np.uint8],
    rng: np.random.Generator,
) -> int:
    """Write a sample for every state along a plan, and return how many."""
    plan = np.zeros((len(pushes), CELLS), np.uint8)
    for i in range(len(pushes) - 1, -1, -1):
        if i + 1 < len(pushes):
            plan[i] = plan[i + 1]
        plan[i, pushes[i] // 4] = pushes[i] % 4 + 1
    row = first
    for i in range(len(pushes)):
        square, direction = np.int64(pushes[i]) // 4, np.int64(pushes[i]) % 4
        free = ~wall & ~boxes
        distance = _distances(square - SQUARE_STEP[direction], free)
        while True:
            if row - first >= LONGEST:
                return row - first
            right, chosen = 0, direction
            if distance[agent] == 0:
                right = 1 << (direction + 1)
            else:
                ties = 0
                for d in range(4):
                    step = shift(bit(agent), d) & free
                    if step != NONE and distance[agent + SQUARE_STEP[d]] == distance[agent] - 1:
                        right |= 1 << (d + 1)
                        ties += 1
                        if rng.random() * ties < 1.0:
                            chosen = d
            out.wall[row], out.target[row], out.box[row], out.agent[row] = wall, target, boxes, agent
            out.right[row], out.plan[row], out.push[row] = right, plan[i], distance[agent] == 0
            out.next_push[row] = pushes[i]
            # Walking and what the demonstration does lose nothing; other pushes are unknown.
            out.dead[row] = 0
            out.dead_known[row] = _ALL & ~_pushes(wall, boxes, agent) | right
            row += 1
            arrived = distance[agent] == 0
            agent += SQUARE_STEP[chosen]
            if arrived:
                boxes = (boxes ^ bit(square)) | bit(square + SQUARE_STEP[direction])
                break
    _write_returns(out, first, row, boxes)
    return row - first


@njit(cache=True, nogil=True)
def _pushes(wall: Bits, boxes: Bits, agent: int) -> int:
    """Return the mask of instructions that push a box."""
    mask = 0
    for d in range(4):
        box = shift(bit(agent), d) & boxes
        if box != NONE and shift(box, d) & ~wall & ~boxes != NONE:
            mask |= 1 << (d + 1)
    return mask


@njit(cache=True, nogil=True)
def _write_returns(out: Samples, first: int, end: int, final: Bits) -> None:
    """Write the discounted returns of a demonstration whose last push leads to the boxes `final`."""
    value, after = 0.0, final
    for row in range(end - 1, first - 1, -1):
        target = out.target[row]
        reward = _STEP_REWARD + BOX_REWARD * (count(after & target) - count(out.box[row] & target))
        if row == end - 1 and after == target:
            reward += SOLVED_REWARD
        value = reward + DISCOUNT * value
        out.value[row] = value
        after = out.box[row]


@njit(cache=True, nogil=True)
def _try_wrong_push(
    out: Samples, row: int, end: int, trial_nodes: int, work: Workspace, rng: np.random.Generator
) -> int:
    """Judge a wrong push near sample `row`; return how many samples (0 or 1) were written at `end`."""
    for at in range(row, end):
        unknown = _ALL & ~np.int64(out.dead_known[at])
        if unknown == 0:
            continue
        direction, ties = -1, 0
        for d in range(4):
            if unknown >> (d + 1) & 1:
                ties += 1
                if rng.random() * ties < 1.0:
                    direction = d
        square = np.int64(out.agent[at]) + SQUARE_STEP[direction]
        boxes = (out.box[at] ^ bit(square)) | bit(square + SQUARE_STEP[direction])
        status, _, _, _ = search(~out.wall[at], out.target[at], boxes, square, 2.0, trial_nodes, work)
        if status == SOLVED:
            out.dead_known[at] |= 1 << (direction + 1)
        elif status == UNSOLVABLE:
            out.dead_known[at] |= 1 << (direction + 1)
            out.dead[at] |= 1 << (direction + 1)
            _write_dead(out, end, out.wall[at], out.target[at], boxes, square)
            return 1
        return 0
    return 0


def deadly_instruction(starts: Starts, instructions: NDArray[np.int64]) -> Samples:
    """Return samples that say only that an instruction leads to a dead state, one per start, [M]."""
    m = len(starts.agent)
    masks = (1 << instructions).astype(np.uint8)
    alive = np.uint8(1 << Instruction.STAY)
    nothing = np.zeros(m, np.uint8)
    return Samples(
        *starts,
        nothing,
        np.zeros((m, CELLS), np.uint8),
        np.zeros(m, np.float32),
        masks | alive,
        masks,
        np.zeros(m, np.bool_),
        nothing,
    )


assert [tuple(o) for o in OFFSETS_RC[1:]] == [(-1, 0), (0, 1), (1, 0), (0, -1)]
