"""What a simulator that was killed goes on from: the tick that it had offered last, to the last bit of its world."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

_PLACE = "place"
"""Key of the arrays that hold a `Place`."""
_TORQUE = "held torque"


class Place(NamedTuple):
    """Where in a run a simulator is."""

    index: int = 0
    """Episode of the run that is being played."""
    starts: int = 0
    """Episodes started so far: the number of the episode in its messages."""
    stamp: int = 0
    """Simulated time of the tick that was offered last [ns]."""
    sequence: int = 0
    """Of the instruction in force."""
    direction: int = 0
    """Of the instruction in force."""


class Moment(NamedTuple):
    """A place, and the world there."""

    place: Place
    torque: NDArray[np.float32]
    """Held torque, [U]."""
    world: dict[str, Any]
    """See `World.snapshot`."""

    def arrays(self) -> dict[str, Any]:
        """Return it as arrays by name."""
        return {**self.world, _PLACE: np.array(self.place, np.int64), _TORQUE: self.torque}

    @classmethod
    def of(cls, arrays: dict[str, Any]) -> Moment:
        """Return the moment that `arrays` returned; a KeyError or TypeError says that they are those of none."""
        world = dict(arrays)
        return cls(Place(*world.pop(_PLACE).tolist()), world.pop(_TORQUE), world)
