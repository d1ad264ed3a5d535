"""Where a body that does not feel its heading faces, and where in its cell it is, for control termination (paper C.4).

The frames tell it (`mujoban_rl.sight`), and needles keep it, as in the controller: with a heading in the map,
velocities that are felt sum up along the axes in which instructions are given, and the place says how far it is to the
middle of the cell to which they lead.

Shapes: B robots, T ticks, M frames, P proprioceptive values, K values that are read.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import torch
from torch import Tensor, nn

from mujoban_core.bodies import Body
from mujoban_estimator.odometry import Odometry, Track, axis_of, turn
from mujoban_rl.sight.orientation import NEEDLE, SIGHT, Compass, heading_of, needle_towards, sight_loss
from mujoban_rl.sight.place import PLACE, Place, phases, phases_along, place_loss, way_left

NEEDLES: Final = NEEDLE + PLACE
"""Values of the needles: of the heading, and of the place within the cell."""
BEARINGS: Final = PLACE + 4
"""Features of a tick that they add: phases along the instruction, the way left, and the same from close by."""
_WIDTH: Final = 128
_NEAR: Final = 5.0


class Bearings(nn.Module):
    """Reads heading and place from frames, and keeps them."""

    def __init__(self, body: Body, seen: int) -> None:
        """Read from so many values of a frame."""
        super().__init__()
        self._part, self._cell_size = body.proprio, body.cell_size
        self.encoder = nn.Sequential(nn.Linear(seen, _WIDTH), nn.ReLU())
        self.compass = Compass(body, _WIDTH)
        self.place = Place(_WIDTH)

    def read(self, frame: Tensor, seen: Tensor, proprio: Tensor) -> Tensor:
        """Return what frames show, [M, K].

        Args:
            frame: o_cam, uint8 [M, 64, 64, 3].
            seen: What the ResNet made of it, flat.
            proprio: o_pr, [M, P].
        """
        features = self.encoder(seen)
        return torch.cat([self.compass.read(frame, features, proprio), self.place.read(features)], -1)

    def loss(self, shown: Tensor, pose: Tensor) -> Tensor:
        """Return how far what frames show, [M, K], is off poses (x [m], y [m], psi) in the map frame, [M, 3]."""
        heading, place = shown.split((SIGHT, PLACE), -1)
        return sight_loss(heading, pose[..., 2]) + place_loss(place, pose, self._cell_size)

    def initial(self, batch: int, device: torch.device | str = "cpu") -> Tensor:
        """Return the needles at the start of an episode, zeros [B, NEEDLES]."""
        return torch.zeros(batch, NEEDLES, device=device)

    def pointing(self, pose: Tensor) -> Tensor:
        """Return needles that have come to show poses (x [m], y [m], psi) in the map frame, [B, NEEDLES]."""
        return torch.cat([needle_towards(pose[:, 2]), phases(pose, self._cell_size)], -1)

    def headings(self, shown: Tensor, proprio: Tensor, needles: Tensor) -> Tensor:
        """Return the needles of the heading after each tick, [B, T, NEEDLE]; arguments as in `follow`."""
        needle, after = needles[:, :NEEDLE], []
        for t in range(shown.shape[1]):
            needle = self.compass(shown[:, t, :SIGHT], proprio[:, t], needle)
            after.append(needle)
        return torch.stack(after, 1)

    def places(self, shown: Tensor, heading: Tensor, moved: Tensor, needles: Tensor) -> Tensor:
        """Return the needles of the place after each tick, [B, T, PLACE].

        Args:
            shown: What the frames show, [B, T, K].
            heading: Unit vectors in which the robots face, [B, T, 2].
            moved: Displacement in each tick in the axes of the map, in cells, [B, T, 2].
            needles: Before the first tick.
        """
        place, after = needles[:, NEEDLE:], []
        for t in range(shown.shape[1]):
            place = self.place(shown[:, t, SIGHT:], heading[:, t], moved[:, t], place)
            after.append(place)
        return torch.stack(after, 1)


class Progress(NamedTuple):
    """What is known of the way to where an instruction leads."""

    features: Tensor
    """[B, T, `FEATURES`], with `BEARINGS` more of them for a body that does not feel its heading."""
    track: Track
    """After the last tick."""
    needles: tuple[Tensor, ...]
    """After the last tick: one, [B, NEEDLES], or none."""


@torch.no_grad()
def follow(
    bearings: Bearings, odometry: Odometry, shown: Tensor, proprio: Tensor, instruction: Tensor, terminated: Tensor,
    track: Track, needles: Tensor,
) -> Progress:  # fmt: skip
    """Return the progress of robots that find their heading by sight. No gradient passes: poses teach what is shown.

    Args:
        bearings: What keeps the needles.
        odometry: What sums up velocities.
        shown: What the frames show, [B, T, K].
        proprio: o_pr, [B, T, P].
        instruction: A_{t-1}, int64 [B, T].
        terminated: beta_{t-1}, bool [B, T].
        track: Before the first tick.
        needles: Before the first tick, [B, NEEDLES].
    """
    compass = bearings.headings(shown, proprio, needles)
    heading = heading_of(compass)
    tracks = odometry.follow(proprio, instruction, terminated, track, torch.atan2(heading[..., 1], heading[..., 0]))
    moved = tracks.position - torch.cat([track.position[:, None], tracks.position[:, :-1]], 1)
    place = bearings.places(shown, heading, moved, needles)
    way = turn(way_left(place, tracks.position - tracks.start, tracks.direction), tracks.direction)
    more = [phases_along(place, axis_of(tracks.direction)), way.clamp(-2, 2), (_NEAR * way).clamp(-2, 2)]
    features = torch.cat([odometry.features(proprio, tracks), *more], -1)
    return Progress(features, tracks.after(), (torch.cat([compass, place], -1)[:, -1],))
