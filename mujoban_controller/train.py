"""Train the controller: `python -m mujoban_controller.train --stage teacher|distil|mpo --run DIR`.

1. `teacher`: a privileged policy learns the goal task from its shaped rewards, by MPO or PPO (`--algorithm`).
2. `distil --teacher WEIGHTS`: it is distilled into the camera policy, on the states that this one visits.
3. `mpo --initial WEIGHTS`: the camera policy learns on by MPO with an asymmetric critic (paper C.3), that of its
   teacher by `--critic WEIGHTS`; without initial weights from scratch.

With `--bags`, recorded bags of the running stack join the replay of `distil` and `mpo`; with `--bag-share 1` nothing
else does: such a run learns offline and drives no simulator.

Give the directory again to resume a run.
"""

from __future__ import annotations

if __name__ == "__main__":
    from mujoban_core.early import end_at_once

    end_at_once()

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
import tyro

from mujoban_controller.bag_ticks import BagPlayer, BagTicks
from mujoban_controller.controller import FEATURES, HIDDEN, WIDTHS, VisuomotorController
from mujoban_controller.distil import DistilConfig, DistilLearner, DistilPlayer
from mujoban_controller.episodes import TrainingEpisodes
from mujoban_controller.goal_settings import GoalTaskConfig
from mujoban_controller.goal_task import GoalTask
from mujoban_controller.mpo import AsymmetricConfig, MPOLearner, MPOTrainingConfig
from mujoban_controller.play import Draw, ExploringPlayer, Player, PrivilegedPlayer, ReplaySource
from mujoban_controller.policy import GoalPolicy
from mujoban_controller.ppo import PPOLearner, PPOTrainingConfig, RolloutSource
from mujoban_controller.privileged import Critic, PrivilegedPolicy
from mujoban_controller.product import Validation
from mujoban_core.program import read_options, run_command
from mujoban_core.ranges import check_counts, check_positive
from mujoban_core.threads import set_threads
from mujoban_msgs_py.bags.training import bags_digest, check_batch_share, check_share_has_bags
from mujoban_rl.engine import Budget, Cadence, Learner, Source, Trainer
from mujoban_rl.networks import set_scale
from mujoban_rl.replay import steps_per_update
from mujoban_rl.run_directory import RunDirectory
from mujoban_rl.weights import WeightsError, load_weights, origin, provenance, usable_device
from mujoban_sim.oracles import OraclePlanner

PROG = "mujoban_controller.train"

PLANNER_NODES = 20_000
"""Search nodes for the plans that the goal task follows; levels that need more are played at random."""


@dataclass(frozen=True)
class NetworkConfig:
    """What the camera policy is made of."""

    channels: tuple[int, ...] = WIDTHS
    """Channels of the convolutions, one by one."""
    features: int = FEATURES
    """Features that are read from a frame."""
    hidden: int = HIDDEN
    """Width of the memory."""
    place: bool = True
    """It keeps where the robot is within its cell, unless --network.no-place is given."""
    way: bool = True
    """It works out from that how far it is to where the instruction leads, unless --network.no-way is given."""


