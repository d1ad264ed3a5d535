"""Distillation of a privileged teacher into the camera policy, on the policy's own visited states.

DAgger (Ross et al. 2011): the student acts, the teacher says what it would have done, and the student learns to do
the same from what it can see. Auxiliary heads, which do not ship, make its memory tell the goal's kind and how
far robot and box are from their targets; that is the part of the teacher's view that the student has to infer.

Shapes: B robots, W ticks of a window, M windows of a batch, U actuators, F features.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from mujoban_controller.controller import INPUT_FIELDS, ControllerOutput, VisuomotorController, memory_of
from mujoban_controller.drivers import Driver
from mujoban_controller.goal_features import GOAL_SIZE, goal_offsets
from mujoban_controller.goal_task import GoalTask
from mujoban_controller.play import Batch, CameraPlayer, Fields, put_on
from mujoban_controller.product import ProductLearner, Validation
from mujoban_core.grid import Instruction
from mujoban_core.interfaces import ControllerInput
from mujoban_core.ranges import check_counts, check_not_negative, check_positive, check_shares
from mujoban_rl.engine import Scalars, State
from mujoban_rl.limits import NaNGuard
from mujoban_rl.optimise import ProgressSchedule, guarded_step, moving_average, warm_up_cosine
from mujoban_rl.sight.orientation import sight_loss
from mujoban_rl.sight.place import cells_off, place_loss
from mujoban_rl.sight.skyline import unit
from mujoban_sim.goals import GoalKind

_KINDS = len(GoalKind) - 1
_KEPT = 0.9
"""Share of the wandering torques that stays from tick to tick."""


@dataclass(frozen=True)
class DistilConfig:
    """Settings of distillation."""

    window: int = 8
    """W, ticks of a window."""
    windows: int = 16
    """M, windows of a batch."""
    sequence: int = 8
    """Ticks of a sequence in the replay, at least W."""
    replay: int = 64_000
    """Frames in the replay."""
    first: int = 2_000
    """Frames before the first update."""
    reuse: float = 3.0
    """Times that each frame is learned from, on average."""
    warm_up: int = 60_000
    """Frames over which the share of rows that the teacher drives falls from one to `guided`."""
    guided: float = 0.2
    """Share of rows that the teacher drives, with torques that wander: places that a student needs to tell
    apart before it is good, and has left behind once it is."""
    wander: float = 0.3
    """Standard deviation of the wandering part of these torques."""
    noise: float = 0.1
    """Deviation of the noise on the torques of a third of the other rows, which shows the student more states."""
    learning_rate: float = 1e-3
    """Largest learning rate."""
    warm_up_share: float = 0.01
    """Share of the budget over which the learning rate rises; it falls by a cosine after that."""
    clip: float = 5.0
    """Largest norm of the gradient."""
    goal_weight: float = 0.5
    """Weight of what the auxiliary head tells of how far robot and box have to go."""
    kind_weight: float = 0.05
    """Weight of what it tells of the goal's kind."""
    heading_weight: float = 1.0
    """Weight of what frames show of the heading, for a body that does not feel its own."""
    place_weight: float = 1.0
    """Weight of what frames show of the place within a cell."""
    infeasible_weight: float = 1.0
    """Weight of the torques under an instruction towards a wall or a blocked box. Below 1, a student in doubt whether
    a push is possible tries it: the loss is nearly absolute, so it acts from this share of the odds on."""
    jitter: float = 0.25
    """Largest relative change of each colour's brightness, drawn anew for each sequence."""
    average: float = 0.998
    """Decay of the weights' moving average, which is what ships."""

    skipped = 0
    """Ticks of a window in which nothing is learned."""

    def __post_init__(self) -> None:
        """Reject numbers with which nothing is learned, and windows that no sequence holds."""
        check_counts(self, "window", "windows", "replay")
        check_counts(self, "first", "warm_up", least=0)
        check_shares(self, "guided", "warm_up_share", "jitter", "average")
        check_positive(self, "reuse", "learning_rate", "clip")
        weights = ("goal_weight", "kind_weight", "heading_weight", "place_weight", "infeasible_weight")
        check_not_negative(self, "wander", "noise", *weights)
        if self.sequence < self.window:
            raise ValueError(f"sequence is {self.sequence}: expected at least the ticks of a window, {self.window}")


