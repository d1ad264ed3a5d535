"""What a planner is taught: demonstrations of fresh levels, and corrections of its own play (DAgger)."""

from __future__ import annotations

from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mujoban_core.grid import DIFFICULTIES
from mujoban_planner.abstract_env import MOVE_LIMIT
from mujoban_planner.boards import join_levels, take_levels
from mujoban_planner.planner import LearnedPlanner
from mujoban_planner.play import Game, play
from mujoban_planner.samples import Samples, concatenate, make_batch
from mujoban_planner.seed_streams import LESSONS, first_seed
from mujoban_planner.teacher import Teacher, label_deadly, possible_pushes
from mujoban_rl.engine import State
from mujoban_rl.precision import autocast
from mujoban_sokoban.generator import generate_batch
from mujoban_sokoban.levels import LevelBatch
from mujoban_sokoban.solver import Status

_WALK_SHARE: Final = 0.35
"""Share of walking states that is kept; pushes decide a level."""
_CANDIDATES: Final = 8
"""Levels that are solved at once for each long one that is wanted: one in eight takes 45 moves."""
_VISITS: Final = 4
"""States of each game from which the way is shown."""
_KEPT: Final = 5
"""States kept of each such way."""
_EASY_SHARE: Final = 0.25
"""Share that is kept of the states of such ways in which the planner has nothing to learn; most are."""
_TOLERANCE: Final = 0.1
"""Distance of a verdict, a probability, from the truth from which on there is something to learn."""
_REPLAYED: Final = 0.5
"""Levels lost before that are played once more, per fresh level, while there are some."""
_LOST_LEVELS: Final = 4096
"""Lost levels kept of each difficulty."""
_FORWARD: Final = 1024
"""States in one forward pass."""


