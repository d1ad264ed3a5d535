"""Train the controller: `python -m mujoban_controller.train --stage teacher|distil|mpo --run DIR`.

The recorded route is `distil`: a privileged teacher is distilled into the camera policy. `teacher` trains a
privileged policy by MPO, and `mpo` trains the camera policy by MPO with an asymmetric critic (paper C.3), from
scratch or from distilled weights (`--initial`). With `--bags`, sequences from recorded bags of the running stack
join the replay of MPO. Give the directory again to resume a run; its replay fills anew.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
import tyro
from torch import nn

from mujoban_controller.bag_sequences import BagSequences
from mujoban_controller.controller import VisuomotorController
from mujoban_controller.distil import DistilConfig
from mujoban_controller.drivers import Driver, PrivilegedDriver, scripted_driver
from mujoban_controller.goal_task import EpisodeSource, GoalTask, GoalTaskConfig
from mujoban_controller.judge import OutcomeSummary, judge
from mujoban_controller.learners import DistilLearner, Learner, ReinforcementLearner
from mujoban_controller.mpo import MPOTrainingConfig
from mujoban_controller.privileged import PrivilegedPolicy
from mujoban_core.signals import StopSignal
from mujoban_rl.limits import NaNGuard, TimeLimit
from mujoban_rl.run_directory import RunDirectory
from mujoban_rl.training_log import TrainingLog
from mujoban_rl.weights import digest, load_weights, provenance, save_weights
from mujoban_sim.oracles import OraclePlanner
from mujoban_sokoban.episodes import EpisodeSpec, after_moves
from mujoban_sokoban.generator import TRAIN_SEEDS, generate_level
from mujoban_sokoban.solver import solve_level

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

    stage: Literal["teacher", "distil", "mpo"] = "distil"
    steps: int = 1_500_000
    """Environment steps (frames)."""
    seed: int = 0
    initial: Path | None = None
    """Weights to start from."""
    teacher: Path | None = None
    """Weights of a privileged teacher to distil; without it the scripted driver teaches."""
    task: GoalTaskConfig = field(default_factory=GoalTaskConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    distil: DistilConfig = field(default_factory=DistilConfig)
    mpo: MPOTrainingConfig = field(default_factory=MPOTrainingConfig)

    def __post_init__(self) -> None:
        """Reject settings that contradict each other."""
        if self.teacher is not None and self.stage != "distil":
            raise ValueError(f"--teacher {self.teacher}: only the stage distil has a teacher, not {self.stage}")


@dataclass(frozen=True)
class Options:
    """Train the controller."""

    run: Path
    """Run directory; an existing one is resumed."""
    config: Annotated[TrainConfig, tyro.conf.arg(name="")] = field(default_factory=TrainConfig)
    bags: tuple[Path, ...] = ()
    """Recorded bags, or folders of bags, whose transitions join the replay of the stages teacher and mpo."""
    bag_share: float = 0.25
    """Share of the replay's new sequences that comes from bags, if there are any."""
    seconds: float | None = None
    """Stop after so many seconds; resume later."""
    evaluate_every: int = 300_000
    """Environment steps between evaluations on held-out levels."""
    evaluation_episodes: int = 32
    save_every: float = 300.0
    """Seconds between checkpoints."""
    device: str = "cpu"
    """Where networks learn; the policy acts there too."""
    threads: int = 1

    def __post_init__(self) -> None:
        """Reject bags that nothing would learn from."""
        if self.bags and self.config.stage == "distil":
            raise ValueError(
                "--bags: bags lack the labels that distillation learns from; expected --stage mpo or teacher"
            )
        if not 0.0 < self.bag_share < 1.0:
            raise ValueError(f"--bag-share {self.bag_share}: expected a share between 0 and 1")


def training_episodes(difficulty: int, rng: np.random.Generator) -> EpisodeSource:
    """Return a source of levels whose seeds are drawn from `TRAIN_SEEDS`, each at a random point of its solution."""

    def draw() -> EpisodeSpec:
        seed = int(rng.integers(TRAIN_SEEDS.start, TRAIN_SEEDS.stop))
        if seed not in TRAIN_SEEDS:
            raise AssertionError(f"seed {seed} is not a training seed")
        level = generate_level(difficulty, seed)
        moves = solve_level(level, max_nodes=PLANNER_NODES).moves
        done = int(rng.integers(len(moves))) if len(moves) else 0
        return EpisodeSpec(after_moves(level, moves[:done]), seed)

    return draw


def make_learner(
    config: TrainConfig, *, threads: int = 1, device: str = "cpu", stream: int = 0,
    bags: Sequence[Path] = (), bag_share: float = 0.25,
) -> Learner[Any]:  # fmt: skip
    """Return the learner of a stage, its task started.

    Args:
        config: The run's settings.
        threads: Threads for physics.
        device: Device of the networks.
        stream: Random stream of the task, another one after every resumption, so that no episode comes twice.
        bags: Recorded bags whose sequences join the replay of MPO.
        bag_share: Their share of the new sequences.

    Raises:
        BagError: If a bag cannot be used.
    """
    torch.manual_seed(config.seed)
    rng = np.random.default_rng([config.seed, stream])
    episodes = training_episodes(config.task.difficulty, rng)
    task = GoalTask(config.task, OraclePlanner(max_nodes=PLANNER_NODES), episodes, rng, threads=threads)
    if config.stage != "distil":
        policy = _policy(config).train().to(device)
        recorded = BagSequences(bags, config.task, policy, config.mpo.length, rng) if bags else None
        return ReinforcementLearner(
            policy, task, config.mpo, rng, fresh=config.initial is None, recorded=recorded, recorded_share=bag_share
        )
    student = _camera_policy(config).train().to(device)
    teacher = _teacher(config.teacher)
    return DistilLearner(student, task, teacher, config.distil, rng, steps=config.steps, fresh=config.initial is None)


