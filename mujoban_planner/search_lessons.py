"""Lessons without a solver: expert iteration by the planner's own search (Anthony et al. 2017; Orseau et al. 2018).

Levin search, guided by the planner, solves what the planner alone does not; the planner learns from what the search
found, and so guides the next searches better. Many searches run at once, each of a step per network evaluation; one
that ends makes room for the next level. The planner plays that by itself first, and only what it loses is searched,
from the start or for the push that lost it (`own_play.Lead`); a level that was not solved comes again with twice the
budget. Two things are learned from a search: the way that it found, in every state along it, and which pushes it proved
deadly or safe (`forest.Forest.judge`), for which it goes on when it has found its way. Of these states those are kept
in which the planner errs, and some others. Beside them, searches audit pushes of which nobody knows yet whether they
are deadly (`own_play.AuditQueue`). Nobody but the rules says what is right.

Shapes: M trees, S samples.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mujoban_core.grid import DIFFICULTIES
from mujoban_core.ranges import check_counts, check_shares
from mujoban_planner.abstract_env import MOVE_LIMIT
from mujoban_planner.boards import BitBoards, push_box
from mujoban_planner.forest import Forest, Verdicts
from mujoban_planner.lessons import errs
from mujoban_planner.own_play import AuditQueue, Lead, Phase, Pushed, choose_played, draw_doubtful
from mujoban_planner.samples import Samples, concatenate, unlabelled
from mujoban_planner.search import GraphedEvaluation, evaluate_boards, grow
from mujoban_planner.search_labels import label_pushes, label_verdicts, label_ways
from mujoban_planner.seed_streams import stream_number
from mujoban_planner.teacher import possible_pushes
from mujoban_planner.training_levels import LevelConfig, Ticket, TrainingLevels
from mujoban_planner.uncertainty import UncertaintyConfig
from mujoban_planner.validation import NetworkConfig
from mujoban_rl.actors import Actor, Experience
from mujoban_rl.engine import State
from mujoban_rl.precision import autocast

KINDS: Final = ("way", "verdict", "played", "audit")
"""Of samples: on ways that were found; off them, with what was proved there; pushes of own play; pushes that were
audited."""
_AUDITS: Final = 0.5
"""Share of the states of own play of which a push is to be audited, where it is known that they leave a solution: about
as many can be, while levels are played."""
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
    """Share of own play whose pushes are learned from; where it was lost, searches look for the push that lost it. Of
    other lost play they begin at the start."""
    lead: int = 40
    """Pushes of own play at most; where it wins, nothing is searched."""
    audited: float = 0.5
    """Share of the searches that audit pushes, while levels of difficulty 5 are won."""
    verdicts: int = 6
    """States off the way, of each search, whose proven verdicts are kept."""
    judged: float = 0.4
    """Share of a batch that holds such states and, one half of it, audits."""
    easy: float = 0.25
    """Share that is kept of the states in which the planner errs nowhere."""
    buffer: int = 200_000
    """Samples kept of each kind."""
    batch_size: int = 256
    """Samples of an update."""

    def __post_init__(self) -> None:
        """Reject what is no number of its kind, and no share."""
        LevelConfig.__post_init__(self)
        UncertaintyConfig.__post_init__(self)
        check_counts(self, "trees", "expansions", "steps", "buffer", "batch_size")
        check_counts(self, "questions", "retries", "lead", "verdicts", least=0)
        check_shares(self, "retried", "walks", "led", "audited", "judged", "easy")
        if self.buffer < self.batch_size:
            raise ValueError(f"buffer is {self.buffer}: expected at least a batch of {self.batch_size}")


Lessons = dict[str, list[Samples]]
"""Samples of each of `KINDS`."""
Ended = dict[str, list[bool]]
"""How plays and searches ended, by what they were."""


class SearchActor(Actor):
    """Searches all the time; delivers what searches that ended have found and proved. A step is a network evaluation.

    Delivered are the columns of `Samples` of each of `KINDS`, under its name and a dot.
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
        self._leads = [Lead() for _ in range(config.trees)]
        self._auditors = round(config.audited * config.trees) if self.planner.heads.push_dead is not None else 0
        self._audits = AuditQueue()
        self._rng = np.random.default_rng([number, 4])
        self._graphed: GraphedEvaluation | None = None

    def set_weights(self, weights: Mapping[str, Tensor], version: int) -> None:
        """Guide by newer weights."""
        self.planner.load_state_dict(weights)

    def act(self) -> Experience:
        """Let every search take so many steps."""
        lessons: Lessons = {kind: [unlabelled(_NO_BOARDS)] for kind in KINDS}
        ended: Ended = {f"{kind}/{d}": [] for kind in ("play", "search") for d in DIFFICULTIES}
        ended |= {"play/mined": [], "play/long": [], "audit/decided": [], "audit/dead": []}
        for _ in range(self.config.steps):
            self._advance(lessons, ended)
        kept = {kind: concatenate(parts) for kind, parts in lessons.items()}
        # Of the others a choice of those in which it errs would be one by what they came to.
        kept |= {kind: self._prioritise(kept[kind]) for kind in ("way", "verdict")}
        kept["played"] = choose_played(self.planner, kept["played"], self._rng)
        arrays = {f"{kind}.{n}": column for kind, samples in kept.items() for n, column in samples._asdict().items()}
        arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
        statistics = {name: np.array(solved, np.float32) for name, solved in ended.items()}
        return Experience(arrays, self.config.trees * self.config.steps, statistics)

    def state(self) -> State:
        """Return levels, trees and random state."""
        values = {
            "rng": self._rng.bit_generator.state, "tickets": [ticket.values for ticket in self._tickets],
            "leads": [lead.values for lead in self._leads], "audits": self._audits.values,
        }  # fmt: skip
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
        self._leads = [Lead.of(lead) for lead in own["leads"]]
        self._audits.restore(own["audits"])

    def _advance(self, lessons: Lessons, ended: Ended) -> None:
        """Let every search take a step; learn from those that have ended, and start others in their place."""
        forest = self._forest
        over = np.flatnonzero((forest.trees.waiting == 0) | (forest.expansions >= self._budgets)).tolist()
        searched = [row for row in over if self._leads[row].phase in (Phase.SEARCH, Phase.AUDIT)]
        for row, proved in self._learn(searched, lessons).items():
            self._end_search(row, bool(proved.lost[0]), lessons, ended)
        self._begin([row for row in over if not self._go_on(row, lessons)])
        self._grow()
        self._play(lessons, ended)

    def _begin(self, rows: list[int]) -> None:
        """Begin with an audit or another level in each of these trees."""
        audited = self._audit([row for row in rows if row < self._auditors])
        rows = [row for row in rows if row not in audited]
        if not rows:
            return
        boards, tickets = self._levels.draw(len(rows))
        self._forest.plant(np.array(rows), boards)
        for row, ticket in zip(rows, tickets, strict=True):
            self._tickets[row] = ticket
            self._leads[row] = Lead(Phase.SEARCH if ticket.failures else Phase.PLAY)
            self._budgets[row] = self.config.expansions << ticket.failures

    def _audit(self, rows: list[int]) -> set[int]:
        """Begin with an audit in these trees; return in which there is one."""
        boards = self._audits.take(len(rows))
        pushes = draw_doubtful(self.planner, boards, self._rng).tolist() if len(boards.agent) else []
        begun = set()
        for i, (row, push) in enumerate(zip(rows, pushes, strict=False)):
            before = int(boards.box[i]), int(boards.agent[i])
            if push >= 0:
                push_box(boards, i, push)
            if push < 0 or boards.box[i] == boards.target[i]:
                continue  # there is nothing to ask
            self._forest.plant(np.array([row]), BitBoards._make(column[[i]] for column in boards))
            self._leads[row] = Lead(Phase.AUDIT, way=[(*before, push)], root=1)
            self._budgets[row] = self.config.expansions << self.config.retries
            begun.add(row)
        return begun

    def _end_search(self, row: int, lost: bool, lessons: Lessons, ended: Ended) -> None:
        """Take note of what the search in a tree came to."""
        lead, ticket, solved = self._leads[row], self._tickets[row], bool(self._forest.trees.solution[row] >= 0)
        if lead.phase is Phase.AUDIT:
            ended["audit/decided"].append(solved or lost)
            if solved or lost:
                ended["audit/dead"].append(lost)
                lessons["audit"].append(label_pushes(self._forest, row, lead.way, dead=lost))
            return
        if solved:
            self._levels.solved_by(ticket, self._pushes(row))
        if lead.root:
            lead.learn(solved=solved, lost=lost)
            return
        if not solved:
            self._levels.come_again(ticket)
        if ticket.failures == 0 and not ticket.long:
            ended[f"search/{ticket.difficulty}"].append(solved)

    def _go_on(self, row: int, lessons: Lessons) -> bool:
        """Search in a tree for what lost own play of its level, or from its start; tell whether there is more to do."""
        lead = self._leads[row]
        if lead.phase is not Phase.LOST and not (lead.phase is Phase.SEARCH and lead.root):
            return False
        if lead.found:
            self._use(row, lead.way[: lead.alive + 1], lessons, lost=True)
        if lead.middle is None and lead.alive:
            return False
        lead.phase, lead.root = Phase.SEARCH, lead.middle or 0
        if lead.way:
            trees, (box, agent, _) = self._forest.trees, lead.way[lead.root]
            columns = trees.wall[[row]], trees.target[[row]], np.array([box], np.uint64), np.array([agent], np.uint8)
            self._forest.plant(np.array([row]), BitBoards(*columns))
        # Within own play there is most to prove.
        self._budgets[row] = self.config.expansions << (self.config.retries if lead.root else 0)
        return bool(self._forest.trees.waiting[row])

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
        asked = np.array([self._leads[row].root > 0 for row in solved.tolist()], np.bool_)
        self._budgets[solved[asked]] = 0  # whether there is a solution was all
        solved = solved[~asked]
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

    def _play(self, lessons: Lessons, ended: Ended) -> None:
        """Push once by chance, as the planner's probabilities are, in every tree that is played.

        Of each the first node was just expanded.
        """
        forest, trees = self._forest, self._forest.trees
        rows = np.array([row for row, lead in enumerate(self._leads) if lead.phase is Phase.PLAY], np.int64)
        children = forest.wander(rows, self._rng.random(len(rows)))
        won, shut = trees.solution[rows] >= 0, children < 0
        full = np.array([len(self._leads[row].way) == self.config.lead for row in rows.tolist()], np.bool_)
        over = won | full | shut
        for row, solved, stuck in zip(rows[over].tolist(), won[over].tolist(), shut[over].tolist(), strict=True):
            self._end_play(row, solved, stuck, lessons, ended)
        rows, children = rows[~over], children[~over]
        states = zip(
            trees.box[rows, 0].tolist(), trees.agent[rows, 0].tolist(), trees.push[rows, children].tolist(), strict=True
        )
        for row, state in zip(rows.tolist(), states, strict=True):
            self._leads[row].way.append(state)
        forest.plant(rows, forest.boards(rows, children))

    def _end_play(self, row: int, won: bool, shut: bool, lessons: Lessons, ended: Ended) -> None:
        """Take note of how a level was played, whether at the end no push was left; what is lost is searched."""
        lead, ticket = self._leads[row], self._tickets[row]
        self._levels.rate(ticket, won)
        ended[f"play/{ticket.kind}"].append(won)
        self._budgets[row], lead.root = 0, len(lead.way)
        lead.phase = Phase.WON if won else Phase.LOST
        if won:
            self._levels.solved_by(ticket, self._pushes(row))
        if self._rng.random() < self.config.led:  # of all play alike
            if won:
                self._use(row, lead.way, lessons, lost=False)
            else:
                lead.lost, lead.proved = len(lead.way), shut

    def _use(self, row: int, way: Sequence[Pushed], lessons: Lessons, *, lost: bool) -> None:
        """Learn from pushes of own play, in states that leave a solution, of which the last one may have lost it.

        In some of these states another push may be audited. Of levels that are easier there is less to learn, and at
        first they are all that is won.
        """
        safe = len(way) - lost
        for pushes, dead in ((way[:safe], False), (way[safe:], True)):
            lessons["played"].append(label_pushes(self._forest, row, pushes, dead=dead))
        if self._tickets[row].difficulty == max(DIFFICULTIES):
            wall, target = int(self._forest.trees.wall[row]), int(self._forest.trees.target[row])
            self._audits.add(wall, target, way, _AUDITS, self._rng)

    def _pushes(self, row: int) -> list[int]:
        """Return the pushes from where a level began to the end of the way that a search found."""
        lead = self._leads[row]
        return [push for _, _, push in lead.way[: lead.root]] + self._forest.solution(row).tolist()

    def _learn(self, rows: Sequence[int], lessons: Lessons) -> dict[int, Verdicts]:
        """Add what the searches in these trees found and proved; return what was proved, by tree."""
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
        return verdicts
