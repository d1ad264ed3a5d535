"""Imitation of the solver: the loss, input noise, and the training loop.

Shapes: B batch, N = `grid.GRID_SIZE`, I = N - 2, A = 5 instructions.
"""

from __future__ import annotations

import copy
import math
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from mujoban_planner.growth import start_from
from mujoban_planner.lessons import LessonMaker, LessonProcess
from mujoban_planner.samples import Batch, SampleBuffer, concatenate, make_batch
from mujoban_planner.symmetry import SYMMETRIES
from mujoban_planner.uncertainty import blur, hide_unseen
from mujoban_planner.validation import NetworkConfig, Shares, difficulty_shares, solve_rates
from mujoban_rl.limits import NaNGuard, StopSignal, TimeLimit
from mujoban_rl.run_directory import RunDirectory
from mujoban_rl.training_log import TrainingLog
from mujoban_rl.weights import provenance, save_weights

_STOCK_BATCHES = 800
"""Batches of demonstrations kept ahead, and learned from before the planner's own play is worth correcting."""

_ENOUGH = 20_000
"""Corrections from which on they make up their whole share of a batch."""


@dataclass(frozen=True)
class ImitationConfig(NetworkConfig):
    """What defines an imitation run."""

    batch_size: int = 128
    learning_rate: float = 1e-3
    weight_decay: float = 1e-3
    warm_up: float = 0.02
    """Share of the schedule in which the learning rate rises."""
    horizon_seconds: float = math.inf
    """Training time at which the cosine schedule ends, whichever of the two horizons comes first."""
    horizon_samples: float = 4e6
    """Samples at which the cosine schedule ends."""
    plan_weight: float = 3.0
    """Weight of the plan map in the loss."""
    value_weight: float = 0.02
    """Weight of the Q-values in the loss."""
    push_weight: float = 1.0
    """Weight of the next push in the loss."""
    dead_weight: float = 1.0
    """Weight of the dead-state head in the loss."""
    ema: float = 0.999
    """Decay of the averaged weights, which are what is played and shipped."""
    corrections: float = 0.5
    """Share of a batch that corrects the planner's own play (DAgger), once there is some."""
    judged: float = 1.0
    """Share of the arrangements of boxes in demonstrations in which every possible push is judged."""
    freshness: float = 0.4
    """New samples, of demonstrations and of corrections each, per sample that is learned from."""
    init: str | None = None
    """Weights to start from, where names and shapes agree."""
    noise: float = 0.1
    """Share of a batch whose abstract states are blurred, as estimates are."""
    hidden: float = 0.4
    """Share of a batch that shows only what the robot may have seen so far."""
    mix: Shares = (0.03, 0.04, 0.06, 0.12, 0.75)
    """Shares of difficulties 1 to 5 among the training levels."""
    buffer: int = 2_000_000
    """Samples kept of demonstrations, and as many of corrections."""
    seed: int = 0