class LessonMaker:
    """Makes samples from fresh training levels; deterministic given its stream."""

    def __init__(
        self, stream: int, mix: dict[int, float], judged: float = 1.0, *, long: float = 0.0, long_moves: int = 0
    ) -> None:
        """Use the training seeds and randomness of `stream` (0, 1, ...).

        Args:
            stream: Number of this maker; different streams share no level.
            mix: Share of each difficulty among the levels.
            judged: Share of the arrangements of boxes on the way in which every possible push is judged.
            long: Share of the levels of the hardest difficulty whose solution is long.
            long_moves: Moves of the shortest solution that counts as long.

        Raises:
            ValueError: If there is no such stream.
        """
        self._next = first_seed(LESSONS, stream)
        self._rng = np.random.default_rng([stream, 1])
        self._mix = {d: share / sum(mix.values()) for d, share in mix.items() if share > 0}
        self._teacher = Teacher()
        self._judged = judged
        self._long, self._long_moves = long, long_moves
        self._lost: dict[int, LevelBatch] = {}

    def state(self) -> State:
        """Return all that changes: levels used up, random state, levels that were lost."""
        lost = {f"{d}.{name}": array for d, levels in self._lost.items() for name, array in levels._asdict().items()}
        values = {"next": self._next, "rng": self._rng.bit_generator.state, "lost": list(self._lost)}
        return State(values, {name: torch.from_numpy(array) for name, array in lost.items()})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        self._next = state.values["next"]
        self._rng.bit_generator.state = state.values["rng"]
        self._lost = {
            d: LevelBatch(*(state.tensors[f"{d}.{name}"].numpy() for name in LevelBatch._fields))
            for d in state.values["lost"]
        }

    def levels(self, n: int) -> dict[int, LevelBatch]:
        """Return `n` fresh levels by difficulty."""
        counts = self._rng.multinomial(n, list(self._mix.values()))
        parts = {}
        for difficulty, count in zip(self._mix, counts.tolist(), strict=True):
            if count:
                long = self._rng.binomial(count, self._long) if difficulty == max(DIFFICULTIES) else 0
                fresh = self._generate(difficulty, count - long)
                parts[difficulty] = join_levels([fresh, self._long_levels(difficulty, long)]) if long else fresh
        return parts

    def _generate(self, difficulty: int, n: int) -> LevelBatch:
        first, self._next = self._next, self._next + n
        return generate_batch(difficulty, range(first, self._next))

    def _long_levels(self, difficulty: int, n: int) -> LevelBatch:
        """Return `n` fresh levels whose solutions are long, among many that are not."""
        found = generate_batch(difficulty, [])
        while len(found.player) < n:
            levels = self._generate(difficulty, _CANDIDATES * n)
            found = join_levels([found, take_levels(levels, self._teacher.moves(levels) >= self._long_moves)])
        return take_levels(found, np.arange(n))

    def demonstrations(self, n: int) -> Samples:
        """Return samples of the solutions of `n` fresh levels, thinned on walks."""
        fresh = self.levels(n).values()
        parts = [self._teacher.demonstrate(levels, self._rng, judged=self._judged) for levels in fresh]
        samples = concatenate(parts)
        walking = (samples.right != 0) & (samples.right & possible_pushes(samples.boards) == 0)
        return samples.take(~walking | (self._rng.random(len(walking)) < _WALK_SHARE))

    def corrections(self, planner: LearnedPlanner, n: int) -> Samples:
        """Let the planner play `n` fresh levels and return what it should have done where it went wrong.

        A lost level is searched for the instruction that lost it; the demonstration starts from the state before. It
        is played again later, until it is solved (prioritized level replay, Jiang et al. 2021).
        """
        parts = []
        for difficulty, fresh in self.levels(n).items():
            levels = join_levels([fresh, self._take_lost(difficulty, int(_REPLAYED * len(fresh.player)))])
            exploration = 0.05 if self._rng.random() < 0.5 else 0.0
            game = play(
                planner, levels, limit=MOVE_LIMIT, exploration=exploration, rng=self._rng, reduced_precision=True
            )
            first_dead = self._first_dead(levels, game)
            self._keep_lost(difficulty, take_levels(levels, first_dead > 0))
            lost, on_its_way = self._correct(levels, game, first_dead)
            parts += [*lost, self._prioritise(planner, concatenate(on_its_way))]
        return concatenate(parts)

    def _take_lost(self, difficulty: int, n: int) -> LevelBatch:
        """Return up to `n` random levels that were lost, and forget them: they come back if they are lost again."""
        lost = self._lost.get(difficulty)
        if lost is None:
            return generate_batch(difficulty, [])
        order = self._rng.permutation(len(lost.player))
        self._lost[difficulty] = take_levels(lost, order[n:])
        return take_levels(lost, order[:n])

    def _keep_lost(self, difficulty: int, lost: LevelBatch) -> None:
        known = self._lost.get(difficulty)
        pool = lost if known is None else join_levels([lost, known])
        self._lost[difficulty] = take_levels(pool, np.arange(len(pool.player)) < _LOST_LEVELS)

    def _correct(
        self, levels: LevelBatch, game: Game, first_dead: NDArray[np.int64]
    ) -> tuple[list[Samples], list[Samples]]:
        """Return samples of where levels were lost, first dead at [B], and of states anywhere on the way of all."""
        batch = np.arange(len(game.moves))
        length = np.where(game.solved, game.moves, MOVE_LIMIT)
        lost = first_dead > 0
        parts, on_its_way = [], []
        # Where it went wrong: the state before, what killed it, and a dead state.
        rows = batch[lost]
        if rows.size:
            before = _states(levels, game, rows, first_dead[rows] - 1)
            parts.append(self._teacher.demonstrate(before, self._rng, keep=12))
            parts.append(label_deadly(before, game.instructions[rows, first_dead[rows] - 1]))
            later = self._rng.integers(first_dead[rows], length[rows] + 1)
            parts.append(self._teacher.demonstrate(_states(levels, game, rows, later), self._rng))
        # Anywhere on its way: what it sees that demonstrations do not visit.
        alive_until = np.where(lost, np.maximum(first_dead - 1, 1), length)
        for _ in range(_VISITS):
            somewhere = _states(levels, game, batch, self._rng.integers(0, alive_until))
            on_its_way.append(self._teacher.demonstrate(somewhere, self._rng, judged=self._judged, keep=_KEPT))
        return parts, on_its_way

    def _prioritise(self, planner: LearnedPlanner, samples: Samples) -> Samples:
        """Return the samples on which the planner errs, and a share of the others."""
        return samples.take(errs(planner, samples) | (self._rng.random(len(samples.agent)) < _EASY_SHARE))

    def _first_dead(self, levels: LevelBatch, game: Game) -> NDArray[np.int64]:
        """Return the first time at which the solver proves each level lost, [B]; -1 where it was never lost."""
        batch = np.arange(len(game.moves))
        alive, dead = np.zeros(len(batch), np.int64), np.full(len(batch), MOVE_LIMIT)
        open_ = batch[~game.solved]
        status = self._teacher.judge(_states(levels, game, open_, dead[open_]))
        lost = open_[status == Status.UNSOLVABLE]
        while (pending := lost[dead[lost] - alive[lost] > 1]).size:
            middle = (alive[pending] + dead[pending]) // 2
            gone = self._teacher.judge(_states(levels, game, pending, middle)) == Status.UNSOLVABLE
            dead[pending[gone]] = middle[gone]
            alive[pending[~gone]] = middle[~gone]
        first = np.full(len(batch), -1)
        first[lost] = dead[lost]
        return first


@torch.no_grad()
def errs(planner: LearnedPlanner, samples: Samples) -> NDArray[np.bool_]:
    """Return where a planner prefers a wrong instruction, or misjudges an instruction or a push, bool [S].

    Prioritised sampling in the sense of Schaul et al. (2016), with a threshold for a priority.
    """
    n = len(samples.agent)
    found = np.zeros(n, np.bool_)
    for start in range(0, n, _FORWARD):
        rows = np.arange(start, min(start + _FORWARD, n))
        batch = make_batch(samples.take(rows), np.zeros(len(rows), np.int64))
        batch = batch.to(planner.device)
        with autocast(planner.device):
            output = planner(batch.state)
        wrong = batch.right.any(1) & ~batch.right.gather(1, output.policy.argmax(1, keepdim=True))[:, 0]
        wrong |= _misjudged(output.dead, batch.dead, batch.dead_known)
        if output.push_dead is not None:
            wrong |= _misjudged(output.push_dead, batch.push_dead, batch.push_known)
        found[rows] = wrong.cpu().numpy()
    return found


def _misjudged(logit: Tensor, dead: Tensor, known: Tensor) -> Tensor:
    """Return in which states a known verdict is off by more than the tolerance, [B] from three of [B, ...]."""
    off = (torch.sigmoid(logit.float()) - dead.float()).abs() > _TOLERANCE
    return (off & known).flatten(1).any(1)


def _states(levels: LevelBatch, game: Game, rows: NDArray[np.int64], times: NDArray[np.int64]) -> LevelBatch:
    """Return the states of levels `rows` before their instruction number `times`."""
    return take_levels(levels, rows)._replace(boxes=game.boxes[rows, times], player=game.player[rows, times])
