"""Training levels of methods without a solver, of the difficulties at which there is most to learn.

Beside fresh levels others come again: those that own play or search lost, and those whose own solution is long, from
their start and from along that solution.

Shapes: R levels.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mujoban_core.grid import DIFFICULTIES
from mujoban_core.ranges import check_counts, check_shares
from mujoban_planner.boards import BitBoards, bit_boards, push_box
from mujoban_planner.seed_streams import LEVELS, first_seed
from mujoban_planner.shortening import shorten
from mujoban_rl.engine import State
from mujoban_sokoban.generator import generate_batch
from mujoban_sokoban.solver_labels import count_moves

_MEMORY: Final = 0.995
"""What a solve rate keeps of itself when one more level of its difficulty ends."""
_LEAST: Final = 0.02
"""Weight of a difficulty at which there is nothing to learn."""
_HARDEST: Final = 0.04
"""Weight that the hardest difficulty has on top: it is the aim."""
_MASTERED: Final = 0.6
"""Solve rate of the hardest difficulty from which on the others are hardly drawn."""
_LATE_SHARE: Final = 0.9
"""Share of the hardest difficulty then; the one below it has the rest."""
_KEPT_FAILURES: Final = 20_000
_KEPT_LONG: Final = 4096
_LEAVES: Final = 0.1
"""Chance that a level which was lost at first is not drawn any more once it is won; and a long one whenever it is."""
_GIVEN_UP: Final = 0.2
"""The same once it is lost again: else a few that cannot be learned are soon all that comes again."""


@dataclass(frozen=True)
class LevelConfig:
    """What decides which levels come again."""

    mined: float = 0.0
    """Share of levels that own play lost when they first came; they come until it has won each several times, or has
    lost it some five times again."""
    long: float = 0.0
    """Share of the other levels whose own solution is long; each comes about ten times."""
    long_moves: int = 45
    """Moves from which on a solution is long, in the best order of its pushes."""
    restarted: float = 0.5
    """Share of these that begin somewhere along that solution; the others begin at their start."""

    def __post_init__(self) -> None:
        """Reject what is no share, and no number of moves."""
        check_shares(self, "mined", "long", "restarted")
        check_counts(self, "long_moves")


class Ticket(NamedTuple):
    """A level that is being played; it is generated again from what stands here."""

    difficulty: int
    seed: int
    failures: int
    """How often it was tried in vain before."""
    mined: bool = False
    """Whether it comes again because it was lost at first."""
    long: bool = False
    """Whether it comes again because its own solution is long."""
    done: tuple[int, ...] = ()
    """Pushes after which it begins, 4 * square + direction of the box."""

    @property
    def kind(self) -> str:
        """`mined` or `long`, or the difficulty of a level that does not come again for that."""
        return "mined" if self.mined else "long" if self.long else str(self.difficulty)

    @property
    def values(self) -> list[Any]:
        """What stands here, as JSON values."""
        return [*self[:-1], list(self.done)]

    @classmethod
    def of(cls, values: Iterable[Any]) -> Ticket:
        """Return a ticket from its `values`."""
        ticket = cls(*values)
        return ticket._replace(done=tuple(ticket.done))


class TrainingLevels:
    """A stream of levels whose mix follows the solve rates that are reported.

    A difficulty weighs as much as its outcome is uncertain, r (1 - r) for a solve rate r. Levels that were not solved
    come again, and so do those that were lost at the first try and those whose own solution is long: a good planner
    meets few levels that are hard for it otherwise. Boxoban's medium levels were chosen likewise, by what a planner
    lost (Guez et al. 2019).
    """

    def __init__(
        self, stream: int, config: LevelConfig | None = None, *, retried: float = 0.0, retries: int = 0
    ) -> None:
        """Draw from the training seeds and randomness of a stream.

        Args:
            stream: 0, 1, ...; different streams share no level.
            config: Which come again, while there are such; by default none.
            retried: Share of levels that were tried in vain before, while there are some.
            retries: How often such a level comes again.

        Raises:
            ValueError: If there is no such stream.
        """
        self._next = first_seed(LEVELS, stream)
        self._rng = np.random.default_rng([stream, 3])
        self._config, self._retried, self._retries = config or LevelConfig(), retried, retries
        self._solved, self._tried = np.zeros((2, len(DIFFICULTIES)))
        self._failed: list[Ticket] = []
        self._lost: list[Ticket] = []
        self._long: list[Ticket] = []  # with the whole solution in `done`

    @property
    def success_rates(self) -> NDArray[np.float64]:
        """Recent solve rate of levels at the first try, by difficulty."""
        return self._solved / np.maximum(self._tried, 1.0)

    @property
    def shares(self) -> NDArray[np.float64]:
        """Share of each difficulty among fresh levels."""
        rates = self.success_rates
        if rates[-1] > _MASTERED and self._tried[-1] > 50:
            shares = np.zeros(len(rates))
            shares[-2:] = 1.0 - _LATE_SHARE, _LATE_SHARE
            return shares
        weights = np.maximum(_LEAST, rates * (1.0 - rates))
        # What was hardly tried may be worth it.
        weights[self._tried < 20] = 0.25
        weights[-1] += _HARDEST
        return weights / weights.sum()

    def draw(self, n: int) -> tuple[BitBoards, list[Ticket]]:
        """Return R = n levels with their tickets."""
        difficulties = self._rng.choice(np.array(list(DIFFICULTIES)), n, p=self.shares).tolist()
        tickets = []
        for difficulty in difficulties:
            if self._failed and self._rng.random() < self._retried:
                tickets.append(self._pop(self._failed))
            elif self._config.mined and self._lost and self._rng.random() < self._config.mined:
                tickets.append(self._pop(self._lost))
            elif self._config.long and self._long and self._rng.random() < self._config.long:
                tickets.append(self._draw_long())
            else:
                tickets.append(Ticket(difficulty, self._next, 0))
                self._next += 1
        return _boards(tickets), tickets

    def rate(self, ticket: Ticket, solved: bool) -> None:
        """Take note of how a level ended at the first try, or of one that came again for itself at another."""
        leaves = (_LEAVES if solved else _GIVEN_UP) if ticket.mined else float(solved)
        if self._config.mined and self._rng.random() >= leaves:
            self._keep(self._lost, ticket._replace(mined=True), _KEPT_FAILURES)
        if ticket.mined or ticket.long:
            return
        i = list(DIFFICULTIES).index(ticket.difficulty)
        self._solved[i] = _MEMORY * self._solved[i] + solved
        self._tried[i] = _MEMORY * self._tried[i] + 1.0

    def solved_by(self, ticket: Ticket, pushes: Sequence[int]) -> None:
        """Take note of a solution that was found, which makes the level come again if it is long.

        Args:
            ticket: The level.
            pushes: From its start, 4 * square + direction of the box.
        """
        if not self._config.long or ticket.mined or ticket.long:
            return
        level = generate_batch(ticket.difficulty, [ticket.seed])
        wall, _, box, agent = (column[0] for column in bit_boards(level))
        way, moves = shorten(wall, box, agent, np.array(pushes, np.uint8)), np.zeros(1, np.int64)
        count_moves(level.wall, level.boxes, level.player, way, np.array([0, len(way)]), moves)
        if moves[0] >= self._config.long_moves:
            self._keep(self._long, ticket._replace(failures=0, long=True, done=tuple(way.tolist())), _KEPT_LONG)

    def come_again(self, ticket: Ticket) -> None:
        """Draw a level that was tried in vain again, unless that was its last time."""
        if ticket.failures < self._retries and len(self._failed) < _KEPT_FAILURES:
            self._failed.append(ticket._replace(failures=ticket.failures + 1))

    def state(self) -> State:
        """Return all that changes."""
        rates = {"solved": self._solved.tolist(), "tried": self._tried.tolist()}
        waiting = {name: [ticket.values for ticket in tickets] for name, tickets in self._waiting.items()}
        return State({"next": self._next, "rng": self._rng.bit_generator.state, **waiting, **rates})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        values = state.values
        self._next = values["next"]
        self._rng.bit_generator.state = values["rng"]
        # Runs that began before levels were mined, or were long, have none.
        for name, tickets in self._waiting.items():
            tickets[:] = [Ticket.of(x) for x in values.get(name, ())]
        self._solved, self._tried = np.array(values["solved"]), np.array(values["tried"])

    @property
    def _waiting(self) -> dict[str, list[Ticket]]:
        """Levels that come again, by why."""
        return {"failed": self._failed, "lost": self._lost, "long": self._long}

    def _draw_long(self) -> Ticket:
        """Return a level with a long solution, from its start or from somewhere along that."""
        ticket = self._pop(self._long)
        if self._rng.random() >= _LEAVES:
            self._long.append(ticket)
        along = len(ticket.done) > 1 and self._rng.random() < self._config.restarted
        return ticket._replace(done=ticket.done[: self._rng.integers(1, len(ticket.done))] if along else ())

    def _keep(self, tickets: list[Ticket], ticket: Ticket, most: int) -> None:
        """Add a ticket; where there are too many, whichever leaves."""
        tickets.append(ticket)
        if len(tickets) > most:
            self._pop(tickets)

    def _pop(self, tickets: list[Ticket]) -> Ticket:
        """Take one of them out, whichever."""
        return tickets.pop(int(self._rng.integers(len(tickets))))


def _boards(tickets: Sequence[Ticket]) -> BitBoards:
    """Return the levels of tickets, [R]."""
    boards = BitBoards._make(np.zeros(len(tickets), kind) for kind in (np.uint64, np.uint64, np.uint64, np.uint8))
    difficulty = np.array([ticket.difficulty for ticket in tickets])
    for d in np.unique(difficulty).tolist():
        rows = np.flatnonzero(difficulty == d)
        levels = generate_batch(d, [tickets[row].seed for row in rows.tolist()])
        for column, values in zip(boards, bit_boards(levels), strict=True):
            column[rows] = values
    for row, ticket in enumerate(tickets):
        for push in ticket.done:
            push_box(boards, row, push)
    return boards