def imitation_loss(planner: nn.Module, batch: Batch, config: ImitationConfig) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the loss and its parts, scalars.

    Policy: -log of the probability of all right instructions together. Q: regression of the demonstration's return
    on right instructions and of the return of doing nothing on deadly ones. Dead: cross-entropy where known. Plan map:
    cross-entropy per cell where there is a demonstration.
    """
    output = planner(batch.state)
    shown = batch.right.any(1)
    n = shown.sum().clamp(min=1)
    log_policy = functional.log_softmax(output.policy, 1)
    right = log_policy.masked_fill(~batch.right, -1e9).logsumexp(1)
    policy = -(right * shown).sum() / n
    plan = functional.cross_entropy(output.plan, batch.plan, reduction="none").mean((1, 2))
    plan = (plan * shown).sum() / n
    known = batch.dead_known.float()
    dead = functional.binary_cross_entropy_with_logits(output.dead, batch.dead.float(), weight=known, reduction="sum")
    dead = dead / known.sum().clamp(min=1)
    if output.push_dead is not None:
        verdicts = functional.binary_cross_entropy_with_logits(
            output.push_dead, batch.push_dead.float(), weight=batch.push_known.float(), reduction="sum"
        )
        dead = dead + verdicts / batch.push_known.sum().clamp(min=1)
    q_known = (batch.right | batch.dead).float()
    q_target = torch.where(batch.dead, -1.0, batch.value[:, None])
    q = functional.smooth_l1_loss(output.q, q_target, reduction="none")
    q = (q * q_known).sum() / q_known.sum().clamp(min=1)
    push = output.push.flatten(1).gather(1, batch.next_push[:, None])[:, 0]
    push = -(push * shown).sum() / n
    best = (output.push.flatten(1).argmax(1) == batch.next_push) & shown
    loss = policy + config.push_weight * push + config.plan_weight * plan
    loss = loss + config.dead_weight * dead + config.value_weight * q
    correct = batch.right.gather(1, log_policy.argmax(1, keepdim=True))[:, 0]
    accuracy = (correct & shown).sum() / n
    caught = ((output.dead > 0) & batch.dead).sum() / batch.dead.sum().clamp(min=1)
    parts = {"policy": policy, "accuracy": accuracy, "push": push, "push_accuracy": best.sum() / n}
    parts |= {"plan": plan, "dead": dead, "dead_recall": caught, "q": q}
    return loss, {k: v.detach() for k, v in parts.items()}


class ImitationTrainer:
    """Trains a network on lessons; `run` does a bit of it, from the last checkpoint on."""

    def __init__(self, config: ImitationConfig, directory: Path, *, device: str = "cpu", processes: int = 1) -> None:
        """Open or resume the run in `directory`.

        Args:
            config: What to train; fixed for the run.
            directory: Run directory.
            device: Device of the network; on a CPU it trains in bfloat16.
            processes: 1 to make lessons in a process beside, 0 to make them in between (deterministic).
        """
        self.config, self.device = config, torch.device(device)
        self.directory = RunDirectory(directory, config)
        torch.manual_seed(config.seed)  # the initial weights
        self.network = config.build().to(self.device)
        if config.init is not None:
            start_from(self.network, Path(config.init))
        self.network.lay_out()
        self.average = copy.deepcopy(self.network).eval()
        self.optimiser = torch.optim.AdamW(
            self.network.parameters(), config.learning_rate, (0.9, 0.98), weight_decay=config.weight_decay, fused=True
        )
        self.rng = np.random.default_rng(config.seed)
        self.generator = torch.Generator().manual_seed(config.seed)
        self.samples, self.steps, self.seconds, self.bits = 0, 0, 0.0, 0
        self.metrics: dict[str, float] = {}
        """Of the last evaluation."""
        self._restore()
        self._resumed_at = self.samples
        self.demonstrations = SampleBuffer(config.buffer)
        self.corrections = SampleBuffer(config.buffer)
        self.played_weights = self.directory.path / "played.safetensors"
        self._maker: LessonMaker | None = None
        self._process: LessonProcess | None = None
        stream = 1000 * config.seed + self.bits
        mix = difficulty_shares(config.mix)
        if processes:
            self._process = LessonProcess(stream, mix, config.judged, self.played_weights, niceness=1)
        else:
            self._maker = LessonMaker(stream, mix, config.judged)

    def run(self, *, seconds: float | None, samples: float, evaluate_every: float, save_every: float) -> None:
        """Train until the schedule ends, for `seconds`, up to `samples`, or until a signal; then save."""
        self.bits += 1
        self._collect()
        limit, guard = TimeLimit(seconds), NaNGuard()
        started, offset = time.monotonic(), self.seconds
        evaluated = saved = started
        sums: dict[str, float] = {}
        end = int(min(samples, self.config.horizon_samples))
        log = TrainingLog(self.directory, total=end, initial=self.samples, unit="sample")
        try:
            with log, StopSignal() as stop:
                while self.progress < 1.0 and self.samples < end and not (limit.reached or stop.requested):
                    self._collect()
                    self._step(guard, sums)
                    self.seconds = offset + time.monotonic() - started
                    log.advance(self.config.batch_size)
                    if self.steps % 100 == 0:
                        log.scalars(self.samples, self._statistics(sums))
                        sums.clear()
                    now = time.monotonic()
                    if self.steps % 10 == 0 and now - saved > save_every:
                        saved = now
                        self.save()
                    if self.steps % 10 == 0 and now - evaluated > evaluate_every:
                        evaluated = now
                        log.scalars(self.samples, self.evaluate(log))
                log.scalars(self.samples, self.evaluate(log))
                self.save()
        finally:
            if self._process is not None:
                self._process.close()

    @property
    def progress(self) -> float:
        """Share of the schedule that is done."""
        return max(self.samples / self.config.horizon_samples, self.seconds / self.config.horizon_seconds)

    def evaluate(self, log: TrainingLog) -> dict[str, float]:
        """Return solve rates of the averaged weights on held-out levels."""
        rates = solve_rates(self.average, reduced_precision=self.device.type == "cpu")
        shown = "  ".join(f"{k} {v:.3f}" for k, v in rates.items())
        log.message(f"{self.samples:9d} samples {self.seconds:6.0f} s  {shown}")
        self.metrics = rates | {"seconds": self.seconds, "samples": float(self.samples)}
        return self.metrics

    def save(self) -> None:
        """Write a checkpoint and the averaged weights with their record."""
        counters = {"samples": self.samples, "seconds": self.seconds, "bits": self.bits}
        self.directory.save(
            self.steps,
            modules={"network": self.network, "average": self.average},
            optimisers={"adamw": self.optimiser},
            extra=counters | {"rng": self.rng.bit_generator.state},
            tensors={"generator": self.generator.get_state()},
        )
        record: dict[str, Any] = {
            **provenance(),
            "method": "imitation",
            "training": asdict(self.config),
            "data": "solver demonstrations and corrections of own play on generated levels, training seeds",
            "steps": self.steps,
            "samples": self.samples,
            "seconds": round(self.seconds),
            "metrics": self.metrics,
        }
        if math.isinf(self.config.horizon_seconds):
            record["training"]["horizon_seconds"] = None
        save_weights(self.directory.path / "planner.safetensors", self.average, self.average.config, record)

    def _restore(self) -> None:
        snapshot = self.directory.load(
            modules={"network": self.network, "average": self.average}, optimisers={"adamw": self.optimiser}
        )
        if snapshot is None:
            return
        self.steps = snapshot.step
        self.samples, self.seconds = snapshot.extra["samples"], snapshot.extra["seconds"]
        self.bits = snapshot.extra["bits"]
        self.rng.bit_generator.state = snapshot.extra["rng"]
        self.generator.set_state(snapshot.tensors["generator"])

    def _collect(self) -> None:
        """Fetch lessons where the buffers lag behind what was consumed."""
        config = self.config
        first = self.demonstrations.size == 0
        learned = self.samples - self._resumed_at
        stock = _STOCK_BATCHES * config.batch_size
        fresh_wanted = self.demonstrations.added < stock + config.freshness * learned
        played_wanted = self.samples > stock and self.corrections.added < _ENOUGH + config.freshness * learned
        if self._maker is not None:
            if fresh_wanted:
                self.demonstrations.add(self._maker.demonstrations())
            if played_wanted:
                self.corrections.add(self._maker.corrections(self.average))
        elif self._process is not None:
            if fresh_wanted and (new := self._process.take(self._process.demonstrations, wait=first)) is not None:
                self.demonstrations.add(new)
            if played_wanted and (new := self._process.take(self._process.corrections, wait=False)) is not None:
                self.corrections.add(new)
            if self.steps % 500 == 250:
                save_weights(self.played_weights, self.average, self.average.config, {"samples": self.samples})

    def _step(self, guard: NaNGuard, sums: dict[str, float]) -> None:
        config = self.config
        # A few corrections must not be learned by heart.
        corrections = int(config.batch_size * config.corrections * min(1.0, self.corrections.size / _ENOUGH))
        parts = [self.demonstrations.draw(config.batch_size - corrections, self.rng)]
        if corrections:
            parts.append(self.corrections.draw(corrections, self.rng))
        batch = make_batch(concatenate(parts), self.rng.integers(0, SYMMETRIES, config.batch_size)).to(self.device)
        order = torch.randperm(config.batch_size, generator=self.generator).to(self.device)
        batch = Batch._make(x[order] for x in batch)
        state = blur(batch.state, config.noise, self.generator)
        batch = batch._replace(state=hide_unseen(state, config.hidden, self.rng))
        for group in self.optimiser.param_groups:
            group["lr"] = config.learning_rate * self._schedule()
        with torch.autocast(self.device.type, torch.bfloat16):
            loss, stats = imitation_loss(self.network, batch, config)
        self.optimiser.zero_grad()
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        if guard.accept(loss, norm):
            self.optimiser.step()
        self.steps += 1
        self.samples += config.batch_size
        decay = min(config.ema, (1 + self.steps) / (10 + self.steps))
        with torch.no_grad():
            for mean, parameter in zip(self.average.parameters(), self.network.parameters(), strict=True):
                mean.lerp_(parameter, 1 - decay)
        for name, value in stats.items():
            sums[name] = sums.get(name, 0.0) + float(value)
        sums["n"] = sums.get("n", 0.0) + 1.0

    def _schedule(self) -> float:
        done = min(self.progress, 1.0)
        return min(1.0, done / self.config.warm_up) * 0.5 * (1.0 + math.cos(math.pi * done))

    def _statistics(self, sums: dict[str, float]) -> dict[str, float]:
        n = sums.get("n", 1.0)
        means = {f"train/{k}": v / n for k, v in sums.items() if k != "n"}
        return means | {
            "learning_rate": self.optimiser.param_groups[0]["lr"],
            "seconds": self.seconds,
            "demonstrations": float(self.demonstrations.added),
            "corrections": float(self.corrections.added),
        }
