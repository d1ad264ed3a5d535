"""The teacher's own layers in the camera policy, which act on what it guesses of the privileged view.

A teacher learned by reward how to move its body, from features (`goal_features`) of which a robot feels one half by
itself. The other half, the goal, the box and what stands around, is guessed from frames and memory. So the student
need not learn anew how to walk, only to see; what to do where it can't tell, as a correction beside, it learns from the
teacher's torques.

Shapes: B robots, T ticks, M ticks of any robots, F features, P proprioceptive values, U actuators, D privileged
features.
"""

from __future__ import annotations

from typing import Final

import torch
from torch import Tensor, nn
from torch.nn import functional

from mujoban_controller.goal_features import BOX_FRICTION, GRAVITY, NEAR, NEIGHBOURS
from mujoban_controller.orientation import Sides
from mujoban_controller.privileged import PrivilegedPolicy
from mujoban_core.bodies import Body
from mujoban_core.grid import INSTRUCTION_LIMIT
from mujoban_sim.goals import GoalKind

_VECTORS: Final = 6
"""Robot to target, robot to box and box to its target, (along, left) each."""
_KINDS: Final = len(GoalKind) - 1
_AROUND: Final = 2 * NEIGHBOURS
"""Whether a wall, and whether a box, is in each of the cells around."""
_WIDTH: Final = 128
_PARTS: Final = (_VECTORS, 1, _KINDS, _AROUND)
GUESSED: Final = sum(_PARTS)
"""Values that are guessed: vectors, speed of the box, logits of the goal's kind and of what stands around."""
_BETA: Final = 0.05
"""Cells up to which an error's square counts, and beyond which the error does."""
_AROUND_WEIGHT: Final = 0.2


