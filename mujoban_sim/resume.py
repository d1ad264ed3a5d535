"""What a simulator that was killed goes on from: the tick that it had offered last, to the last bit of its world."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

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


class MomentFile:
    """Keeps the latest moment of a run for the process that comes after this one.

    What is written survives the process, not the machine: nothing waits for the disk.
    """

    def __init__(self, path: Path) -> None:
        """Keep it in a file, whose folder exists."""
        self._path = path
        self._partial = path.with_name(f".{path.name}.part")

    def write(self, moment: Moment) -> None:
        """Replace the file, whole or not at all."""
        arrays = {name: np.ascontiguousarray(array) for name, array in moment.world.items()}
        arrays[_PLACE], arrays[_TORQUE] = np.array(moment.place, np.int64), moment.torque
        self._partial.write_bytes(save(arrays))
        self._partial.replace(self._path)

    def read(self) -> Moment | None:
        """Return the moment, or None if there is none yet.

        Raises:
            ValueError: If the file is none of these.
        """
        if not self._path.is_file():
            return None
        try:
            arrays = load(self._path.read_bytes())
            return Moment(Place(*arrays.pop(_PLACE).tolist()), arrays.pop(_TORQUE), arrays)
        except (SafetensorError, KeyError, TypeError) as error:
            raise ValueError(f"{self._path}: expected the moment of a run: {error}") from None
