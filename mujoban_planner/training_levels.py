"""Fresh training levels, of the difficulties at which there is most to learn.

Shapes: R levels.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mujoban_core.grid import DIFFICULTIES
from mujoban_planner.boards import BitBoards, bit_boards
from mujoban_rl.engine import State
from mujoban_sokoban.generator import TRAIN_SEEDS, generate_batch

_STREAMS_PER_SEED: Final = 1000
"""Streams of levels that one seed may use up, one for each actor."""
_SEEDS_PER_STREAM: Final = 10**12
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
_LEAVES: Final = 0.1
"""Chance that a level which was lost at first is not drawn any more once it is won."""
_STREAMS: Final = TRAIN_SEEDS.start + 700_000 * _SEEDS_PER_STREAM
LAST_SEED: Final = (TRAIN_SEEDS.stop - _STREAMS) // (_STREAMS_PER_SEED * _SEEDS_PER_STREAM) - 1
"""The largest seed of a run whose every stream has levels."""


def stream_number(seed: int, stream: int) -> int:
    """Return which of all runs' streams an actor has: the `stream`-th of a run with this seed.

    Raises:
        ValueError: If the seed is negative, or has no such stream.
    """
    if seed < 0 or not 0 <= stream < _STREAMS_PER_SEED:
        raise ValueError(f"stream {stream} of seed {seed}: expected 0 to {_STREAMS_PER_SEED - 1} of a seed from 0 on")
    return _STREAMS_PER_SEED * seed + stream


class Ticket(NamedTuple):
    """A level that is being played; it is generated again from what stands here."""

    difficulty: int
    seed: int
    failures: int
    """How often it was tried in vain before."""
    mined: bool = False
    """Whether it comes again because it was lost at first."""


class TrainingLevels:
    """A stream of levels whose mix follows the solve rates that are reported.

    A difficulty weighs as much as its outcome is uncertain, r (1 - r) for a solve rate r. Levels that were not solved
    come again, and so do those that were lost at the first try: a good planner meets few levels that are hard for it
    otherwise. Boxoban's medium levels were chosen likewise, by what a planner lost (Guez et al. 2019).
    """

    def __init__(self, stream: int, *, retried: float = 0.0, retries: int = 0, mined: float = 0.0) -> None:
        """Draw from the training seeds and randomness of a stream.

        Args:
            stream: 0, 1, ...; different streams share no level.
            retried: Share of levels that were tried in vain before, while there are some.
            retries: How often a level comes again.
            mined: Share of levels that were lost at the first try, while there are some; each is drawn until it has
                been won several times.

        Raises:
            ValueError: If the stream has no training seeds.
        """
        self._next = _STREAMS + stream * _SEEDS_PER_STREAM
        if stream < 0 or self._next + _SEEDS_PER_STREAM - 1 not in TRAIN_SEEDS:
            raise ValueError(f"stream {stream}: expected a number whose seeds lie in {TRAIN_SEEDS}, as of a small seed")
        self._rng = np.random.default_rng([stream, 3])
        self._retried, self._retries, self._mined = retried, retries, mined
        self._solved, self._tried = np.zeros((2, len(DIFFICULTIES)))
        self._failed: list[Ticket] = []
        self._lost: list[Ticket] = []

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
            elif self._mined and self._lost and self._rng.random() < self._mined:
                tickets.append(self._pop(self._lost))
            else:
                tickets.append(Ticket(difficulty, self._next, 0))
                self._next += 1
        return _boards(tickets), tickets

    def rate(self, ticket: Ticket, solved: bool) -> None:
        """Take note of how a level ended at the first try, or of one that is mined at another."""
        if self._mined and not (solved and (not ticket.mined or self._rng.random() < _LEAVES)):
            self._lost.append(ticket._replace(mined=True))
            if len(self._lost) > _KEPT_FAILURES:
                self._pop(self._lost)
        if ticket.mined:
            return
        i = list(DIFFICULTIES).index(ticket.difficulty)
        self._solved[i] = _MEMORY * self._solved[i] + solved
        self._tried[i] = _MEMORY * self._tried[i] + 1.0

    def come_again(self, ticket: Ticket) -> None:
        """Draw a level that was tried in vain again, unless that was its last time."""
        if ticket.failures < self._retries and len(self._failed) < _KEPT_FAILURES:
            self._failed.append(ticket._replace(failures=ticket.failures + 1))

    def state(self) -> State:
        """Return all that changes."""
        rates = {"solved": self._solved.tolist(), "tried": self._tried.tolist()}
        waiting = {"failed": [list(x) for x in self._failed], "lost": [list(x) for x in self._lost]}
        return State({"next": self._next, "rng": self._rng.bit_generator.state, **waiting, **rates})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        values = state.values
        self._next = values["next"]
        self._rng.bit_generator.state = values["rng"]
        # Runs that began before levels were mined have none.
        self._failed, self._lost = ([Ticket(*x) for x in values.get(name, ())] for name in ("failed", "lost"))
        self._solved, self._tried = np.array(values["solved"]), np.array(values["tried"])

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
    return boards
