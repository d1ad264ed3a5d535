"""What a search is about: a level, where own play of it went wrong, or one push that may be deadly.

Shapes: S states, D = 4 directions, I = 8.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from mujoban_planner.boards import BitBoards, state_tensor
from mujoban_planner.planner import LearnedPlanner
from mujoban_planner.push_env import possible_masks
from mujoban_planner.samples import Samples, make_batch
from mujoban_rl.precision import autocast
from mujoban_sokoban.bitboard import SQUARES

_KEPT: Final = 1024
"""States of own play that wait for an audit, the newest."""
_LEAST, _MOST = 0.003, 0.7
"""A push is audited that is called deadly with a probability between these: of others there is hardly a doubt."""
_UNDOUBTED: Final = 0.1
"""Share that is learned from of pushes that were played without a doubt, and rightly."""
_UNKNOWN: Final = 4
"""States of a level that was lost of which searches could not tell, after which it is left alone."""
_UNLIKELY: Final = 0.3
"""What makes also pushes that are hardly wanted come into an audit."""

Pushed = tuple[int, int, int]
"""Boxes as a board, square of the robot, and push, 4 * square + direction."""


class Phase(StrEnum):
    """What goes on in a tree."""

    PLAY = "play"
    """The planner plays by itself."""
    WON = "won"
    """It has won: there is nothing to search."""
    LOST = "lost"
    """It has lost: a search is to begin."""
    SEARCH = "search"
    AUDIT = "audit"
    """A search asks about the one push before it."""


@dataclass
class Lead:
    """The planner's own play before a search, and how far it is known to have been right.

    Where a level was lost is found by bisection: a search begins in the middle between the last state that is known to
    leave a solution and the first that is known to leave none, until these are one push apart.
    """

    phase: Phase = Phase.WON
    way: list[Pushed] = field(default_factory=list)
    """What was pushed, from the level's start on."""
    root: int = 0
    """Pushes before the search, or own play's all when it has ended."""
    alive: int = 0
    """Pushes before the last state that is known to leave a solution, as the start does."""
    lost: int = 0
    """Pushes before the first state that is known to leave none, or, while there is no such, all."""
    proved: bool = False
    """Whether that is known of it."""
    unknown: list[int] = field(default_factory=list)
    """Pushes before the states of which a search could not tell."""

    @property
    def values(self) -> list[Any]:
        """What stands here, as JSON values."""
        return [*(asdict(self) | {"phase": str(self.phase), "way": [list(push) for push in self.way]}).values()]

    @classmethod
    def of(cls, values: Iterable[Any]) -> Lead:
        """Return a lead from its `values`."""
        phase, *others = values
        lead = cls(Phase(phase), *others)
        lead.way = [(box, agent, push) for box, agent, push in lead.way]
        return lead

    def learn(self, *, solved: bool, lost: bool) -> None:
        """Take in what the search from `root` came to."""
        if solved:
            self.alive = self.root
        elif lost:
            self.lost, self.proved = self.root, True
        else:
            self.unknown.append(self.root)

    @property
    def found(self) -> bool:
        """Whether it is known which push lost the level: the one after `alive` others."""
        return self.proved and self.lost - self.alive == 1

    @property
    def middle(self) -> int | None:
        """Where the next search begins, near the middle; None where there is nothing more to find."""
        if len(self.unknown) >= _UNKNOWN:
            return None
        centre = (self.alive + self.lost) // 2
        left = [i for i in range(self.alive + 1, self.lost) if i not in self.unknown]
        return min(left, key=lambda i: abs(i - centre), default=None)


class AuditQueue:
    """States that own play came through while a solution was left, of which one push each is to be judged by a search.

    What searches prove beside a way is a choice: a solution is found sooner than the proof that there is none. A push
    that is chosen before anything is known of it tells how often such pushes are deadly.
    """

    def __init__(self) -> None:
        """Begin with no state."""
        self._states: deque[tuple[int, int, int, int]] = deque(maxlen=_KEPT)

    def add(self, wall: int, target: int, way: Sequence[Pushed], share: float, rng: np.random.Generator) -> None:
        """Let each of the states of a way wait by a chance of `share`."""
        for i in np.flatnonzero(rng.random(len(way)) < share).tolist():
            box, agent, _ = way[i]
            self._states.append((wall, target, box, agent))

    def take(self, count: int) -> BitBoards:
        """Take the newest states out, at most so many."""
        taken = [self._states.pop() for _ in range(min(count, len(self._states)))]
        columns = zip(*taken, strict=True) if taken else ([],) * 4
        kinds = (np.uint64, np.uint64, np.uint64, np.uint8)
        return BitBoards._make(np.array([*column], kind) for column, kind in zip(columns, kinds, strict=True))

    @property
    def values(self) -> list[list[int]]:
        """What waits, as JSON values."""
        return [list(state) for state in self._states]

    def restore(self, values: Iterable[Iterable[int]]) -> None:
        """Take over `values`."""
        self._states.clear()
        self._states.extend((wall, target, box, agent) for wall, target, box, agent in values)


@torch.inference_mode()
def choose_played(planner: LearnedPlanner, samples: Samples, rng: np.random.Generator) -> Samples:
    """Return of states of which one push was judged, since it was played, those in which it was doubted, and others.

    Where it is doubted, the choice depends on what the planner says of the push, not on what it is. Where it is not,
    the pushes that lost a level are all there: they are rare, took hundreds of evaluations to be found, and are what a
    good planner still loses by. A push without a doubt is therefore called deadly up to ten times as often as it is,
    and still hardly ever.
    """
    if not len(samples.agent):
        return samples
    batch = make_batch(samples, np.zeros(len(samples.agent), np.int64)).to(planner.device)
    with autocast(planner.device):
        output, _ = planner.read(batch.state)
    if output.push_dead is None:
        return samples.take(np.zeros(0, np.int64))
    dead = (output.push_dead.float().sigmoid() * batch.push_known).sum((1, 2, 3)).cpu().numpy()
    deadly = (batch.push_dead & batch.push_known).flatten(1).any(1).cpu().numpy()
    return samples.take(((dead > _LEAST) & (dead < _MOST)) | deadly | (rng.random(len(dead)) < _UNDOUBTED))


@torch.inference_mode()
def draw_doubtful(planner: LearnedPlanner, boards: BitBoards, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return a push of each state, [S], that may be deadly, 4 * square + direction; -1 where there is none.

    Those that the planner wants most are drawn most often. What is drawn depends on what it says alone.
    """
    with autocast(planner.device):
        output, _ = planner.read(state_tensor(boards).to(planner.device))
    assert output.push_dead is not None  # who asks has verdicts on pushes
    wanted, dead = (x.float().flatten(1).cpu().numpy() for x in (output.push.exp(), output.push_dead.sigmoid()))
    doubted = possible_masks(boards) & (dead > _LEAST) & (dead < _MOST)
    chances = ((_UNLIKELY + wanted) * doubted).cumsum(1, dtype=np.float64)
    drawn = (chances <= (rng.random(len(chances)) * chances[:, -1])[:, None]).sum(1)
    return np.where(chances[:, -1] > 0.0, drawn % SQUARES * 4 + drawn // SQUARES, -1)