def _policy(config: TrainConfig) -> PrivilegedPolicy | VisuomotorController:
    if config.stage == "mpo":
        return _camera_policy(config)
    return (
        PrivilegedPolicy(config.task.body) if config.initial is None else load_weights(PrivilegedPolicy, config.initial)
    )


def _camera_policy(config: TrainConfig) -> VisuomotorController:
    if config.initial is not None:
        policy = load_weights(VisuomotorController, config.initial)
    else:
        n = config.network
        policy = VisuomotorController(config.task.body, n.channels, n.features, n.hidden)
    policy.mixed_precision = True
    return policy


def _teacher(weights: Path | None) -> Driver:
    return scripted_driver if weights is None else PrivilegedDriver(load_weights(PrivilegedPolicy, weights))


class TrainingRun:
    """A run that can stop and go on."""

    def __init__(self, options: Options) -> None:
        """Set everything up and restore the newest checkpoint of the run directory, if there is one."""
        self.options, self.config = options, options.config
        self.directory = RunDirectory(options.run, self.config)
        done = self._steps_done()
        self._metrics: dict[str, Any] = {}
        self.learner = make_learner(
            self.config, threads=options.threads, device=options.device, stream=done,
            bags=options.bags, bag_share=options.bag_share,
        )  # fmt: skip
        learner = self.learner
        snapshot = self.directory.load(modules=learner.modules, optimisers=learner.optimisers)
        if snapshot is not None:
            learner.frames, learner.updates = snapshot.step, snapshot.extra["updates"]

    def _steps_done(self) -> int:
        snapshot = self.directory.load(modules={})
        return 0 if snapshot is None else snapshot.step

    def run(self) -> None:
        """Train until the steps or seconds are over or a signal comes; then evaluate and export."""
        learner, steps = self.learner, self.config.steps
        with TrainingLog(self.directory, total=steps, initial=learner.frames, unit="frame") as log:
            with StopSignal() as stop:
                self._loop(log, stop, TimeLimit(self.options.seconds))
            if learner.frames >= steps:
                self._evaluate(log)
            self._save()

    def _loop(self, log: TrainingLog, stop: StopSignal, limit: TimeLimit) -> None:
        learner, options = self.learner, self.options
        guard, saved, evaluated = NaNGuard(), 0.0, learner.frames
        while learner.frames < self.config.steps and not stop.requested and not limit.reached:
            before, summary = learner.frames, OutcomeSummary()
            for step in learner.collect():
                summary.add(step.outcomes)
            stats = learner.learn()
            guard.accept(*stats.values())
            log.advance(learner.frames - before)
            log.scalars(learner.frames, {**stats, **flatten(summary)})
            if limit.elapsed - saved > options.save_every:
                saved = limit.elapsed
                self._save()
            if learner.frames - evaluated >= options.evaluate_every:
                evaluated = learner.frames
                self._evaluate(log)

    def _save(self) -> None:
        learner = self.learner
        self.directory.save(
            learner.frames, modules=learner.modules, optimisers=learner.optimisers,
            extra={"updates": learner.updates},
        )  # fmt: skip
        self._export()

    def _export(self) -> None:
        config, learner = self.config, self.learner
        record = {
            **provenance(),
            "training": self.directory.config,
            "teacher": "scripted driver" if config.teacher is None else digest(config.teacher),
            "initial": None if config.initial is None else digest(config.initial),
            "data": f"generated levels of difficulty {config.task.difficulty}, seeds of TRAIN_SEEDS",
            "bags": [str(bag) for bag in self.options.bags],
            "steps": learner.frames,
            "updates": learner.updates,
            "metrics": self._metrics,
        }
        name = "teacher" if config.stage == "teacher" else "controller"
        path = self.directory.path / f"{name}.safetensors"
        save_weights(path, learner.product, learner.product.config, record)

    def _evaluate(self, log: TrainingLog) -> None:
        options, learner = self.options, self.learner
        if not options.evaluation_episodes:
            return
        product: nn.Module = learner.product
        product.eval()
        report = judge(
            learner.driver, OraclePlanner(), episodes=options.evaluation_episodes, body=self.config.task.body,
            world=self.config.task.world, difficulty=self.config.task.difficulty, threads=options.threads,
        )  # fmt: skip
        product.train()
        kinds = report["instructions"]["kinds"]
        values = {"evaluation/solved": report["success_rate"]}
        values |= {f"evaluation/{kind}": kinds[kind]["success_rate"] for kind in kinds}
        log.scalars(learner.frames, values)
        log.message(f"{learner.frames} frames: {report['success_rate']:.3f} of levels solved; lost {report['lost']}")
        self._metrics = {"steps": learner.frames, **report}


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
    try:
        options = tyro.cli(Options)
        torch.set_num_threads(options.threads)
        TrainingRun(options).run()
    except (ValueError, OSError) as error:
        print(f"mujoban_controller.train: error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
