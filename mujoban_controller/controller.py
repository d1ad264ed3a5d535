"""The controller: camera, proprioception, instruction and termination signal to torques (paper C.3).

A ResNet reads the frame; its features, proprioception, A and beta go into an LSTM; a fully connected head gives
the mean and scale of a normal distribution over torques.

Proprioception holds joint positions, so the network is given sine and cosine of each hinge, as they are and
turned into the frame of the instruction (instructed direction = +x). For the ball, whose steer joint is the
heading, this says at once by how much to turn. A body that does not feel its heading is told it by its gyro and the
frames (`mujoban_rl.sight`).

It is also given dead reckoning: how far the robot has come since the instruction began, which is the sum of the
velocities that it feels. The sum is part of the memory, beside the LSTM's; A, o_pr and beta are all it takes. Where the
robot is within its cell stands in the memory too (`mujoban_rl.sight.place`).

Shape legend: B robots, T ticks, P proprioceptive values, J joints, U actuators, F features, H memory units, D values
of a track.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from mujoban_controller.drivers import ControllerDriver, Driver
from mujoban_controller.policy import GoalPolicy
from mujoban_core.bodies import get_body
from mujoban_core.camera import FRAME_SIZE
from mujoban_core.grid import INSTRUCTION_AXES, OFFSETS_XY, Instruction, turn_to_instruction
from mujoban_core.interfaces import Controller, ControllerInput, Memory
from mujoban_rl.compiled import Compilable
from mujoban_rl.dead_reckoning import displacement, map_velocity
from mujoban_rl.networks import Gaussian, encode_frames, frame_encoder, gaussian, gaussian_layers, rows_of_sky
from mujoban_rl.sight.orientation import NEEDLE, Compass, heading_of
from mujoban_rl.sight.place import PLACE, Place, phases_along, way_left
from mujoban_rl.sight.skyline import unit
from mujoban_rl.ticks import TICK, tick_arrays

INPUT_FIELDS = TICK
"""What the controller sees, as recorded windows name it."""
MEMORY_FIELDS = ("memory0", "memory1", "memory2")
"""Its memory before a tick, `Recurrent`."""
WIDTHS: Final = (24, 32, 48, 64)
"""Channels of the ResNet's stem and of each of its residual blocks."""
FEATURES: Final = 256
"""Width of fully connected layers."""
HIDDEN: Final = 192
"""Width of the LSTM."""
_CLIP = 5.0
_NEAR = 4.0
"""How much closer the way is looked at at its end."""
_WAY = 4
"""Inputs that tell the way left: as it is, and from close by."""
_TRACK = 7
_NEEDLE = _TRACK + NEEDLE


class Recurrent(NamedTuple):
    """What the controller remembers."""

    output: Tensor
    """LSTM output, [B, H]."""
    cell: Tensor
    """LSTM cell, [B, H]."""
    track: Tensor
    """Dead reckoning, [B, 7]; see `dead_reckoning`. Without a felt heading the needle (6) follows, and with `place` its
    needles (4)."""


def memory_of(batch: Mapping[str, Tensor]) -> Recurrent:
    """Return the memory with which the controller went into windows, [M, ...]."""
    return Recurrent(*(batch[name][:, 0] for name in MEMORY_FIELDS))


def dead_reckoning(track: Tensor, velocity: Tensor, moved: Tensor, terminated: Tensor) -> Tensor:
    """Return the track after one more tick, [B, 7].

    It holds the displacement since the instruction in force began (2), that during the instruction before (2), the
    velocity of this tick (2), all in the map's frame, and whether there is one (1).

    Args:
        track: Before the tick, [B, 7]; zeros at an episode's start.
        velocity: In the map's frame in cells per second, [B, 2].
        moved: Displacement since the tick before, [B, 2].
        terminated: Whether a new instruction begins with this tick, [B].
    """
    since, before, known = track[:, :2] + moved, track[:, 2:4], track[:, 6:]
    new = terminated[:, None]
    before = torch.where(new, since, before)
    since = torch.where(new, torch.zeros_like(since), since)
    return torch.cat([since, before, velocity, torch.ones_like(known)], -1)


class Sight(NamedTuple):
    """What frames show of the robot's pose."""

    heading: Tensor | None
    """[..., `SIGHT`]; None for a body that feels it."""
    place: Tensor | None
    """Phases within the cell, [..., `PLACE`]; None for a network that has no `place`."""

    def over(self, batch: int, ticks: int) -> Sight:
        """Return what M = B T frames show as sequences, [B, T, ...]."""
        return Sight(*(x if x is None else x.view(batch, ticks, -1) for x in self))

    def at(self, tick: int) -> Sight:
        """Return what the frames of a tick show, [B, ...]."""
        return Sight(*(x if x is None else x[:, tick] for x in self))


