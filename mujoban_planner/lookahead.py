"""A planner that looks ahead: tree search guided by a learned planner, which it falls back on.

Off by default everywhere; its results are reported on their own line.

Shapes: M robots, N = `grid.GRID_SIZE`, T moves.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from mujoban_core.interfaces import Memory, Planner, put_rows, take_rows
from mujoban_planner.abstract_env import MOVE_LIMIT, AbstractEnvironment
from mujoban_planner.boards import likeliest_boards, state_tensor
from mujoban_planner.decision import PushMeans, VisitCounts, count_visits, recall, remember, state_keys
from mujoban_planner.planner import LearnedPlanner, check_abstract_state, split_memory
from mujoban_planner.search import search

_RETRY: Final = 6
"""Decisions by the policy alone after a search that found nothing."""
_NO_KEY: Final = -1


class LookAheadPlanner(Planner):
    """Searches when it has no plan for the state that it finds, follows the plan while the world does.

    Where the search finds nothing in time, or a planned move keeps failing, the learned planner decides alone.
    """

    def __init__(self, planner: LearnedPlanner, expansions: int = 400) -> None:
        """Look ahead by at most `expansions` evaluations of `planner` per search."""
        super().__init__()
        self.planner = planner
        self.expansions = expansions
        self.evaluations = 0
        """Network evaluations by searches so far."""

    def initial_memory(self, batch: int) -> Memory:
        """Return (plan, its cursor, the state that it continues from, decisions to wait, planner's memory...)."""
        plan = np.zeros((batch, MOVE_LIMIT + 1), np.int64)
        counters = np.zeros(batch, np.int64), np.full(batch, _NO_KEY, np.int64), np.zeros(batch, np.int64)
        return (plan, *counters, *self.planner.initial_memory(batch))

    def decide(self, abstract_state: NDArray[np.float32], memory: Memory) -> tuple[NDArray[np.int64], Memory]:
        """Return an instruction for each state, [M] from [M, N, N, 4], and the next memory; errors as the planner's."""
        check_abstract_state(abstract_state)
        plan, cursor, expected, wait = (np.array(x) for x in memory[:4])
        visits, means = split_memory(memory[4:])
        key = state_keys(abstract_state)
        lost = (key != expected) | (plan[np.arange(len(plan)), cursor] == 0)
        wait = np.maximum(wait - 1, 0)
        rows = np.flatnonzero(lost & (wait == 0))
        plan[lost], cursor[lost] = 0, 0
        if rows.size:
            self._search(abstract_state[rows], rows, plan, wait)
        planned = plan[np.arange(len(plan)), cursor]
        counts = count_visits(abstract_state, visits)
        stuck = counts.since_arrival[np.arange(len(plan)), planned] >= 2
        alone = (planned == 0) | stuck
        decision = planned.copy()
        if alone.any():
            rows = np.flatnonzero(alone)
            before = recall(abstract_state[rows], PushMeans(*take_rows(means, rows)))
            chosen, after = self.planner.choose(abstract_state[rows], VisitCounts(*take_rows(counts, rows)), before)
            means = put_rows(means, rows, after)
            decision[alone] = chosen
            plan[alone] = 0
        visits = remember(abstract_state, decision, visits)
        cursor = np.where(alone, 0, cursor + 1)
        expected = np.where(alone, _NO_KEY, _next_keys(abstract_state, decision))
        return decision, (plan, cursor, expected, wait, *visits, *means)

    def _search(
        self, states: NDArray[np.float32], rows: NDArray[np.int64], plan: NDArray[np.int64], wait: NDArray[np.int64]
    ) -> None:
        """Write the plans found for `states` into `plan` at `rows`, and when to try again into `wait`."""
        found = search(self.planner, likeliest_boards(states), expansions=self.expansions, limit=MOVE_LIMIT)
        self.evaluations += int(found.expansions.sum())
        for row, instructions in zip(rows, found.instructions, strict=True):
            plan[row, : len(instructions)] = instructions
            wait[row] = 0 if len(instructions) else _RETRY


def _next_keys(abstract_state: NDArray[np.float32], decision: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the keys of the states that the decisions lead to if nothing fails."""
    env = AbstractEnvironment(len(decision))
    env.reset_to(torch.arange(len(decision)), state_tensor(likeliest_boards(abstract_state)))
    env.step(torch.from_numpy(decision))
    return state_keys(env.observe().numpy())
