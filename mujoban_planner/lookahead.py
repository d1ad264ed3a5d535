"""A planner that looks ahead: tree search guided by a learned planner, which it falls back on.

Where no time passes it searches at once. On a robot it searches while the robot walks and waits: so many evaluations in
every tick, or as many as fit into so much of it, so that an instruction is always there in time. A search is about the
boxes and where the robot can walk to, so that it goes on while the robot walks; before a push, which cannot be taken
back, the robot waits for its end.

A memory without its searches, as a process keeps it for the one that comes after it (`resume_file`), does them again.

Shapes: M robots, N = `grid.GRID_SIZE`, T moves.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray

from mujoban_core.grid import BOX, TARGET, WALL, Instruction
from mujoban_core.interfaces import Memory, Planner, put_rows, take_rows
from mujoban_planner.abstract_env import MOVE_LIMIT, AbstractEnvironment
from mujoban_planner.boards import BitBoards, likeliest_boards, state_tensor
from mujoban_planner.decision import PushMeans, VisitCounts, VisitMemory, count_visits, recall, remember, state_keys
from mujoban_planner.deliberation import CERTAINTY, MOST_EVALUATIONS
from mujoban_planner.planner import LearnedPlanner, check_abstract_state, split_memory
from mujoban_planner.search import LoneSearch, advance, boards_at
from mujoban_planner.teacher import possible_pushes
from mujoban_sokoban.bitboard import NONE, SQUARE_STEP, Bits, Int, bit, pushed

_LIKELIER: Final = 0.5
"""Probability above which a wall or a box is taken for one, whatever certainty is asked for."""
_NO_KEY: Final = -1
_PLAN: Final = 5
"""Arrays of the memory that are about the plan."""


class SearchMemory(NamedTuple):
    """What M robots remember of their searches."""

    search: NDArray[Any]
    """`LoneSearch`, which goes on, or None, [M]."""
    start: NDArray[np.uint64]
    """State from which it searches (`LoneSearch.origin`), [M, 4]."""
    spent: NDArray[np.int64]
    """Evaluations so far, [M]. So many from the start are the same search."""


_OWN: Final = _PLAN + len(SearchMemory._fields)
"""Arrays of the memory before those of the planner alone."""


class LookAheadPlanner(Planner):
    """Searches when it has no plan for the state that it finds, follows the plan while the world does.

    A plan is thrown away when the boxes or the robot are not where it expects them, when the targets change, when what
    the rest of it needs is no longer certain (boxes, targets, neither wall nor box on the way, and that no box with its
    target is still to be found), or when a planned move keeps failing. Where the search finds nothing, or what it found
    is not certain, the learned planner decides alone.
    """

    def __init__(
        self,
        planner: LearnedPlanner,
        expansions: int = 400,
        *,
        per_tick: int | None = None,
        certainty: float = CERTAINTY,
        deadline: float = 0.0,
    ) -> None:
        """Look ahead by at most `expansions` evaluations of `planner` per search.

        Args:
            planner: Guide, and what decides where there is no plan.
            expansions: Evaluations of a search.
            per_tick: Evaluations in a tick; None for as many as a search takes, before the next decision.
            certainty: Probability with which all must be as it seems that a plan rests on.
            deadline: Seconds of a tick after which no further evaluation begins, in the place of `per_tick`; 0 for
                none. How much is searched then depends on the machine.

        Raises:
            ValueError: If a number is out of its range.
        """
        super().__init__()
        in_range = 1 <= expansions <= MOST_EVALUATIONS and (per_tick is None or per_tick >= 1) and deadline >= 0.0
        if not in_range or not 0.0 <= certainty <= 1.0:
            raise ValueError(
                f"look-ahead of {expansions} evaluations, {per_tick} in a tick or {deadline} s of it, certainty "
                f"{certainty}: expected 1 to {MOST_EVALUATIONS}, 1 at least, 0 at least, and a probability"
            )
        self.planner, self.expansions, self.per_tick, self.certainty = planner, expansions, per_tick, certainty
        self.deadline = deadline
        self.privileged = planner.privileged
        self.thinks = per_tick is not None
        self._patience = 0 if per_tick is None else -(-expansions // per_tick)  # decisions that a search may take
        self.evaluations = 0
        """Network evaluations by searches so far."""

    def initial_memory(self, batch: int) -> Memory:
        """Return the memory at the start of `batch` episodes.

        It holds the plan, its cursor, the state that it continues from, the targets that it leads to, how often the
        robot has waited since its last push, `SearchMemory`, and the planner's memory.
        """
        plan = np.zeros((batch, MOVE_LIMIT + 1), np.int64)
        expected = np.zeros(batch, np.int64), np.full(batch, _NO_KEY, np.int64), np.zeros(batch, np.uint64)
        waits = np.zeros(batch, np.int64)
        start = np.zeros((batch, len(BitBoards._fields)), np.uint64)
        searches = SearchMemory(np.full(batch, None, object), start, np.zeros(batch, np.int64))
        return (plan, *expected, waits, *searches, *self.planner.initial_memory(batch))

    def think(self, abstract_state: NDArray[np.float32], memory: Memory) -> Memory:
        """Go on with the searches."""
        del abstract_state  # what they are about is seen at the next decision
        searches = self._revived(memory)
        self._advance(searches.search)
        return (*memory[:_PLAN], *_noted(searches), *memory[_OWN:])

    def decide(self, abstract_state: NDArray[np.float32], memory: Memory) -> tuple[NDArray[np.int64], Memory]:
        """Return an instruction for each state, [M] from [M, N, N, 4], and the next memory; errors as the planner's."""
        check_abstract_state(abstract_state)
        plan, cursor, expected, target, waits = (np.array(x) for x in memory[:_PLAN])
        searches = self._revived(memory)
        visits, means = split_memory(memory[_OWN:])
        boards, every = likeliest_boards(abstract_state), np.arange(len(plan))
        here = state_keys(state_tensor(boards).numpy())  # without what cannot be, such as in walls
        holds = (here == expected) & (plan[every, cursor] != 0) & (boards.target == target)
        for row in np.flatnonzero(holds).tolist():
            rest = plan[row, cursor[row] :]
            holds[row] = self._is_certain(abstract_state[row], boards, row, rest[rest != 0])
        plan[~holds], cursor[~holds] = 0, 0
        lost = np.flatnonzero(~holds)
        self._search(boards, lost, searches)
        for row in lost.tolist():
            found = searches.search[row].solution(int(boards.agent[row]))
            if 0 < len(found) <= MOVE_LIMIT and self._is_certain(abstract_state[row], boards, row, found):
                plan[row, : len(found)] = found
        target = np.where(holds, target, boards.target)
        planned = plan[every, cursor]
        counts = count_visits(abstract_state, visits)
        stuck = counts.since_arrival[every, planned] >= 2
        alone = (planned == 0) | stuck
        decision = planned.copy()
        if alone.any():
            rows = np.flatnonzero(alone)
            decision[rows], means = self._choose(abstract_state, rows, counts, means)
            plan[alone] = 0
        pushes = possible_pushes(boards) >> decision & 1 == 1
        # What is put off while a search may find better was not tried; not for ever where estimates flicker.
        waiting = alone & pushes & (waits < self._patience) & _searching(searches.search)
        decision[waiting] = Instruction.STAY
        waits = np.where(waiting, waits + 1, np.where(pushes, 0, waits))
        acting = np.flatnonzero(~waiting)
        acted = remember(abstract_state[acting], decision[acting], VisitMemory(*take_rows(visits, acting)))
        visits = put_rows(visits, acting, acted)
        cursor = np.where(alone, 0, cursor + 1)
        expected = np.where(alone, _NO_KEY, _next_keys(abstract_state, decision))
        return decision, (plan, cursor, expected, target, waits, *_noted(searches), *visits, *means)

    def _advance(self, searches: NDArray[Any]) -> None:
        going = [search for search in searches if search is not None]
        if self.per_tick is not None and self.deadline:
            self.evaluations += advance(going, self.planner, self.expansions, self.deadline)
        else:
            self.evaluations += advance(going, self.planner, self.per_tick or self.expansions)

    def _revived(self, memory: Memory) -> SearchMemory:
        """Return the searches of a memory; one that the process before this one did is done again, where time waits."""
        search, start, spent = (np.array(x) for x in memory[_PLAN:_OWN])
        for row in np.flatnonzero(spent > 0).tolist():
            if search[row] is None and not self.deadline:
                search[row] = LoneSearch(boards_at(start[row]), self.expansions, MOVE_LIMIT)
                self.evaluations += advance([search[row]], self.planner, int(spent[row]))
        return SearchMemory(search, start, spent)

    def _search(self, boards: BitBoards, rows: NDArray[np.int64], searches: SearchMemory) -> None:
        """Start searches for the states in `rows`, but where there is one, and go on with them."""
        for row in rows.tolist():
            here = BitBoards._make(column[row : row + 1] for column in boards)
            search: Any = searches.search[row]
            if search is None or not search.concerns(here):
                searches.search[row] = begun = LoneSearch(here, self.expansions, MOVE_LIMIT)
                searches.start[row] = begun.origin
        self._advance(searches.search[rows])

    def _is_certain(
        self, state: NDArray[np.float32], boards: BitBoards, row: int, instructions: NDArray[np.int64]
    ) -> bool:
        """Return whether all is certain that instructions rest on in a state, [N, N, 4].

        These are boxes and targets, that there are no others, and a free way.
        """
        needed = _squares_used(boards.box[row], int(boards.agent[row]), instructions)
        inner = state[1:-1, 1:-1].reshape(-1, state.shape[-1])
        used, target, box, wall = (
            np.unpackbits(np.array([squares], "<u8").view(np.uint8), bitorder="little").astype(np.bool_)
            for squares in (needed, boards.target[row], boards.box[row], boards.wall[row])
        )
        used[int(boards.agent[row])] = False  # nothing stands where the robot does
        doubt = min(1.0 - self.certainty, _LIKELIER)
        free = (inner[used, WALL] <= doubt).all() and (inner[used & ~box, BOX] <= doubt).all()
        there = (inner[box, BOX] >= self.certainty).all() and (inner[target, TARGET] >= self.certainty).all()
        return bool(free and there) and _all_found(inner[~wall]) >= self.certainty

    def _choose(
        self, states: NDArray[np.float32], rows: NDArray[np.int64], counts: VisitCounts, means: PushMeans
    ) -> tuple[NDArray[np.int64], PushMeans]:
        """Return what the planner alone decides in the states `rows`, and its means."""
        before = recall(states[rows], PushMeans(*take_rows(means, rows)))
        chosen, after = self.planner.choose(states[rows], VisitCounts(*take_rows(counts, rows)), before)
        return chosen, PushMeans(*put_rows(means, rows, after))


