"""Lessons without a solver: expert iteration by the planner's own search (Anthony et al. 2017; Orseau et al. 2018).

Levin search, guided by the planner, solves what the planner alone does not; the planner learns from what the search
found, and so guides the next searches better. Many searches run at once, each of a step per network evaluation; one
that ends makes room for the next level. The planner plays that by itself first, and only what it loses is searched,
from the start or from somewhere on the way to its loss; a level that was not solved comes again with twice the budget.
Two things are learned from a search: the way that it found, in every state along it, and which pushes it proved deadly
or safe (`forest.Forest.judge`), for which it goes on when it has found its way. Of these states those are kept in which
the planner errs, and some others. Nobody but the rules says what is right.

Shapes: M trees, S samples.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mujoban_core.grid import DIFFICULTIES
from mujoban_core.ranges import check_counts, check_shares
from mujoban_planner.abstract_env import MOVE_LIMIT
from mujoban_planner.boards import BitBoards, level_batch
from mujoban_planner.forest import Forest, Verdicts
from mujoban_planner.lessons import errs
from mujoban_planner.samples import Batch, SampleBuffer, Samples, concatenate, make_batch, unlabelled
from mujoban_planner.search import GraphedEvaluation, evaluate_boards, grow
from mujoban_planner.seed_streams import stream_number
from mujoban_planner.symmetry import SYMMETRIES
from mujoban_planner.teacher import DEAD_SHARE, judge_instructions, label_dead, label_demonstrations, possible_pushes
from mujoban_planner.training_levels import LevelConfig, Ticket, TrainingLevels
from mujoban_planner.uncertainty import Uncertainty, UncertaintyConfig
from mujoban_planner.validation import NetworkConfig
from mujoban_rl.actors import Actor, Experience
from mujoban_rl.engine import State
from mujoban_rl.precision import autocast
from mujoban_sokoban.solver import label_solutions

_LONG: Final = 15
"""Expansions from which on a search may have proved something that is not seen at once."""
_NONE: Final = np.zeros(0, np.uint64)
_NO_BOARDS: Final = BitBoards(_NONE, _NONE, _NONE, np.zeros(0, np.uint8))


@dataclass(frozen=True)
class SearchConfig(LevelConfig, UncertaintyConfig):
    """What defines searches, and the batches of what they taught."""

    trees: int = 256
    """Searches at once."""
    expansions: int = 60
    """Network evaluations of a search; doubled each time that a level comes again."""
    questions: int = 40
    """Network evaluations after a solution was found, to judge the pushes beside its way."""
    retries: int = 2
    """How often a level that was not solved comes again."""
    retried: float = 0.15
    """Share of such levels."""
    steps: int = 8
    """Steps of every search that are delivered at once."""
    walks: float = 0.25
    """Share that is kept of the states between two pushes."""
    led: float = 0.5
    """Share of searches that start from within the planner's own play of a level; the others start from its start."""
    lead: int = 40
    """Pushes of such play at most; where it wins, nothing is searched."""
    verdicts: int = 6
    """States off the way, of each search, whose proven verdicts are kept."""
    judged: float = 0.4
    """Share of a batch that holds such states."""
    easy: float = 0.25
    """Share that is kept of the states in which the planner errs nowhere."""
    buffer: int = 200_000
    """Samples kept of each kind."""
    batch_size: int = 256

    def __post_init__(self) -> None:
        """Reject what is no number of its kind, and no share."""
        LevelConfig.__post_init__(self)
        UncertaintyConfig.__post_init__(self)
        check_counts(self, "trees", "expansions", "steps", "buffer", "batch_size")
        check_counts(self, "questions", "retries", "lead", "verdicts", least=0)
        check_shares(self, "retried", "walks", "led", "judged", "easy")
        if self.buffer < self.batch_size:
            raise ValueError(f"buffer is {self.buffer}: expected at least a batch of {self.batch_size}")


@dataclass
class _Lead:
    """The planner's own play before a search."""

    playing: bool
    """Whether the search has still to begin."""
    won: bool = False
    """Whether there is nothing to search."""
    states: list[tuple[int, int, int]] = field(default_factory=list)
    """Boxes, square of the robot, and push (4 * square + direction); in the end, of what came before the search."""


