"""Dead reckoning from proprioception, seen from the instruction in force: inputs of control termination (paper C.4).

Termination has to say whether the robot is within a tenth of a cell of a cell's centre, without being told its pose.
Velocity and heading are felt, so how far the robot has come since its episode began at a cell's centre can be summed
up; the camera corrects the drift. Everything is turned so that the instruction points along +x, since
what completes an instruction does not depend on the compass. A body that does not feel its heading is told it by its
frames (`bearings`).

Shapes: B robots, T ticks, P proprioceptive values.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import torch
from torch import Tensor

from mujoban_core.bodies import Body
from mujoban_core.grid import INSTRUCTION_LIMIT, OFFSETS_XY, turn_to_instruction
from mujoban_rl.dead_reckoning import displacement, map_velocity
from mujoban_rl.sight.skyline import unit

FEATURES: Final = 24
"""Features of a tick beside raw proprioception; see `Odometry.forward`."""
_BEHIND: Final = 0.2
"""After a push the robot stands up to half a cell ahead of its cell's centre, never behind it: the cell is rounded
from this far behind, in cells."""


class Track(NamedTuple):
    """What dead reckoning remembers; lengths in cells."""

    position: Tensor
    """Since the start of the episode, [B, 2] in the map's axes."""
    velocity: Tensor
    """Of the tick before, [B, 2], cells per second."""
    start: Tensor
    """Position when the instruction in force was issued, [B, 2]."""
    origin: Tensor
    """Centre of the cell from which it counts, [B, 2]."""
    elapsed: Tensor
    """Ticks since it was issued, [B]."""
    direction: Tensor
    """Unit vector of the instruction in force, [B, 2]; zero for `stay`."""
    before: Tensor
    """That of the instruction before it, [B, 2]."""
    heading: Tensor
    """Felt, or seen, [B] radians."""

    def after(self) -> Track:
        """Return the last of the tracks of ticks, [B, ...] of [B, T, ...]."""
        return Track(*(part[:, -1] for part in self))


class Odometry:
    """Turns proprioception into features of progress; has no weights."""

    def __init__(self, body: Body) -> None:
        """Read a body's layout of proprioception."""
        self.body = body
        self.heading = body.heading_index
        self.part = body.proprio

    def initial(self, batch: int, device: torch.device | str = "cpu") -> Track:
        """Return the track of robots at the centre of a cell at the start of an episode."""
        zeros, none = torch.zeros(batch, 2, device=device), torch.zeros(batch, device=device)
        return Track(zeros, zeros, zeros, zeros, none, zeros, zeros, none)

    def __call__(
        self, proprio: Tensor, instruction: Tensor, terminated: Tensor, track: Track
    ) -> tuple[Tensor, Track]:
        """Return features [B, T, FEATURES] and the track after the last tick, of a body that feels its heading.

        Args:
            proprio: o_pr, [B, T, P].
            instruction: A_{t-1}, int64 [B, T].
            terminated: beta_{t-1}, bool [B, T]; A_{t-1} was issued in the tick before where true.
            track: before the first tick.
        """
        tracks = self.follow(proprio, instruction, terminated, track)
        return self.features(proprio, tracks), tracks.after()

    def follow(
        self, proprio: Tensor, instruction: Tensor, terminated: Tensor, track: Track, heading: Tensor | None = None
    ) -> Track:
        """Return the tracks after each tick, [B, T, ...]; arguments as above.

        Args:
            proprio: o_pr.
            instruction: A_{t-1}.
            terminated: beta_{t-1}.
            track: before the first tick.
            heading: in the map frame, radians [B, T]; needed of a body that does not feel it.
        """
        psi = proprio[..., self.heading] if heading is None else heading
        velocity = map_velocity(self.body, proprio, unit(psi))
        offsets = torch.as_tensor(OFFSETS_XY, dtype=proprio.dtype, device=proprio.device)
        return _follow(track, velocity, offsets[instruction], terminated, psi)

    def features(self, proprio: Tensor, track: Track) -> Tensor:
        """Return the features of ticks, [B, T, FEATURES].

        Args:
            proprio: o_pr, [B, T, P].
            track: after each tick, [B, T, ...].
        """
        direction = track.direction
        stay = (direction == 0).all(dim=-1, keepdim=True)
        target = turn(track.origin + direction - track.position, direction)
        home = turn(track.origin - track.position, direction)
        phase = 2 * math.pi * turn(track.position, direction)
        elapsed = track.elapsed[..., None]
        columns = [
            turn(unit(track.heading), direction),  # 2
            turn(track.velocity, direction),  # 2
            self.part.turn_rate(proprio)[..., None] / 4,  # 1
            turn(track.position - track.start, direction).clamp(-2, 2),  # 2
            target.clamp(-2, 2), (target * 5).clamp(-2, 2),  # 4
            home.clamp(-2, 2), (home * 5).clamp(-2, 2),  # 4
            phase.cos(), phase.sin(),  # 4
            turn(track.before, direction),  # 2
            elapsed / INSTRUCTION_LIMIT, (elapsed / 20).clamp(max=2.0), stay.to(proprio.dtype),  # 3
        ]  # fmt: skip
        return torch.cat(columns, dim=-1)


