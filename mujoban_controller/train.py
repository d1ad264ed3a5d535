"""Train the controller: `python -m mujoban_controller.train --stage teacher|distil|mpo`.

The recorded route is `distil`: a privileged teacher is distilled into the camera policy. `teacher` trains a
privileged policy by MPO, and `mpo` trains the camera policy by MPO with an asymmetric critic (paper C.3), from
scratch or from distilled weights. Every run is resumed by giving its directory again.
"""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro

from mujoban_controller.controller import VisuomotorController
from mujoban_controller.distil import Collector, DistilConfig, Distiller, scripted_teacher
from mujoban_controller.goal_task import EpisodeSource, GoalTask, GoalTaskConfig
from mujoban_controller.judge import OutcomeSummary, judge
from mujoban_controller.replay import SequenceReplay
from mujoban_rl.training import NaNGuard, RunDirectory, StopSignal, TimeLimit, TrainingLog
from mujoban_rl.weights import load_weights, provenance, save_weights
from mujoban_sim.generator import TRAIN_SEEDS, generate_level
from mujoban_sim.oracles import OraclePlanner
from mujoban_sim.world import EpisodeSpec

PLANNER_NODES = 20_000
"""Search nodes for the plans that the goal task follows; levels that need more are played at random."""


@dataclass(frozen=True)
class NetworkConfig:
    """Widths of the camera policy."""

    channels: tuple[int, ...] = (24, 32, 48, 64)
    features: int = 256
    hidden: int = 192


