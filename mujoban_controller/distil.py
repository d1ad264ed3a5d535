"""Distillation of a privileged teacher into the camera policy, on the policy's own visited states.

DAgger (Ross et al. 2011): the student acts, the teacher says what it would have done, and the student learns to do
the same from what it can see. Auxiliary heads, which do not ship, make its memory tell the goal's kind and how
far robot and box are from their targets; that is the part of the teacher's view that the student has to infer.

Shapes: B robots, T ticks, M sequences in a batch, U actuators, F features.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from mujoban_controller.controller import ControllerOutput, Recurrent, VisuomotorController
from mujoban_controller.drivers import Driver, WanderingDriver
from mujoban_controller.goal_features import GOAL_SIZE, goal_offsets
from mujoban_controller.goal_task import GoalTask, TaskStep
from mujoban_controller.replay import SequenceReplay, memory_fields
from mujoban_core.grid import Instruction
from mujoban_core.interfaces import Memory, renew_rows
from mujoban_sim.goals import GoalKind

_KINDS = len(GoalKind) - 1


@dataclass(frozen=True)
class DistilConfig:
    """Settings of distillation."""

    length: int = 8
    """T, ticks of a sequence."""
    sequences: int = 16
    """M, sequences of a batch."""
    replay: int = 20_000
    """Sequences in the replay."""
    reuse: float = 3.0
    """Times that each frame is trained on, on average."""
    warm_up: int = 100_000
    """Frames over which the share of rows that the student does not drive falls from one to `guided`."""
    guided: float = 0.3
    """Share of rows that the scripted driver drives, with targets that wander: positions that a student needs to tell
    apart before it is good, and has left behind once it is."""
    wander: float = 0.12
    """Standard deviation of these targets in cells."""
    noise: float = 0.1
    """Deviation of the noise on the torques of a third of the rows, which shows the student more states."""
    learning_rate: float = 1e-3
    final_rate: float = 0.02
    """Share of the learning rate that is left at the end of the cosine schedule."""
    clip: float = 5.0
    goal_weight: float = 0.5
    kind_weight: float = 0.05
    infeasible_weight: float = 1.0
    """Weight of the torques under an instruction towards a wall or a blocked box. Below 1, a student in doubt whether
    a push is possible tries it: the loss is nearly absolute, so it acts from this share of the odds on."""
    jitter: float = 0.25
    """Largest relative change of each colour's brightness, drawn anew for each sequence."""
    average: float = 0.998
    """Decay of the weights' moving average, which is what ships."""


class GoalHead(nn.Module):
    """Auxiliary prediction of the goal's kind and offsets from the policy's features."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(features, 128), nn.ReLU(), nn.Linear(128, GOAL_SIZE + _KINDS))

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return goal offsets in cells, [..., 4], and logits of the kind, [..., 3], from [..., F]."""
        return self.layers(features).split((GOAL_SIZE, _KINDS), -1)