def turn(vector: Tensor, direction: Tensor) -> Tensor:
    """Return vectors of the map in the frame in which an instruction points along +x; all [..., 2].

    Args:
        vector: in the axes of the map.
        direction: unit vector of the instruction; zero for `stay`, whose frame is the map's.
    """
    axis = axis_of(direction)
    turned = turn_to_instruction(vector[..., 0], vector[..., 1], axis[..., 0], axis[..., 1])
    return torch.stack(turned, dim=-1)


def axis_of(direction: Tensor) -> Tensor:
    """Return the unit vectors of the frames of instructions, [..., 2]: their directions; east where they are zero."""
    east = direction.new_tensor([1.0, 0.0])
    return torch.where((direction == 0).all(dim=-1, keepdim=True), east, direction)


def _follow(track: Track, velocity: Tensor, direction: Tensor, terminated: Tensor, heading: Tensor) -> Track:
    """Return the tracks after each tick, [B, T, ...], of a track before the first; all ticks at once."""
    ticks = torch.arange(1, terminated.shape[1] + 1, device=terminated.device)
    # When the instruction in force was issued: 0 before the first tick.
    issued = torch.where(terminated, ticks, torch.zeros_like(ticks))
    if len(ticks) > 1:  # ONNX, in which single ticks are compiled, has no running maximum
        issued = issued.cummax(dim=1).values
    steps = displacement(_behind(track.velocity, velocity), velocity)
    positions = torch.cat([track.position[:, None], steps], dim=1).cumsum(dim=1)
    before = _behind(track.direction, direction)
    origins = torch.round(positions[:, :-1] - _BEHIND * before)
    kept = (track.elapsed[:, None] + ticks).to(track.elapsed.dtype)
    elapsed = torch.where(issued > 0, (ticks - issued + 1).to(kept.dtype), kept)
    return Track(
        positions[:, 1:], velocity, _since(issued, track.start, positions[:, :-1]),
        _since(issued, track.origin, origins), elapsed, direction, _since(issued, track.before, before), heading,
    )  # fmt: skip


def _behind(first: Tensor, values: Tensor) -> Tensor:
    """Return the values of the tick before each, [B, T, 2]."""
    return torch.cat([first[:, None], values[:, :-1]], dim=1)


def _since(issued: Tensor, before: Tensor, values: Tensor) -> Tensor:
    """Return what was true when the instruction in force was issued, [B, T, 2]: `before`, or one of the values."""
    all_values = torch.cat([before[:, None], values], dim=1)
    return all_values.gather(1, issued[..., None].expand(*issued.shape, values.shape[-1]))