class ControllerOutput(NamedTuple):
    """Result of `VisuomotorController.forward`."""

    action: Gaussian
    """Distribution over torques; mean and scale [B, T, U]."""
    features: Tensor
    """What the action rests on, [B, T, H + F]; auxiliary losses attach here."""
    shown: Sight
    """What each frame shows, [B, T, ...]."""
    heading: Tensor | None
    """Unit vectors in which the robots face as far as is known, [B, T, 2]; None for a body that feels it."""
    place: Tensor | None
    """The needles of `place`, [B, T, `PLACE`], if there are any."""
    memory: Recurrent
    """Memory after the last tick."""


class VisuomotorController(Compilable, GoalPolicy, Controller):
    """The learned controller of paper C.3; sees o_cam, o_pr, A and beta and nothing else.

    As a `Controller` it is deterministic: the mean torque, limited to [-1, 1].
    """

    file_name = "controller"
    axes: Tensor
    steps: Tensor
    proprio_mean: Tensor
    proprio_scale: Tensor

    def __init__(
        self,
        body: str = "ball",
        channels: Sequence[int] = WIDTHS,
        features: int = FEATURES,
        hidden: int = HIDDEN,
        place: bool = False,
        way: bool = False,
    ) -> None:
        """Build the network for a body.

        Args:
            body: Key in `mujoban_core.bodies.BODIES`; fixes P and U.
            channels: Width of the stem and of each residual block.
            features: F, width of the fully connected layers.
            hidden: H, width of the LSTM.
            place: Keep where the robot is within its cell. Weights without a word about it do not.
            way: Work out from it and from dead reckoning how far it is to where the instruction leads; dito.

        Raises:
            ValueError: If the body is unknown, the widths are not what `frame_encoder` takes, or there is no place for
                a way to begin at.
        """
        super().__init__()
        layout = self.layout = get_body(body)
        if way and not place:
            raise ValueError("way without place: how far it is follows from where it is; expected both")
        self.config = {
            "body": body, "channels": list(channels), "features": features, "hidden": hidden, "place": place,
            "way": way,
        }  # fmt: skip
        self.body = body
        self.mixed_precision = False
        """Whether the ResNet may compute in bfloat16: in training, not on the robot, so that runs repeat exactly."""
        self.joints = len(layout.joints)
        self.proprio_size, self.action_size, self.hidden = layout.proprio_size, layout.action_size, hidden
        self.heading_index = layout.heading_index
        self.part = layout.proprio
        self.register_buffer("axes", torch.tensor(INSTRUCTION_AXES, dtype=torch.float32), persistent=False)
        self.compass = Compass(layout, features) if self.heading_index is None else None
        self.register_buffer("steps", torch.tensor(OFFSETS_XY, dtype=torch.float32), persistent=False)
        self.place, self.way = Place(features) if place else None, way
        # Where the heading is felt, joint positions are replaced by two sine-cosine pairs; else where the instruction
        # leads is told, as the robot sees it. A is one-hot, beta one bit.
        angles = 3 * self.joints if self.compass is None else 2
        inputs = self.proprio_size + angles + len(Instruction) + 1 + _TRACK - 1 + PLACE * place + _WAY * way
        shrink = 2 ** (len(channels) - 1)
        # Who does not feel the heading has to look at the skyline.
        self.first_row = rows_of_sky(layout.camera, shrink) if self.compass is None else 0
        self.encoder = frame_encoder(channels, features, FRAME_SIZE - self.first_row)
        self.body_encoder = nn.Sequential(nn.Linear(inputs, features), nn.LayerNorm(features), nn.ReLU())
        self.mix = nn.Sequential(nn.Linear(2 * features, features), nn.ReLU())
        self.lstm = nn.LSTMCell(features, hidden)
        self.trunk = nn.Sequential(nn.Linear(hidden + features, features), nn.ReLU())
        self.mean, self.scale = gaussian_layers(features, self.action_size)
        self.register_buffer("proprio_mean", torch.zeros(self.proprio_size))
        self.register_buffer("proprio_scale", torch.ones(self.proprio_size))
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

    @property
    def fitted(self) -> bool:
        """Whether inputs are normalised by data, which fresh weights have not seen."""
        return not bool((self.proprio_scale == 1.0).all())

    def fit_normalisation(self, proprio: Tensor) -> None:
        """Take mean and deviation of proprioceptive samples, [M, P], for the normalisation of inputs."""
        self.proprio_mean.copy_(proprio.mean(0))
        self.proprio_scale.copy_(proprio.std(0).clamp(min=1e-2))

    def normalise(self, batch: Mapping[str, Tensor]) -> None:
        """Fit the normalisation to the first windows [M, W, ...] that are finite, once."""
        if not self.fitted and bool(torch.isfinite(batch["proprio"]).all()):
            self.fit_normalisation(batch["proprio"].flatten(0, 1))

    def encode(self, frame: Tensor) -> Tensor:
        """Return the ResNet's features [M, F] of frames uint8 [M, 64, 64, 3]."""
        seen, dtype = frame[:, self.first_row :], self.mean.weight.dtype
        return encode_frames(self.encoder, seen, dtype, mixed_precision=self.mixed_precision)

    def read(self, frame: Tensor, features: Tensor, proprio: Tensor) -> Sight:
        """Return what frames [M, 64, 64, 3] with features [M, F] show; o_pr is [M, P]."""
        heading = None if self.compass is None else self.compass.read(frame, features, proprio)
        return Sight(heading, None if self.place is None else self.place.read(features))

    def reckon(self, proprio: Tensor, terminated: Tensor, track: Tensor, shown: Sight) -> Tensor:
        """Return the track after one more tick, [B, D].

        Args:
            proprio: o_pr, [B, P].
            terminated: beta, bool [B].
            track: Before the tick; zeros at an episode's start.
            shown: What the frame shows.
        """
        before = track[:, :_TRACK]
        if self.compass is None or shown.heading is None:
            heading, needles = unit(proprio[:, self.heading_index]), []
        else:
            needles = [self.compass(shown.heading, proprio, track[:, _TRACK:_NEEDLE])]
            heading = heading_of(*needles)
        velocity = map_velocity(self.layout, proprio, heading)
        # An episode's first tick has nothing to come from.
        moved = displacement(before[:, 4:6], velocity) * before[:, 6:]
        parts = [dead_reckoning(before, velocity, moved, terminated), *needles]
        if self.place is not None and shown.place is not None:
            parts.append(self.place(shown.place, heading, moved, track[:, -PLACE:]))
        return torch.cat(parts, -1)

    def heading(self, track: Tensor) -> Tensor | None:
        """Return the unit vectors in which robots face by their tracks, [..., 2]; None of a body that feels it."""
        return None if self.compass is None else heading_of(track[..., _TRACK:_NEEDLE])

    def embed(
        self, proprio: Tensor, instruction: Tensor, terminated: Tensor, track: Tensor, heading: Tensor | None
    ) -> Tensor:
        """Return the encoding of all inputs but the frame, [M, F].

        Args:
            proprio: o_pr, [M, P].
            instruction: A, int64 [M].
            terminated: beta, bool [M].
            track: Dead reckoning and what goes with it, [M, D].
            heading: What `heading` says of it, [M, 2].
        """
        part = self.part
        normal = self._normal(proprio)
        # Shape [M, 1] each.
        x, y = (v[:, None] for v in self.axes[instruction].unbind(-1))
        if heading is None:
            angle = proprio[:, part.joint_position]
            parts = [normal[:, part.inertial], normal[:, part.joint_velocity], normal[:, part.up_axis]]
            parts += [angle.cos(), angle.sin(), *turn_to_instruction(angle.cos(), angle.sin(), x, y)]
        else:
            parts = [normal, *turn_to_instruction(x, y, heading[:, :1], heading[:, 1:])]
        # Positions are clipped like the rest: a robot that is stuck for long must not drown everything else.
        parts += turn_to_instruction(track[:, 0:6:2].clamp(-3, 3), track[:, 1:6:2].clamp(-3, 3), x, y)
        if self.place is not None:
            parts.append(phases_along(track[:, -PLACE:], torch.cat([x, y], -1)))
        if self.way:
            way = way_left(track[:, -PLACE:], track[:, :2], self.steps[instruction])
            way = torch.cat(turn_to_instruction(way[:, :1], way[:, 1:], x, y), -1)
            parts += [way.clamp(-2, 2), (_NEAR * way).clamp(-1, 1)]
        parts += [functional.one_hot(instruction, len(Instruction)), terminated[:, None]]
        return self.body_encoder(torch.cat([p.to(proprio.dtype) for p in parts], -1))

    def _normal(self, proprio: Tensor) -> Tensor:
        return ((proprio - self.proprio_mean) / self.proprio_scale).clamp(-_CLIP, _CLIP)

    def forward(
        self,
        frame: Tensor,
        proprio: Tensor,
        instruction: Tensor,
        terminated: Tensor,
        memory: Recurrent,
        first: Tensor | None = None,
    ) -> ControllerOutput:
        """Run the policy over sequences.

        Args:
            frame: o_cam, uint8 [B, T, 64, 64, 3].
            proprio: o_pr, [B, T, P].
            instruction: A, int64 [B, T].
            terminated: beta, bool [B, T].
            memory: Before the first tick.
            first: Ticks before which an episode begins and the memory is cleared, bool [B, T].
        """
        b, t = instruction.shape
        keep = torch.ones_like(proprio[..., :1]) if first is None else (~first[..., None]).to(proprio.dtype)
        h, c, track = memory
        seen = self.encode(frame.flatten(0, 1))
        shown = self.read(frame.flatten(0, 1), seen, proprio.flatten(0, 1)).over(b, t)
        tracks = []
        for i in range(t):
            past = track * keep[:, i]
            track = self.reckon(proprio[:, i], terminated[:, i], past, shown.at(i))
            tracks.append(track)
        tracked = torch.stack(tracks, 1).flatten(0, 1)
        heading = self.heading(tracked)
        felt = self.embed(proprio.flatten(0, 1), instruction.flatten(), terminated.flatten(), tracked, heading)
        # Shape [B, T, F].
        mixed = self.mix(torch.cat([seen, felt], -1)).view(b, t, -1)
        outputs = []
        for i in range(t):
            h, c = self.lstm(mixed[:, i], (h * keep[:, i], c * keep[:, i]))
            outputs.append(h)
        features = torch.cat([torch.stack(outputs, 1), mixed], -1)
        tracked = tracked.view(b, t, -1)
        heading = heading if heading is None else heading.view(b, t, -1)
        place = None if self.place is None else tracked[..., -PLACE:]
        return ControllerOutput(self.distribution(features), features, shown, heading, place, Recurrent(h, c, track))

    def over_windows(self, batch: Mapping[str, Tensor], skipped: int) -> Gaussian:
        """Return the distributions in the ticks of windows [M, W, ...] from number `skipped` on, [M, W - n, U].

        The skipped ticks are played too, so that the memory is what these weights make of them.
        """
        whole = self(*(batch[name] for name in INPUT_FIELDS), memory_of(batch), batch["first"]).action
        return Gaussian(whole.mean[:, skipped:], whole.scale[:, skipped:])

    def driver(self) -> Driver:
        """Return a driver by the mean torques, with a memory of its own."""
        return ControllerDriver(self)

    def distribution(self, features: Tensor) -> Gaussian:
        """Return the distribution over torques given `ControllerOutput.features`, [B, T, ...]."""
        x = self.trunk(features)
        return gaussian(self.mean(x), self.scale(x))

    def initial_memory(self, batch: int) -> Memory:
        """Return zeros, a `Recurrent`."""
        device = self.device
        track = (_TRACK if self.compass is None else _NEEDLE) + (0 if self.place is None else PLACE)
        return Recurrent(*(torch.zeros(batch, n, device=device) for n in (self.hidden, self.hidden, track)))

    @torch.inference_mode()
    def step(self, inputs: ControllerInput, state: Memory) -> tuple[NDArray[np.float32], Memory]:
        """Return the mean torque limited to [-1, 1], [B, U], and the next memory."""
        arrays = tick_arrays(inputs)
        if self.compiled is not None and len(inputs.frame) == 1:
            torque, *memory = self.compiled([*arrays, *(part.numpy() for part in state)])
            return torque, Recurrent(*map(torch.from_numpy, memory))
        torque, *memory = self.tick(*(torch.from_numpy(a).to(self.device) for a in arrays), *state)
        return torque.cpu().numpy(), Recurrent(*memory)

    def tick(
        self, frame: Tensor, proprio: Tensor, instruction: Tensor, terminated: Tensor, output: Tensor, cell: Tensor,
        track: Tensor,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        """Return the mean torque limited to [-1, 1], [B, U], and the three parts of the next memory.

        It is what `export.export` exports, hence tensors alone: those of `forward` in one tick, [B, ...],
        and the parts of `Recurrent`.
        """
        sequences = (x.unsqueeze(1) for x in (frame, proprio, instruction, terminated))
        result = self.forward(*sequences, memory=Recurrent(output, cell, track))
        return (result.action.mean[:, 0].clamp(-1.0, 1.0), *result.memory)

    def to_tensors(self, inputs: ControllerInput) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return one tick's observations, [B, ...], as sequences of one tick, [B, 1, ...], on the module's device."""
        tensors = (torch.from_numpy(a).to(self.device).unsqueeze(1) for a in tick_arrays(inputs))
        frame, proprio, instruction, terminated = tensors
        return frame, proprio, instruction, terminated

