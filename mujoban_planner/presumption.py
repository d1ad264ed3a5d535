"""When a state that a search leaves open may count as dead, though nobody has proved it."""

from __future__ import annotations

from typing import Final

import numpy as np

from mujoban_rl.engine import State

_MEMORY: Final = 0.998
"""What a count keeps of itself when one more search of its kind ends."""


class Presumption:
    """Estimates how often a search that ends without a solution, and without a proof, misses one.

    Levels can be solved, so those that stay unsolved after all tries tell how often searches miss a solution. If that
    share is m, and of the searches from other states a share s is solved and a share o left open, then s m / (1 - m)
    are expected to be missed: that part of o is alive, and the rest is dead.
    """

    def __init__(self, tries: int) -> None:
        """Know nothing yet.

        Args:
            tries: How often a level is tried, with ever more evaluations; other states are searched as in the last try.
        """
        self._levels = np.zeros((tries, 2))
        self._solved = self._open = 0.0

    def note_level(self, failures: int, *, solved: bool) -> None:
        """Take note of how a try ended, of a level that was tried in vain so often before."""
        counts = self._levels[failures]
        counts *= _MEMORY
        counts += (not solved, 1.0)

    def note_state(self, *, solved: bool) -> None:
        """Take note of how a search from another state ended, unless it proved the state dead."""
        self._solved = _MEMORY * self._solved + solved
        self._open = _MEMORY * self._open + (not solved)

    @property
    def missed(self) -> float:
        """Share of levels that stay unsolved after all tries; 1 where nothing is known."""
        unsolved, tried = self._levels.T
        return float(np.prod((unsolved + 1.0) / (tried + 1.0)))

    @property
    def error(self) -> float:
        """Share of states left open that are expected to be alive; 1 where nothing is known."""
        missed = self.missed
        if missed >= 1.0 or not self._open:
            return 1.0
        return min(1.0, self._solved * missed / (1.0 - missed) / self._open)

    def state(self) -> State:
        """Return all counts."""
        return State({"levels": self._levels.tolist(), "solved": self._solved, "open": self._open})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        self._levels = np.array(state.values["levels"])
        self._solved, self._open = state.values["solved"], state.values["open"]