def imitation_loss(
    output: ControllerOutput, head: GoalHead, batch: dict[str, Tensor], config: DistilConfig
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return loss and statistics of a batch of sequences [M, T]."""
    mean, scale = output.action
    label = batch["label"]
    blocked = (batch["kind"] == GoalKind.HOLD) & (batch["instruction"] != Instruction.STAY)
    weight = torch.where(blocked, config.infeasible_weight, 1.0)[..., None]
    action = (weight * functional.smooth_l1_loss(mean, label, beta=0.1, reduction="none")).mean()
    # The scale learns how far the teacher's torques stray from the mean, and does not move the mean.
    spread = -torch.distributions.Normal(mean.detach(), scale).log_prob(label).clamp(-10.0, 3.0).mean()
    offsets, logits = head(output.features)
    goal = functional.smooth_l1_loss(offsets, batch["goal"], beta=0.1)
    kind = functional.cross_entropy(logits.flatten(0, 1), batch["kind"].flatten())
    loss = action + 0.01 * spread + config.goal_weight * goal + config.kind_weight * kind
    stats = {
        "loss/action": action,
        "loss/goal": goal,
        "loss/kind": kind,
        "loss/spread": spread,
        "error/robot": (offsets - batch["goal"])[..., :2].norm(dim=-1).mean(),
        "error/torque": (mean - label).abs().mean(),
    }
    return loss, {k: v.detach() for k, v in stats.items()}


def jitter_colours(frame: Tensor, amount: float) -> Tensor:
    """Return frames [M, T, H, W, 3] with each colour of each sequence brighter or darker, as floats up to 255."""
    gain = 1.0 + amount * (2.0 * torch.rand(len(frame), 1, 1, 1, 3, device=frame.device) - 1.0)
    return (frame * gain).clamp_(max=255.0)


class Collector:
    """Lets the student act in the goal task and asks the teacher for labels."""

    def __init__(
        self, task: GoalTask, student: VisuomotorController, teacher: Driver, config: DistilConfig,
        rng: np.random.Generator,
    ) -> None:  # fmt: skip
        """Collect from `task` with randomness from `rng`."""
        self.task, self.student, self.teacher, self.config, self._rng = task, student, teacher, config, rng
        self._guide = WanderingDriver(rng, config.wander)
        b = task.world.batch
        self._memory: Memory = student.initial_memory(b)
        self.frames = 0
        """Frames collected so far."""

    def collect(self) -> tuple[dict[str, NDArray], dict[str, NDArray], list[TaskStep]]:
        """Play T ticks; return per-tick fields [T, B, ...], the memory at the start, and what happened."""
        b = self.task.world.batch
        share = 1.0 - self.frames / max(self.config.warm_up, 1)
        driven = self._rng.random(b) < max(share, self.config.guided)
        noisy = self._rng.random(b) < 1 / 3
        starts = memory_fields(self._memory)
        rows, steps = [], []
        for _ in range(self.config.length):
            tick, outcome = self._tick(driven, noisy)
            rows.append(tick)
            steps.append(outcome)
        self.frames += self.config.length * b
        return {k: np.stack([r[k] for r in rows]) for k in rows[0]}, starts, steps

    @torch.inference_mode()
    def _tick(self, driven: NDArray[np.bool_], noisy: NDArray[np.bool_]) -> tuple[dict[str, Any], TaskStep]:
        task, first = self.task, self.task.first.copy()
        self._memory = renew_rows(self._memory, self.student.initial_memory(len(first)), first)
        inputs = task.observe()
        label = self.teacher(task)
        output = self.student(*self.student.to_tensors(inputs), memory=Recurrent(*self._memory))
        self._memory = output.memory
        torque = output.action.mean[:, 0].numpy()
        torque = np.where(driven[:, None], self._guide(task), torque)
        torque = torque + noisy[:, None] * self._rng.normal(0.0, self.config.noise, torque.shape)
        goals = task.world.goals
        tick = {
            "frame": inputs.frame,
            "proprio": inputs.proprio,
            "instruction": inputs.instruction,
            "terminated": inputs.terminated,
            "first": first,
            "label": label.astype(np.float32),
            "goal": goal_offsets(task.world),
            "kind": goals.kind.copy(),
        }
        return tick, task.step(np.clip(torque, -1.0, 1.0).astype(np.float32))


class Distiller:
    """Student, auxiliary head, averaged weights and optimiser; one `update` per batch."""

    def __init__(self, student: VisuomotorController, config: DistilConfig, total: int) -> None:
        """Train `student` in place with a cosine schedule over `total` updates."""
        self.student, self.config, self.total = student, config, max(total, 1)
        self.head = GoalHead(student.hidden + student.config["features"])  # pyright: ignore[reportArgumentType]
        self.average = VisuomotorController(**student.config)  # pyright: ignore[reportArgumentType]
        self.average.load_state_dict(student.state_dict())
        self.average.requires_grad_(False)
        parameters = [*student.parameters(), *self.head.parameters()]
        self.optimiser = torch.optim.Adam(parameters, config.learning_rate, foreach=True)
        self.updates = 0

    def update(self, replay: SequenceReplay, rng: np.random.Generator) -> dict[str, Tensor]:
        """Take one gradient step; return statistics. Non-finite gradients raise at the caller's guard."""
        config, student = self.config, self.student
        device = student.mean.weight.device
        batch = replay.sample(config.sequences, rng, device)
        for group in self.optimiser.param_groups:
            group["lr"] = config.learning_rate * self._schedule()
        output = student(
            jitter_colours(batch["frame"], config.jitter), batch["proprio"], batch["instruction"], batch["terminated"],
            Recurrent(*(batch[f"memory{i}"] for i in range(3))), batch["first"],
        )  # fmt: skip
        loss, stats = imitation_loss(output, self.head, batch, config)
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        norm = nn.utils.clip_grad_norm_([*student.parameters(), *self.head.parameters()], config.clip)
        if bool(torch.isfinite(norm)):
            self.optimiser.step()
            self._follow()
        self.updates += 1
        return {**stats, "gradient_norm": norm}

    def _schedule(self) -> float:
        progress = min(self.updates / self.total, 1.0)
        warm = min(1.0, (self.updates + 1) / 200)
        floor = self.config.final_rate
        return warm * (floor + (1 - floor) * 0.5 * (1 + np.cos(np.pi * progress)))

    @torch.no_grad()
    def _follow(self) -> None:
        decay = min(self.config.average, (1 + self.updates) / (10 + self.updates))
        for ours, theirs in zip(self.average.parameters(), self.student.parameters(), strict=True):
            ours.lerp_(theirs, 1.0 - decay)
        self.average.proprio_mean.copy_(self.student.proprio_mean)
        self.average.proprio_scale.copy_(self.student.proprio_scale)