class Skill(nn.Module):
    """Guesses the goal, and acts on the guess by a teacher's layers."""

    low: Tensor
    high: Tensor

    def __init__(self, body: Body, features: int, width: int) -> None:
        """Build it.

        Args:
            body: The robot's.
            features: F.
            width: Of the teacher's layers.
        """
        super().__init__()
        self.guess = nn.Sequential(nn.Linear(features, _WIDTH), nn.ReLU(), nn.Linear(_WIDTH, GUESSED))
        self.teacher = PrivilegedPolicy(body.name, width)
        self._part, self._cell_size, self._sides = body.proprio, body.cell_size, body.symmetry.sides
        self._joints = [j for j, limits in enumerate(body.joint_range) if limits is not None]
        limits = torch.tensor([limits for limits in body.joint_range if limits is not None]).view(-1, 2)
        self.register_buffer("low", limits[:, 0], persistent=False)
        self.register_buffer("high", limits[:, 1], persistent=False)

    def forward(self, guess: Tensor, felt: Tensor, course: Tensor, torque: Tensor, elapsed: Tensor) -> Tensor:
        """Return the mean actions as the side ahead sees them, [M, U].

        Args:
            guess: As `GUESSED` says, [M, `GUESSED`].
            felt: o_pr as the side ahead sees it, [M, P].
            course: The direction of the instruction as this side sees it, (ahead, left), [M, 2].
            torque: That of the tick before, as this side sees it, [M, U].
            elapsed: Ticks since the instruction began, [M, 1].
        """
        at, size = self._part, self._cell_size
        vectors, speed, kind, around = guess.split(_PARTS, -1)
        kind = kind.softmax(-1)
        lane = vectors.unflatten(-1, (3, 2))
        coast = (speed * size).clamp(min=0.0).square() / (2.0 * BOX_FRICTION * GRAVITY * size)
        rest = lane[..., 2, :] - torch.cat([coast, torch.zeros_like(coast)], -1)
        lane = torch.cat([lane, rest[..., None, :]], -2)
        along, left = lane.unbind(-1)
        cos, sin = course[..., :1], course[..., 1:]
        ahead = torch.stack([along * cos - left * sin, along * sin + left * cos], -1)
        posture = felt[..., at.joint_position][..., self._joints]
        parts = [
            (2.0 * posture - self.low - self.high) / (self.high - self.low),
            felt[..., at.joint_velocity],
            torque,
            felt[..., at.linear_velocity] / size,
            felt[..., at.angular_velocity],
            felt[..., at.up_axis],
            self._relative_heading(course, kind[..., int(GoalKind.PUSH)] > 0.5),
            ahead.flatten(-2),
            lane[..., :3, :].flatten(-2),
            (NEAR * lane).clamp(-1.0, 1.0).flatten(-2),
            speed,
            kind,
            elapsed / INSTRUCTION_LIMIT,
            around.sigmoid(),
        ]
        return self.teacher(torch.cat(parts, -1)).mean

    def over(
        self, sides: Sides, guess: Tensor, proprio: Tensor, facing: tuple[Tensor, Tensor, Tensor], terminated: Tensor,
        keep: Tensor, done: Tensor,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """Return the mean torques over sequences, [B, T, U], and what was done last, [B, U + 1].

        Args:
            sides: Of the body.
            guess: [B, T, `GUESSED`].
            proprio: o_pr, [B, T, P].
            facing: Heading, [B, T, 2]; A, int64 [B, T]; and the side ahead, int64 [B, T].
            terminated: beta, bool [B, T].
            keep: 0 where an episode begins, else 1, [B, T, 1].
            done: The torque of the tick before the first, and the ticks that its instruction had had, [B, U + 1].
        """
        heading, instruction, side = facing
        felt, course = sides.felt(proprio, side), sides.relative(heading, instruction, side)
        torque, elapsed = done[:, :-1], done[:, -1:]
        means = []
        for i in range(guess.shape[1]):
            now, begins = side[:, i], terminated[:, i, None] | (keep[:, i] == 0)
            torque, elapsed = torque * keep[:, i], torch.where(begins, 0.0, elapsed + 1.0)
            action = self(guess[:, i], felt[:, i], course[:, i], sides.actions(torque, now), elapsed)
            means.append(sides.torques(action, now))
            # What a robot did is a fact to the next tick, not what it wanted.
            torque = means[-1].detach().clamp(-1.0, 1.0)
        return torch.stack(means, 1), torch.cat([torque, elapsed], -1)

    def _relative_heading(self, course: Tensor, push: Tensor) -> Tensor:
        """Return the course, up to quarter turns for a body with several fronts that does not push."""
        if self._sides == 1:
            return course
        quadrupled = 4.0 * torch.atan2(course[..., 1], course[..., 0])
        nearest = torch.atan2(quadrupled.sin(), quadrupled.cos()) / 4.0
        return torch.where(push[..., None], course, torch.stack([nearest.cos(), nearest.sin()], -1))


def guessed_features(features: Tensor) -> tuple[Tensor, ...]:
    """Return what there is to guess in privileged features, [..., D]: vectors, speed, kinds and what stands around."""
    *_, vectors, _, speed, kind, _, around = features.split(
        (features.shape[-1] - 41, _VECTORS, 8, 1, _KINDS, 1, _AROUND), -1
    )
    return vectors, speed, kind, around


def guess_loss(guess: Tensor, features: Tensor) -> Tensor:
    """Return how far guesses, [..., `GUESSED`], are off privileged features, [..., D]."""
    said = guess.split(_PARTS, -1)
    vectors, speed, kind, around = guessed_features(features)
    off = functional.smooth_l1_loss(said[0], vectors, beta=_BETA) + 0.2 * functional.smooth_l1_loss(said[1], speed)
    kinds = functional.cross_entropy(said[2].flatten(0, -2), kind.flatten(0, -2).argmax(-1))
    stands = functional.binary_cross_entropy_with_logits(said[3], around)
    return off + 0.1 * kinds + _AROUND_WEIGHT * stands