@dataclass(frozen=True)
class TrainConfig:
    """What must not change between the bits of a run."""

    stage: Literal["distil"] = "distil"
    steps: int = 1_500_000
    """Environment steps (frames)."""
    seed: int = 0
    initial: str | None = None
    """Weights to start from."""
    task: GoalTaskConfig = field(default_factory=GoalTaskConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    distil: DistilConfig = field(default_factory=DistilConfig)


@dataclass(frozen=True)
class Options:
    """Train the controller."""

    run: Path
    """Run directory; an existing one is resumed."""
    config: tyro.conf.OmitArgPrefixes[TrainConfig] = field(default_factory=TrainConfig)
    seconds: float | None = None
    """Stop after so many seconds; resume later."""
    evaluate_every: int = 300_000
    """Environment steps between evaluations on held-out levels."""
    evaluation_episodes: int = 32
    save_every: float = 300.0
    """Seconds between checkpoints."""
    device: str = "cpu"
    threads: int = 1


def training_episodes(difficulty: int, rng: np.random.Generator) -> EpisodeSource:
    """Return a source of levels whose seeds are drawn from `TRAIN_SEEDS`."""

    def draw() -> EpisodeSpec:
        seed = int(rng.integers(TRAIN_SEEDS.start, TRAIN_SEEDS.stop))
        if seed not in TRAIN_SEEDS:
            raise AssertionError(f"seed {seed} is not a training seed")
        return EpisodeSpec(generate_level(difficulty, seed), seed)

    return draw


class DistilRun:
    """A distillation that can stop and go on."""

    def __init__(self, options: Options) -> None:
        """Set everything up and restore the newest checkpoint of the run directory, if there is one."""
        self.options, self.config = options, options.config
        config = self.config
        torch.manual_seed(config.seed)
        self.rng = np.random.default_rng(config.seed)
        self.directory = RunDirectory(options.run, config)
        self.student = self._student()
        self.student.mixed_precision = True
        frames = config.distil.length * config.distil.sequences
        self.distiller = Distiller(self.student, config.distil, round(config.steps * config.distil.reuse / frames))
        self.replay = SequenceReplay(config.distil.replay, config.distil.length)
        self.frames = 0
        self._debt = 0.0
        self._restore()
        # Another stream after every resumption, so that no episode is seen twice.
        task_rng = np.random.default_rng([config.seed, self.frames, 1])
        planner = OraclePlanner(max_nodes=PLANNER_NODES)
        task = GoalTask(
            config.task, planner, training_episodes(config.task.difficulty, task_rng), task_rng,
            threads=options.threads,
        )  # fmt: skip
        self.collector = Collector(task, self.student, scripted_teacher, config.distil, task_rng)
        self.collector.frames = self.frames

    def _student(self) -> VisuomotorController:
        if self.config.initial is not None:
            return load_weights(VisuomotorController, self.config.initial).train()
        return VisuomotorController(body=self.config.task.body, **asdict(self.config.network))

    def _restore(self) -> None:
        snapshot = self.directory.load(modules=self._modules(), optimisers={"adam": self.distiller.optimiser})
        if snapshot is not None:
            self.frames = snapshot.step
            self.distiller.updates = snapshot.extra["updates"]
            self.rng.bit_generator.state = snapshot.extra["rng"]

    def _modules(self) -> dict[str, torch.nn.Module]:
        d = self.distiller
        return {"student": d.student, "average": d.average, "head": d.head}

    def save(self) -> None:
        """Write a checkpoint."""
        extra = {"updates": self.distiller.updates, "rng": self.rng.bit_generator.state}
        self.directory.save(
            self.frames, modules=self._modules(), optimisers={"adam": self.distiller.optimiser}, extra=extra
        )

    def export(self, metrics: dict[str, Any]) -> None:
        """Write the averaged weights with their record into the run directory."""
        d = self.distiller
        record = {
            **provenance(),
            "training": asdict(self.config),
            "data": f"generated levels of difficulty {self.config.task.difficulty}, seeds of TRAIN_SEEDS",
            "steps": self.frames,
            "updates": d.updates,
            "metrics": metrics,
        }
        save_weights(self.directory.path / "controller.safetensors", d.average, d.average.config, record)

    def run(self) -> None:
        """Train until the steps or seconds are over or a signal comes."""
        options, config = self.options, self.config
        with TrainingLog(self.directory, total=config.steps, initial=self.frames, unit="frame") as log:
            with StopSignal() as stop, np.errstate(all="raise", under="ignore"):
                self._loop(log, stop, TimeLimit(options.seconds))
            self.save()
            self.export(self._evaluate(log))

    def _loop(self, log: TrainingLog, stop: StopSignal, limit: TimeLimit) -> None:
        guard, saved, evaluated = NaNGuard(), 0.0, self.frames
        while self.frames < self.config.steps and not stop.requested and not limit.reached:
            before = self.frames
            summary = self._collect()
            stats = self._learn(guard)
            log.advance(self.frames - before)
            if stats:
                log.scalars(self.frames, {**stats, **flatten(summary)})
            if limit.elapsed - saved > self.options.save_every:
                saved = limit.elapsed
                self.save()
            if self.frames - evaluated >= self.options.evaluate_every:
                evaluated = self.frames
                self.export(self._evaluate(log))

    def _collect(self) -> OutcomeSummary:
        summary = OutcomeSummary()
        ticks, starts, steps = self.collector.collect()
        if not self.frames and self.config.initial is None:
            self.student.fit_normalisation(torch.from_numpy(ticks["proprio"]).flatten(0, 1))
        for step in steps:
            summary.add(step.outcomes)
        self.replay.add(ticks, starts)
        count = ticks["first"].size
        self.frames += count
        self._debt += count * self.config.distil.reuse
        return summary

    def _learn(self, guard: NaNGuard) -> dict[str, Any]:
        config = self.config.distil
        per_update = config.length * config.sequences
        total: dict[str, float] = {}
        updates = int(self._debt // per_update)
        for _ in range(updates):
            stats = self.distiller.update(self.replay, self.rng)
            guard.accept(stats["loss/action"], stats["gradient_norm"])
            for name, value in stats.items():
                total[name] = total.get(name, 0.0) + float(value) / updates
        self._debt -= updates * per_update
        return total

    def _evaluate(self, log: TrainingLog) -> dict[str, Any]:
        options = self.options
        if not options.evaluation_episodes:
            return {}
        student = self.distiller.average.eval()
        report = judge(
            student, OraclePlanner(), episodes=options.evaluation_episodes, body=self.config.task.body,
            difficulty=self.config.task.difficulty, batch=min(64, options.evaluation_episodes), threads=options.threads,
        )  # fmt: skip
        kinds = report["instructions"]["kinds"]
        values = {"evaluation/solved": report["success_rate"]}
        values |= {f"evaluation/{kind}": kinds[kind]["success_rate"] for kind in kinds}
        log.scalars(self.frames, values)
        log.message(f"{self.frames} frames: {report['success_rate']:.3f} of levels solved, {report['lost']}")
        return report


def flatten(summary: OutcomeSummary) -> dict[str, float]:
    """Return a summary's rates and durations as scalars."""
    values: dict[str, float] = {}
    for kind, entry in summary.report()["kinds"].items():
        values[f"instruction/{kind}"] = entry["success_rate"]
        values[f"instruction/{kind}_n"] = entry["n"]
        if entry["median_steps"] is not None:
            values[f"steps/{kind}"] = entry["median_steps"]
    return values


def main() -> int:
    """Run the command."""
    options = tyro.cli(Options)
    torch.set_num_threads(options.threads)
    DistilRun(options).run()
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except ValueError as error:
        print(f"mujoban_controller.train: error: {error}", file=sys.stderr)
        sys.exit(2)