class SearchActor(Actor):
    """Searches all the time; delivers what searches that ended have found and proved. A step is a network evaluation.

    Delivered are the columns of `Samples`: those of states on the ways that were found under `way.`, those of states
    off them, with what was proved there, under `verdict.`.
    """

    def __init__(
        self, network: NetworkConfig, config: SearchConfig, seed: int, stream: int, *, device: str = "cpu"
    ) -> None:
        """Start without a search.

        Args:
            network: What to build for the weights that guide the searches.
            config: What defines the searches.
            seed: Of the run.
            stream: Of levels and randomness; those of another seed are others.
            device: Of the network.

        Raises:
            ValueError: If the stream has no training seeds.
        """
        number = stream_number(seed, stream)
        self.planner, self.config = network.build().eval().to(device), config
        self.planner.lay_out()
        self._levels = TrainingLevels(number, config, retried=config.retried, retries=config.retries)
        self._forest = Forest(config.trees, (config.expansions << config.retries) + config.questions, MOVE_LIMIT)
        self._budgets = np.zeros(config.trees, np.int64)
        self._tickets: list[Ticket] = [Ticket(0, 0, 0)] * config.trees
        self._leads = [_Lead(playing=False) for _ in range(config.trees)]
        self._rng = np.random.default_rng([number, 4])
        self._graphed: GraphedEvaluation | None = None

    def set_weights(self, weights: Mapping[str, Tensor], version: int) -> None:
        """Guide by newer weights."""
        self.planner.load_state_dict(weights)

    def act(self) -> Experience:
        """Let every search take so many steps."""
        lessons: dict[str, list[Samples]] = {"way": [unlabelled(_NO_BOARDS)], "verdict": [unlabelled(_NO_BOARDS)]}
        ended: dict[str, list[bool]] = {f"{kind}/{d}": [] for kind in ("play", "search") for d in DIFFICULTIES}
        ended |= {"play/mined": [], "play/long": []}
        for _ in range(self.config.steps):
            self._advance(lessons, ended)
        kept = {kind: self._prioritise(concatenate(parts)) for kind, parts in lessons.items()}
        arrays = {f"{kind}.{n}": column for kind, samples in kept.items() for n, column in samples._asdict().items()}
        arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
        statistics = {name: np.array(solved, np.float32) for name, solved in ended.items()}
        return Experience(arrays, self.config.trees * self.config.steps, statistics)

    def state(self) -> State:
        """Return levels, trees and random state."""
        leads = [[lead.playing, lead.won, [list(state) for state in lead.states]] for lead in self._leads]
        tickets = [ticket.values for ticket in self._tickets]
        values = {"rng": self._rng.bit_generator.state, "tickets": tickets, "leads": leads}
        own = State(values, {"budgets": torch.from_numpy(self._budgets)})
        return State.of({"own": own, "levels": self._levels.state(), "forest": self._forest.state()})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        self._levels.restore(state.part("levels"))
        self._forest.restore(state.part("forest"))
        self._budgets[:] = state.part("own").tensors["budgets"].numpy()
        own = state.part("own").values
        self._rng.bit_generator.state = own["rng"]
        self._tickets = [Ticket.of(ticket) for ticket in own["tickets"]]
        self._leads = [_Lead(playing, won, [(x, y, z) for x, y, z in way]) for playing, won, way in own["leads"]]

    def _advance(self, lessons: dict[str, list[Samples]], ended: dict[str, list[bool]]) -> None:
        """Let every search take a step; learn from those that have ended, and start others in their place."""
        forest, config = self._forest, self.config
        over = np.flatnonzero((forest.trees.waiting == 0) | (forest.expansions >= self._budgets))
        if over.size:
            searched = [row for row in over.tolist() if forest.trees.nodes[row] and not self._leads[row].won]
            for row in searched:
                ticket, solved = self._tickets[row], bool(forest.trees.solution[row] >= 0)
                if solved:
                    self._levels.solved_by(ticket, self._pushes(row))
                if not self._leads[row].states:
                    if not solved:
                        self._levels.come_again(ticket)
                    if ticket.failures == 0 and not ticket.long:
                        ended[f"search/{ticket.difficulty}"].append(solved)
            self._learn(searched, lessons)
            boards, tickets = self._levels.draw(len(over))
            forest.plant(over, boards)
            for row, ticket in zip(over.tolist(), tickets, strict=True):
                self._tickets[row], self._leads[row] = ticket, _Lead(playing=ticket.failures == 0)
                self._budgets[row] = config.expansions << ticket.failures
        self._grow()
        self._play(ended)

    def _prioritise(self, samples: Samples) -> Samples:
        """Return the samples on which the planner errs, and a share of the others."""
        kept = self._rng.random(len(samples.agent)) < self.config.easy
        kept[~kept] = errs(self.planner, samples.take(np.flatnonzero(~kept)))
        return samples.take(kept)

    def _grow(self) -> None:
        """Expand a node of every tree; a search that finds its way goes on to judge the pushes beside it."""
        forest = self._forest
        searching = forest.trees.solution < 0
        grow(forest, np.arange(self.config.trees), self._evaluate)
        solved = np.flatnonzero(searching & (forest.trees.solution >= 0))
        forest.question(solved)
        self._budgets[solved] = forest.expansions[solved] + self.config.questions

    def _evaluate(self, boards: BitBoards) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return what the planner says of a state of every tree."""
        if self.planner.device.type == "cuda":
            if self._graphed is None:
                self._graphed = GraphedEvaluation(self.planner, self.config.trees)
            return self._graphed(boards)
        with autocast(self.planner.device):
            return evaluate_boards(self.planner, boards)

    def _play(self, ended: dict[str, list[bool]]) -> None:
        """Push once by chance, as the planner's probabilities are, in every tree that is played.

        Of each the first node was just expanded.
        """
        forest, trees = self._forest, self._forest.trees
        rows = np.array([row for row, lead in enumerate(self._leads) if lead.playing], np.int64)
        children = forest.wander(rows, self._rng.random(len(rows)))
        won = trees.solution[rows] >= 0
        full = np.array([len(self._leads[row].states) == self.config.lead for row in rows.tolist()], np.bool_)
        over = won | full | (children < 0)
        for row, solved in zip(rows[over].tolist(), won[over].tolist(), strict=True):
            self._end_play(row, solved, ended)
        rows, children = rows[~over], children[~over]
        states = zip(
            trees.box[rows, 0].tolist(), trees.agent[rows, 0].tolist(), trees.push[rows, children].tolist(), strict=True
        )
        for row, state in zip(rows.tolist(), states, strict=True):
            self._leads[row].states.append(state)
        forest.plant(rows, forest.boards(rows, children))

    def _end_play(self, row: int, won: bool, ended: dict[str, list[bool]]) -> None:
        """Take note of how a level was played; what is lost is searched."""
        lead, ticket = self._leads[row], self._tickets[row]
        lead.playing, lead.won = False, won
        self._levels.rate(ticket, won)
        ended[f"play/{ticket.kind}"].append(won)
        if won:
            self._levels.solved_by(ticket, self._pushes(row))
            self._budgets[row] = 0
        else:
            self._go_back(row, lead)

    def _pushes(self, row: int) -> list[int]:
        """Return the pushes from where a level began to the end of the way that a search found."""
        return [push for _, _, push in self._leads[row].states] + self._forest.solution(row).tolist()

    def _go_back(self, row: int, lead: _Lead) -> None:
        """Begin the search of a level that own play has lost: at its start, or somewhere on the way that it took."""
        trees, way = self._forest.trees, len(lead.states)
        kept = int(self._rng.integers(1, way)) if way > 1 and self._rng.random() < self.config.led else 0
        if way:
            box, agent, _ = lead.states[kept]
            columns = trees.wall[[row]], trees.target[[row]], np.array([box], np.uint64), np.array([agent], np.uint8)
            self._forest.plant(np.array([row]), BitBoards(*columns))
        lead.states = lead.states[:kept]
        if kept:  # there is most to prove
            self._budgets[row] = self.config.expansions << self.config.retries

    def _learn(self, rows: Sequence[int], lessons: dict[str, list[Samples]]) -> None:
        """Add what the searches in these trees found and proved."""
        forest, config = self._forest, self.config
        verdicts = {row: forest.judge(row) for row in rows}
        solved = {row: proved for row, proved in verdicts.items() if len(forest.way(row))}
        if solved:
            ways = label_ways(forest, solved, self._rng)
            walking = ways.right & possible_pushes(ways.boards) == 0
            lessons["way"].append(ways.take(~walking | (self._rng.random(len(walking)) < config.walks)))
        searched = [row for row in verdicts if forest.expansions[row] > _LONG]
        judged = [label_verdicts(forest, row, verdicts[row], config.verdicts, self._rng) for row in searched]
        lessons["verdict"] += judged
        for row, proved in verdicts.items():
            if self._leads[row].states and (proved.lost[0] or forest.trees.solution[row] >= 0):
                lessons["verdict"].append(_label_lead(forest, row, self._leads[row], lost=bool(proved.lost[0])))


class LessonStore:
    """The newest lessons of searches, as batches under random symmetries, blurred and with cells hidden."""

    def __init__(self, config: SearchConfig, seed: int) -> None:
        """Make room for lessons; `seed` chooses batches."""
        self.config = config
        self.buffers = {"way": SampleBuffer(config.buffer), "verdict": SampleBuffer(config.buffer)}
        self._uncertainty = Uncertainty(config)
        self._rng = np.random.default_rng([seed, 6])
        self._generator = torch.Generator().manual_seed(seed)

    def add(self, experience: Experience) -> None:
        """Keep what an actor delivered."""
        for kind, buffer in self.buffers.items():
            buffer.add(Samples._make(experience.arrays[f"{kind}.{name}"] for name in Samples._fields))

    def sample(self) -> Batch | None:
        """Return a batch, once so many states of ways are there: a good planner wins its first levels by itself."""
        ways, verdicts, size = self.buffers["way"], self.buffers["verdict"], self.config.batch_size
        if ways.size < size:
            return None
        judged = int(size * self.config.judged) if verdicts.size > size else 0
        parts = [ways.draw(size - judged, self._rng)]
        if judged:
            parts.append(verdicts.draw(judged, self._rng))
        # What is blurred and hidden are the first and the last of a batch: states of both kinds, hence.
        samples = concatenate(parts).take(self._rng.permutation(size))
        batch = make_batch(samples, self._rng.integers(0, SYMMETRIES, size))
        return batch._replace(state=self._uncertainty.apply(batch.state, self._generator, self._rng))

    def state(self) -> State:
        """Return the lessons and the random states."""
        own = State({"rng": self._rng.bit_generator.state}, {"generator": self._generator.get_state()})
        return State.of({"own": own} | {kind: buffer.state() for kind, buffer in self.buffers.items()})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        own = state.part("own")
        self._rng.bit_generator.state = own.values["rng"]
        self._generator.set_state(own.tensors["generator"])
        for kind, buffer in self.buffers.items():
            buffer.restore(state.part(kind))


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


def _label_lead(forest: Forest, row: int, lead: _Lead, *, lost: bool) -> Samples:
    """Return what the end of a search says of the pushes before it: of a lost state the last, else all are judged."""
    states = lead.states[-1:] if lost else lead.states
    n = len(states)
    box, agent = np.array([x for x, _, _ in states], np.uint64), np.array([x for _, x, _ in states], np.uint8)
    wall, target = (np.full(n, column[row]) for column in (forest.trees.wall, forest.trees.target))
    samples = unlabelled(BitBoards(wall, target, box, agent))
    push = np.array([x for _, _, x in states])
    samples.push_known[np.arange(n), push % 4] = np.uint64(1) << (push // 4).astype(np.uint64)
    if lost:
        samples.push_dead[:] = samples.push_known
    return samples