class GoalHead(nn.Module):
    """Auxiliary prediction of the goal's kind and offsets from the policy's features."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(features, 128), nn.ReLU(), nn.Linear(128, GOAL_SIZE + _KINDS))

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return goal offsets in cells, [..., 4], and logits of the kind, [..., 3], from [..., F]."""
        return self.layers(features).split((GOAL_SIZE, _KINDS), -1)


def imitation_loss(
    output: ControllerOutput, head: GoalHead, batch: Mapping[str, Tensor], config: DistilConfig, cell_size: float
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return loss and statistics of a batch of windows [M, W]; the edge of a cell is in metres."""
    mean, scale = output.action
    label = batch["label"]
    blocked = (batch["kind"] == GoalKind.HOLD) & (batch["instruction"] != Instruction.STAY)
    weight = torch.where(blocked, config.infeasible_weight, 1.0)[..., None]
    action = (weight * functional.smooth_l1_loss(mean, label, beta=0.1, reduction="none")).mean()
    # The scale learns how far the teacher's torques stray from the mean, and does not move the mean.
    teachers = torch.distributions.Normal(mean.detach(), scale, validate_args=False)
    spread = -teachers.log_prob(label).clamp(-10.0, 3.0).mean()
    offsets, logits = head(output.features)
    goal = functional.smooth_l1_loss(offsets, batch["goal"], beta=0.1)
    kind = functional.cross_entropy(logits.flatten(0, 1), batch["kind"].flatten())
    loss = action + 0.01 * spread + config.goal_weight * goal + config.kind_weight * kind
    stats = {}
    pose = batch["pose"]
    if output.shown.heading is not None and output.heading is not None:
        loss = loss + config.heading_weight * sight_loss(output.shown.heading, pose[..., 2])
        off = (output.heading * unit(pose[..., 2])).sum(-1).clamp(-1.0, 1.0).acos()
        stats["error/heading_degrees"] = off.rad2deg().median()
        stats["error/heading_lost"] = (off > math.pi / 4).float().mean()
    if output.shown.place is not None and output.place is not None:
        loss = loss + config.place_weight * place_loss(output.shown.place, pose, cell_size)
        stats["error/place"] = cells_off(output.place, pose, cell_size).median()
    stats |= {
        "loss/action": action,
        "loss/goal": goal,
        "loss/kind": kind,
        "loss/spread": spread,
        "error/robot": (offsets - batch["goal"])[..., :2].norm(dim=-1).mean(),
        "error/torque": (mean - label).abs().mean(),
    }
    return loss, {k: v.detach() for k, v in stats.items()}


def jitter_colours(frame: Tensor, amount: float, generator: torch.Generator) -> Tensor:
    """Return frames [M, W, H, W, 3] with each colour of each window brighter or darker, as floats up to 255."""
    gain = 1.0 + amount * (2.0 * torch.rand(len(frame), 1, 1, 1, 3, generator=generator) - 1.0)
    return (frame * gain.to(frame.device)).clamp_(max=255.0)


class DistilPlayer(CameraPlayer):
    """Lets the student act, or the teacher with torques that wander, and asks the teacher for labels."""

    def __init__(
        self, task: GoalTask, student: VisuomotorController, teacher: Driver, config: DistilConfig,
        generator: torch.Generator,
    ) -> None:  # fmt: skip
        """Play `task` with randomness from `generator`."""
        super().__init__(task, student, generator)
        self._teacher, self._config = teacher, config
        self._wandering = torch.zeros(task.torque.shape)
        self._driven = torch.ones(len(task.torque), dtype=torch.bool)
        self._frames = 0

    def _act(self, inputs: ControllerInput, mean: Tensor, scale: Tensor) -> tuple[NDArray[np.float32], Fields]:
        config, task, generator = self._config, self.task, self.generator
        label = self._teacher(task)
        if self._frames % (config.window * len(mean)) == 0:
            share = max(1.0 - self._frames / max(config.warm_up, 1), config.guided)
            self._driven = torch.rand(len(mean), generator=generator) < share
        self._frames += len(mean)
        noise = torch.randn(mean.shape, generator=generator)
        self._wandering = _KEPT * self._wandering + (1.0 - _KEPT**2) ** 0.5 * config.wander * noise
        # Every third row is disturbed.
        disturbed = (torch.arange(len(mean)) % 3 == 0)[:, None]
        own = mean + config.noise * disturbed * torch.randn(mean.shape, generator=generator)
        torque = torch.where(self._driven[:, None], torch.from_numpy(label) + self._wandering, own)
        goals = task.world.goals
        extra = {"label": label, "goal": goal_offsets(task.world), "kind": goals.kind.copy()}
        extra["pose"] = task.world.pose.astype(np.float32)
        return torque.clamp(-1.0, 1.0).numpy(), extra

    def state(self) -> State:
        """Return all that changes but the weights."""
        own = State({"frames": self._frames}, {"wandering": self._wandering, "driven": self._driven})
        return State.of({"student": super().state(), "guide": own})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        super().restore(state.part("student"))
        own = state.part("guide")
        self._frames = own.values["frames"]
        self._wandering, self._driven = own.tensors["wandering"], own.tensors["driven"]


class DistilLearner(ProductLearner[Batch]):
    """Student, auxiliary head and averaged weights."""

    def __init__(
        self,
        student: VisuomotorController,
        config: DistilConfig,
        generator: torch.Generator,
        validation: Validation | None = None,
    ) -> None:
        """Train `student` in place, where it is; `generator`, on the CPU, draws the jitter of colours."""
        super().__init__(validation or Validation())
        self.student, self.config, self._generator = student, config, generator
        self.head = GoalHead(student.hidden + student.config["features"]).to(student.device)
        self._average = moving_average(student, config.average, warm_up=True)
        parameters = [*student.parameters(), *self.head.parameters()]
        self._adam = torch.optim.Adam(parameters, config.learning_rate, fused=True)
        self._schedule = ProgressSchedule(self._adam, warm_up_cosine(config.warm_up_share))

    @property
    def product(self) -> VisuomotorController:
        """The moving average of the student."""
        return self._average.module

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        """Student, its moving average, the auxiliary head."""
        return {"student": self.student, "average": self._average, "head": self.head}

    @property
    def optimisers(self) -> Mapping[str, torch.optim.Optimizer]:
        """One for all."""
        return {"adam": self._adam}

    def own_state(self) -> State:
        """Return the random state."""
        return State(tensors={"generator": self._generator.get_state()})

    def restore_own(self, state: State) -> None:
        """Take over what `own_state` returned."""
        self._generator.set_state(state.tensors["generator"])

    def weights(self) -> Mapping[str, Tensor]:
        """Return the student's."""
        return self.student.state_dict()

    def update(self, batch: Batch, progress: float, guard: NaNGuard) -> Scalars:
        """Take one gradient step."""
        self._schedule.follow(progress)
        student, config, batch = self.student, self.config, put_on(batch, self.student.device)
        for policy in (student, self.product):
            policy.normalise(batch)
        frame = jitter_colours(batch["frame"], config.jitter, self._generator)
        inputs = (batch[name] for name in INPUT_FIELDS if name != "frame")
        output = student(frame, *inputs, memory_of(batch), batch["first"])
        loss, stats = imitation_loss(output, self.head, batch, config, student.layout.cell_size)
        norm = guarded_step(loss, [self._adam], guard, clip=config.clip)
        if norm is not None:
            self._average.update_parameters(student)
            stats["gradient_norm"] = norm
        # All at once: to wait for a GPU takes longer than to copy a number.
        return dict(zip(stats, torch.stack(list(stats.values())).tolist(), strict=True))