def _noted(searches: SearchMemory) -> SearchMemory:
    """Return the memory of searches with how far each is."""
    spent = [0 if search is None else search.spent for search in searches.search]
    return searches._replace(spent=np.array(spent, np.int64))


def _searching(searches: NDArray[Any]) -> NDArray[np.bool_]:
    """Return which searches, None for none, may still find a solution."""
    return np.array([search is not None and search.open for search in searches], np.bool_)


def _all_found(floor: NDArray[np.float32]) -> float:
    """Return the probability that a state has no further box in cells that are likely floor, [F, 4].

    A plan is for as many boxes as targets, and so is a level: a box is left to be found only together with a target, so
    that it is enough to be certain of the one or the other. Cells are taken as independent; in one that was never in
    view an estimator holds a box for much less than likely even where there is one.
    """
    unlikely = (np.where(floor[:, layer] > _LIKELIER, 0.0, floor[:, layer]) for layer in (BOX, TARGET))
    return max(float(np.prod(1.0 - probability)) for probability in unlikely)


@njit(cache=True, nogil=True)
def _squares_used(box: Bits, agent: Int, instructions: NDArray[np.int64]) -> Bits:
    """Return the squares that robot and boxes come to on the way of instructions, those where they are included."""
    used = box | bit(agent)
    for i in range(len(instructions)):
        direction = np.int64(instructions[i]) - 1
        agent += np.int64(SQUARE_STEP[direction])
        if box & bit(agent) != NONE:
            box = pushed(box, agent, direction)
        used |= box | bit(agent)
    return used


def _next_keys(abstract_state: NDArray[np.float32], decision: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the keys of the states that the decisions lead to if nothing fails."""
    env = AbstractEnvironment(len(decision))
    env.reset_to(torch.arange(len(decision)), state_tensor(likeliest_boards(abstract_state)))
    env.step(torch.from_numpy(decision))
    return state_keys(env.observe().numpy())
