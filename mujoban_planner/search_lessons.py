"""Lessons without a solver: expert iteration by the planner's own search (Anthony et al. 2017; Orseau et al. 2018).

Levin search, guided by the planner, solves what the planner alone does not; the planner learns from what the search
found, and so guides the next searches better. Many searches run at once, each of a step per network evaluation; one
that ends makes room for the next level, and a level that was not solved comes again with twice the budget. Two things
are learned from a search: the way that it found, in every state along it, and which pushes it proved deadly or safe
(`forest.Forest.judge`). Nobody but the rules says what is right.

Shapes: M trees, R rows, S samples.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mujoban_core.grid import DIFFICULTIES
from mujoban_planner.abstract_env import MOVE_LIMIT
from mujoban_planner.boards import BitBoards, level_batch
from mujoban_planner.forest import Forest, Verdicts
from mujoban_planner.planner import LearnedPlanner
from mujoban_planner.samples import Batch, SampleBuffer, Samples, concatenate, make_batch, unlabelled
from mujoban_planner.search import grow
from mujoban_planner.symmetry import SYMMETRIES
from mujoban_planner.teacher import DEAD_SHARE, judge_instructions, label_dead, label_demonstrations, possible_pushes
from mujoban_planner.training_levels import Ticket, TrainingLevels
from mujoban_rl.engine import Source, State
from mujoban_sokoban.solver import label_solutions

_LONG: Final = 15
"""Expansions from which on a search may have proved something that is not seen at once."""


@dataclass(frozen=True)
class SearchConfig:
    """What defines the searches that a planner learns from."""

    trees: int = 256
    """Searches at once."""
    expansions: int = 60
    """Network evaluations of a search; doubled each time that a level comes again."""
    retries: int = 2
    """How often a level that was not solved comes again."""
    retried: float = 0.15
    """Share of such levels."""
    reuse: float = 3.0
    """Samples learned from for each new one."""
    walks: float = 0.25
    """Share that is kept of the states between two pushes."""
    verdicts: int = 6
    """States off the way, of each search, whose proven verdicts are kept."""
    judged: float = 0.25
    """Share of a batch that holds such states."""
    buffer: int = 200_000
    """Samples kept of each kind."""


class SearchLessons(Source[Batch]):
    """Batches of what rolling searches found; a sample is one network evaluation of a search."""

    def __init__(self, planner: LearnedPlanner, config: SearchConfig, batch_size: int, seed: int) -> None:
        """Start without a search.

        Args:
            planner: Guide, which gets the published weights; not shared with the learner.
            config: What defines the searches.
            batch_size: Samples of a batch.
            seed: Of levels and batches.
        """
        self.planner, self.config, self.batch_size = planner.eval(), config, batch_size
        self._levels = TrainingLevels(seed, retried=config.retried, retries=config.retries)
        self._forest = Forest(config.trees, config.expansions << config.retries, MOVE_LIMIT)
        self._tickets: list[Ticket] = [Ticket(0, 0, 0)] * config.trees
        self._rng = np.random.default_rng([seed, 4])
        self._ways, self._verdicts = SampleBuffer(config.buffer), SampleBuffer(config.buffer)
        self._owed = 0.0
        """Samples that may be learned from before new ones are due."""
        self._found = 0

    def publish(self, weights: Mapping[str, Tensor], version: int) -> None:
        """Guide by newer weights."""
        self.planner.load_state_dict(weights)

    def next_batch(self) -> Batch:
        """Search until there is enough that is new; return a batch under random symmetries."""
        while self._owed < self.batch_size or self._ways.size < 2 * self.batch_size:
            self._advance()
        self._owed -= self.batch_size
        judged = int(self.batch_size * self.config.judged) if self._verdicts.size > self.batch_size else 0
        parts = [self._ways.draw(self.batch_size - judged, self._rng)]
        if judged:
            parts.append(self._verdicts.draw(judged, self._rng))
        return make_batch(concatenate(parts), self._rng.integers(0, SYMMETRIES, self.batch_size))

    def statistics(self) -> dict[str, float]:
        """Return the solve rates of searches at the first try, and how many states they taught."""
        rates = zip(DIFFICULTIES, self._levels.solve_rates.tolist(), strict=True)
        counts = {"ways": self._ways.added, "verdicts": self._verdicts.added, "levels_solved": self._found}
        return {f"search/{d}": rate for d, rate in rates} | {k: float(v) for k, v in counts.items()}

    @property
    def _parts(self) -> dict[str, TrainingLevels | Forest | SampleBuffer]:
        return {"levels": self._levels, "forest": self._forest, "ways": self._ways, "verdicts": self._verdicts}

    def state(self) -> State:
        """Return levels, trees, buffers and random state."""
        counters = {"owed": self._owed, "found": self._found, "tickets": self._tickets}
        own = State({"rng": self._rng.bit_generator.state, **counters})
        return State.of({"own": own} | {name: part.state() for name, part in self._parts.items()})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        for name, part in self._parts.items():
            part.restore(state.part(name))
        own = state.part("own").values
        self._rng.bit_generator.state = own["rng"]
        self._owed, self._found = own["owed"], own["found"]
        self._tickets = [Ticket(*ticket) for ticket in own["tickets"]]

    def _advance(self) -> None:
        """Let every search take a step; learn from those that end, and start others in their place."""
        forest, config = self._forest, self.config
        budget = np.array([config.expansions << ticket.failures for ticket in self._tickets])
        over = np.flatnonzero(~forest.open | (forest.expansions >= budget))
        if over.size:
            planted = over[forest.trees.nodes[over] > 0]  # none is at first
            self._learn(planted)
            boards, tickets = self._levels.draw(len(over))
            forest.plant(over, boards)
            for row, ticket in zip(over.tolist(), tickets, strict=True):
                self._tickets[row] = ticket
        rows = np.arange(config.trees)
        with torch.autocast("cpu", torch.bfloat16):
            grow(forest, rows, self.planner)
        self.samples += config.trees

    def _learn(self, rows: NDArray[np.int64]) -> None:
        """Take what the searches in trees `rows`, [R], found and proved."""
        solved = self._forest.trees.solution[rows] >= 0
        for row, success in zip(rows.tolist(), solved.tolist(), strict=True):
            self._levels.report(self._tickets[row], success)
        self._found += int(solved.sum())
        verdicts = {row: self._forest.judge(row) for row in rows.tolist()}
        if solved.any():
            ways = label_ways(self._forest, {row: verdicts[row] for row in rows[solved].tolist()}, self._rng)
            walking = ways.right & possible_pushes(ways.boards) == 0
            ways = ways.take(~walking | (self._rng.random(len(walking)) < self.config.walks))
            self._ways.add(ways)
            self._owed += self.config.reuse * len(ways.agent)
        searched = [row for row in rows.tolist() if self._forest.expansions[row] > _LONG]
        judged = [label_verdicts(self._forest, r, verdicts[r], self.config.verdicts, self._rng) for r in searched]
        if judged:
            self._verdicts.add(concatenate(judged))


def label_ways(forest: Forest, verdicts: Mapping[int, Verdicts], rng: np.random.Generator) -> Samples:
    """Return every state on the ways that searches found as a sample.

    Args:
        forest: The searches.
        verdicts: What was proved in each tree, by its number; all of them found a way of one push at least.
        rng: Chooses among equally short walks.
    """
    starts = [forest.boards(row, np.zeros(1, np.int64)) for row in verdicts]
    levels = level_batch(BitBoards._make(np.concatenate(columns) for columns in zip(*starts, strict=True)))
    found = label_solutions(levels, [forest.solution(row) for row in verdicts], rng=rng)
    samples, upcoming = label_demonstrations(levels, found)
    nodes = [np.searchsorted(proved.node, forest.way(row)) for row, proved in verdicts.items()]
    pushes = np.unique(upcoming)  # one for each node of the ways, in their order
    for column, name in ((samples.push_known, "known"), (samples.push_dead, "dead")):
        column[pushes] |= np.concatenate(
            [getattr(proved, name)[at] for proved, at in zip(verdicts.values(), nodes, strict=True)]
        )
        column[:] = column[upcoming]  # until the next push the boxes stay where they are, and so do the verdicts
    return judge_instructions(samples)


def label_verdicts(
    forest: Forest, row: int, verdicts: Verdicts, most: int, rng: np.random.Generator
) -> Samples:
    """Return at most `most` states off the way of a tree whose pushes were judged, and a few of its dead states."""
    off_way = ~np.isin(verdicts.node, forest.way(row))
    chosen = np.flatnonzero(verdicts.searched & off_way & ~verdicts.lost)
    chosen = rng.permutation(chosen)[:most]
    judged = unlabelled(forest.boards(row, verdicts.node[chosen]))
    judged = judged._replace(push_known=verdicts.known[chosen], push_dead=verdicts.dead[chosen])
    lost = np.flatnonzero(verdicts.lost & (rng.random(len(verdicts.node)) < DEAD_SHARE))
    return concatenate([judged, label_dead(forest.boards(row, verdicts.node[lost]))])