@dataclass(frozen=True)
class TrainConfig:
    """What must not change between the bits of a run."""

    stage: Literal["teacher", "distil", "mpo"] = "teacher"
    """What is trained: a privileged teacher, its student that sees, or a student that goes on by reward."""
    algorithm: Literal["mpo", "ppo"] = "ppo"
    """What teaches the teacher."""
    steps: int = 1_500_000
    """Environment steps of all robots together."""
    cpu_seconds: float = 1e9
    """CPU seconds of training at which the run is complete, if its steps have not come first."""
    horizon_seconds: float = 1e9
    """Wall-clock seconds of training likewise: the measure where a GPU computes."""
    seed: int = 0
    """Seed of networks, levels and noise."""
    initial: Path | None = None
    """Weights to start from."""
    teacher: Path | None = None
    """Weights of the privileged teacher that the stage distil needs."""
    critic: Path | None = None
    """Weights of the critic that MPO begins with, which MPO of a teacher leaves beside the teacher's."""
    task: GoalTaskConfig = field(default_factory=GoalTaskConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    ppo: PPOTrainingConfig = field(default_factory=PPOTrainingConfig)
    mpo: MPOTrainingConfig = field(default_factory=MPOTrainingConfig)
    """Of the stage teacher."""
    distil: DistilConfig = field(default_factory=DistilConfig)
    asymmetric: AsymmetricConfig = field(
        default_factory=lambda: AsymmetricConfig(
            window=16, windows=16, sequence=16, replay=64_000, first=6_000, reuse=2.0, normalised=2_000,
            critic_updates=4, critic_first=1_500, average=0.99, initial_scale=0.25, policy_rate=1e-4,
        )
    )
    """Of the stage mpo."""

    def __post_init__(self) -> None:
        """Reject settings that contradict each other."""
        check_counts(self, "steps")
        check_counts(self, "seed", least=0)
        check_positive(self, "cpu_seconds", "horizon_seconds")
        if self.teacher is not None and self.stage != "distil":
            raise ValueError(f"--teacher {self.teacher}: only the stage distil has a teacher, not {self.stage}")
        if self.teacher is None and self.stage == "distil":
            raise ValueError("--stage distil: expected --teacher, weights of a run of the stage teacher")
        if self.critic is not None and (self.stage == "distil" or (self.stage, self.algorithm) == ("teacher", "ppo")):
            raise ValueError(f"--critic {self.critic}: only MPO has such a critic, not --stage {self.stage}")


@dataclass(frozen=True)
class Options:
    """Train the controller."""

    run: Path
    """Run directory; an existing one is resumed."""
    config: Annotated[TrainConfig, tyro.conf.arg(name="")] = field(default_factory=TrainConfig)
    bags: tuple[Path, ...] = ()
    """Recorded bags, or folders of bags, whose ticks join the replay of the stages distil and mpo."""
    bag_share: float = 0.25
    """Share of the replay's new ticks that comes from bags, if there are any; 1: all, and nothing is simulated."""
    seconds: float | None = None
    """Stop after so many seconds and judge what was learned, which takes minutes; resume later."""
    evaluate_every: int = 300_000
    """Environment steps between evaluations on validation levels."""
    evaluation_episodes: int = 64
    """Validation levels of an evaluation; 0: none is made."""
    save_every: float = 300.0
    """Seconds between checkpoints."""
    threads: int = 1
    """For physics and pictures, and for networks on the CPU."""
    device: str = "cpu"
    """Device of the networks: cpu or cuda, such as cuda:0."""

    def __post_init__(self) -> None:
        """Reject a device that is not there and bags that nothing would learn from."""
        usable_device(self.device)
        check_counts(self, "evaluation_episodes", least=0)
        if self.bags and self.config.stage == "teacher":
            raise ValueError("--bags: a teacher does not learn from them; expected --stage distil or mpo")
        check_batch_share(self.bag_share)
        check_share_has_bags(self.bag_share, Options.bag_share, self.bags)


class _Parts:
    """Makes learner and source of a stage; every random stream has a seed of its own."""

    def __init__(self, options: Options, began: int) -> None:
        """Make them; `began` sets the streams of a run that was copied lightly apart from those it had before."""
        self.options, self.config = options, options.config
        config = self.config
        self.device = usable_device(options.device)
        torch.manual_seed(config.seed)
        # With nothing before, the streams of the seed alone: NumPy takes a missing number for 0.
        self._streams = iter(np.random.SeedSequence([config.seed, began]).spawn(8))
        self._rng = np.random.default_rng(next(self._streams))
        self.validation = Validation(
            options.evaluation_episodes, config.task.body, config.task.difficulty, config.task.world, options.threads
        )

    @cached_property
    def task(self) -> GoalTask:
        """What is played, in a world of its own; a run that learns from bags alone never makes it."""
        task, rng = self.config.task, self._rng
        episodes = TrainingEpisodes(task.difficulty, rng, max_nodes=PLANNER_NODES)
        return GoalTask(task, OraclePlanner(max_nodes=PLANNER_NODES), episodes, rng, threads=self.options.threads)

    def generator(self) -> torch.Generator:
        return torch.Generator().manual_seed(int(next(self._streams).generate_state(1, np.uint64)[0] >> 1))

    def make(self) -> tuple[Learner[Any], Source[Any]]:
        """Return the learner and the source of the run's stage."""
        if self.config.stage == "distil":
            return self._distil()
        if self.config.stage == "mpo":
            return self._asymmetric()
        return self._ppo() if self.config.algorithm == "ppo" else self._mpo()

    def _ppo(self) -> tuple[Learner[Any], Source[Any]]:
        config, policy = self.config, self._privileged(0.4)
        learner = PPOLearner(policy, config.task.body, config.ppo, self.generator(), self.validation)
        return learner, RolloutSource(self.task, policy, config.ppo.length, self.generator())

    def _mpo(self) -> tuple[Learner[Any], Source[Any]]:
        config, policy = self.config, self._privileged(0.6)
        learner = self._learner(policy, config.mpo)
        player = PrivilegedPlayer(self.task, policy, self.generator(), config.mpo.explore, config.mpo.steady)
        return learner, self._replay(player, config.mpo)

    def _asymmetric(self) -> tuple[Learner[Any], Source[Any]]:
        config, policy = self.config, self._camera()
        if config.asymmetric.initial_scale:
            set_scale(policy.scale, config.asymmetric.initial_scale)
        learner = self._learner(policy, config.asymmetric)

        def player() -> Player:
            explore, steady = config.asymmetric.explore, config.asymmetric.steady
            return ExploringPlayer(self.task, policy, self.generator(), explore, steady)

        return learner, self._replay_with_bags(player, policy, config.asymmetric)

    def _learner(self, policy: GoalPolicy, settings: MPOTrainingConfig) -> MPOLearner:
        path, body = self.config.critic, self.config.task.body
        critic = None if path is None else load_weights(Critic, path).train()
        if critic is not None and critic.config != Critic(body).config:
            raise WeightsError(f"{path}: a critic of {critic.config}, expected one of {Critic(body).config}")
        return MPOLearner(policy, body, settings, self.generator(), self.validation, critic)

    def _distil(self) -> tuple[Learner[Any], Source[Any]]:
        config, student = self.config, self._camera()
        assert config.teacher is not None
        teacher = load_weights(PrivilegedPolicy, config.teacher, body=config.task.body)
        learner = DistilLearner(student, config.distil, self.generator(), self.validation)

        def player() -> Player:
            return DistilPlayer(self.task, student, teacher.driver(), config.distil, self.generator())

        return learner, self._replay_with_bags(player, student, config.distil, teacher)

    def _replay_with_bags(
        self,
        make_player: Callable[[], Player],
        policy: VisuomotorController,
        settings: MPOTrainingConfig | DistilConfig,
        teacher: PrivilegedPolicy | None = None,
    ) -> ReplaySource:
        """Return the replay of what a player plays, of recorded ticks, or of both."""
        options, batch = self.options, self.config.task.batch
        if not options.bags:
            return self._replay(make_player(), settings)
        if options.bag_share == 1.0:
            return self._replay(self._recorded(policy, batch, teacher), settings)
        rows = max(1, round(batch * options.bag_share / (1.0 - options.bag_share)))
        player = make_player()
        return self._replay(player, settings, self._recorded(policy, rows, teacher), rows)

    def _recorded(self, policy: VisuomotorController, rows: int, teacher: PrivilegedPolicy | None) -> BagPlayer:
        own = deepcopy(policy)
        rng = np.random.default_rng(next(self._streams))
        return BagPlayer(BagTicks(self.options.bags, self.config.task, own, rows, rng, teacher), own)

    def _replay(
        self, player: Player, settings: MPOTrainingConfig | DistilConfig, recorded: Player | None = None,
        rows: int = 0,
    ) -> ReplaySource:  # fmt: skip
        width = self.config.task.batch + rows
        per_batch = steps_per_update(settings.windows, settings.window - settings.skipped, settings.reuse)
        critic = settings.critic_draw if isinstance(settings, AsymmetricConfig) else None
        draw = Draw(
            capacity=max(settings.replay // settings.sequence, 1), length=settings.sequence, window=settings.window,
            windows=settings.windows, per_tick=width / per_batch, first=settings.first // width,
            critic=critic,
        )  # fmt: skip
        return ReplaySource(player, draw, self.generator(), recorded)

    def _privileged(self, scale: float) -> PrivilegedPolicy:
        config = self.config
        if config.initial is not None:
            return load_weights(PrivilegedPolicy, config.initial, self.device, body=config.task.body).train()
        return PrivilegedPolicy(config.task.body, scale=scale).to(self.device)

    def _camera(self) -> VisuomotorController:
        config, n = self.config, self.config.network
        if config.initial is not None:
            policy = load_weights(VisuomotorController, config.initial, body=config.task.body)
            _check_network(n, policy.config, config.initial)
        else:
            policy = VisuomotorController(config.task.body, n.channels, n.features, n.hidden, n.place, n.way)
        policy.mixed_precision = True
        return policy.to(self.device).train()


def _check_network(asked: NetworkConfig, own: Mapping[str, Any], weights: Path) -> None:
    """Raise a ValueError if options ask for another network than that of the weights that training begins with."""
    default = asdict(NetworkConfig())
    for name, value in asdict(asked).items():
        has = tuple(own[name]) if isinstance(value, tuple) else own[name]
        if value not in (default[name], has):
            raise ValueError(f"--network.{name} {value}: that of --initial {weights} is {has}, expected it or none")


def _data(options: Options) -> str:
    """Return what weights learn from, for their record."""
    played = f"generated levels of difficulty {options.config.task.difficulty}, seeds of TRAIN_SEEDS"
    if not options.bags:
        return played
    return "recorded bags" if options.bag_share == 1.0 else f"{played}; recorded bags"


def make_trainer(options: Options) -> Trainer[Any]:
    """Make, or resume, a run.

    Raises:
        ValueError: If weights, a bag or the run directory are not what is expected.
    """
    config = options.config
    origins = {name: origin(getattr(config, name)) for name in ("teacher", "initial", "critic")}
    beside = {"bag_share": options.bag_share if options.bags else None, "origins": origins}
    directory = RunDirectory(options.run, config, beside=beside)
    learner, source = _Parts(options, directory.began).make()
    record = {
        **provenance(),
        "training": directory.options,
        **origins,
        "data": _data(options),
        "world": config.task.world,
        "bags": [bag.name for bag in options.bags],
        "bags_digest": bags_digest(options.bags),
    }
    on_policy = config.stage == "teacher" and config.algorithm == "ppo"
    cadence = Cadence(
        log_updates=20 if on_policy else 200, publish_updates=1 if on_policy else 10,
        evaluate_samples=options.evaluate_every, save_seconds=options.save_every,
        # What such a run begins with is what it makes if nothing later solves as much.
        evaluate_first=config.initial is not None,
    )  # fmt: skip
    budget = Budget(samples=config.steps, cpu_seconds=config.cpu_seconds, seconds=config.horizon_seconds)
    return Trainer(directory, learner, source, budget, cadence, record=record)


def main(command_line: Sequence[str] | None = None, prog: str = PROG) -> int:
    """Run the command."""
    options = read_options(Options, command_line, prog, __doc__)
    # Beside a GPU only physics and pictures have work for several, and those have threads of their own.
    set_threads(options.threads if usable_device(options.device).type == "cpu" else 1)
    make_trainer(options).run(limit_seconds=options.seconds)
    return 0


if __name__ == "__main__":
    run_command(PROG, main)
