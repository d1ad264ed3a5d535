"""Playing levels under the abstract rules with any planner, many levels at once.

Shapes: B levels, K boxes, N = `grid.GRID_SIZE`, T decisions at most.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mujoban_core.interfaces import Planner, put_rows, take_rows
from mujoban_planner.abstract_env import MOVE_LIMIT
from mujoban_planner.boards import abstract_states, take_levels
from mujoban_rl.precision import autocast
from mujoban_sokoban import rules
from mujoban_sokoban.levels import LevelBatch


class Game(NamedTuple):
    """How levels were played."""

    moves: NDArray[np.int64]
    """Instructions until solved, [B]; -1 where the level was not solved."""
    instructions: NDArray[np.int64]
    """Instructions issued, [B, T]; -1 after the end."""
    decisions: int
    """Decisions taken altogether."""
    boxes: NDArray[np.int64]
    """Boxes before each instruction, [B, T + 1, K, 2]; constant after the end."""
    player: NDArray[np.int64]
    """Player before each instruction, [B, T + 1, 2]."""

    @property
    def solved(self) -> NDArray[np.bool_]:
        """Whether each level was solved, [B]."""
        return self.moves >= 0


def play(
    planner: Planner,
    levels: LevelBatch,
    *,
    limit: int = MOVE_LIMIT,
    exploration: float = 0.0,
    rng: np.random.Generator | None = None,
    reduced_precision: bool = False,
) -> Game:
    """Let a planner play levels from the given states until solved or for `limit` instructions.

    Args:
        planner: Any planner; each level is an episode of its own.
        levels: Starts, or any states.
        limit: T.
        exploration: Probability of a random move in place of the decision; needs `rng`.
        rng: Source of exploration.
        reduced_precision: Run a network in bfloat16, where that pays for large batches.
    """
    batch = len(levels.player)
    moves = np.full(batch, -1, np.int64)
    instructions = np.full((batch, limit), -1, np.int64)
    box_history = np.repeat(levels.boxes[:, None], limit + 1, axis=1)
    player_history = np.repeat(levels.player[:, None], limit + 1, axis=1)
    active = np.arange(batch)
    memory = planner.initial_state(np.zeros(batch, np.int64)).memory
    decisions = 0
    for t in range(limit):
        with autocast(getattr(planner, "device", "cpu"), enabled=reduced_precision):
            decision, after = planner.decide(abstract_states(levels), take_rows(memory, active))
        memory = put_rows(memory, active, after)
        decisions += len(active)
        if exploration > 0.0:
            assert rng is not None
            chance = rng.random(len(active)) < exploration
            decision = np.where(chance, rng.integers(1, 5, len(active)), decision)
        result = rules.apply(*levels, decision)
        levels = levels._replace(boxes=result.boxes, player=result.player)
        instructions[active, t] = decision
        box_history[active, t + 1 :] = result.boxes[:, None]
        player_history[active, t + 1 :] = result.player[:, None]
        moves[active[result.solved]] = t + 1
        going = ~result.solved
        if not going.any():
            break
        active, levels = active[going], take_levels(levels, going)
    return Game(moves, instructions, decisions, box_history, player_history)
