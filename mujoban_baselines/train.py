"""Train an agent of Table 1: `python -m mujoban_baselines.train METHOD --run DIR`.

Methods: monolithic-mpo, clone (what MPO may start from), monolithic-vtrace, structured-vtrace; and joint, which
fine-tunes the modular stack.

Give the directory again to resume a run; it leaves `agent.safetensors`, for `bringup/evaluate.py --agent`, or
`controller.safetensors` and `planner.safetensors`, for `--controller` and `--planner`.
"""

from __future__ import annotations

if __name__ == "__main__":
    from mujoban_core.early import end_at_once

    end_at_once()

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal

import numpy as np
import torch
import tyro

from mujoban_baselines.actor import TaskFactory, make_actor
from mujoban_baselines.agents import MonolithicAgent, StructuredAgent, TopDownAgent
from mujoban_baselines.cloning import BagSource, CloningConfig, CloningLearner
from mujoban_baselines.critics import AsymmetricCritic, Critic, SymmetricCritic
from mujoban_baselines.impala import VTraceLearner, VTraceTrainingConfig
from mujoban_baselines.joint.learner import joint_parts
from mujoban_baselines.joint.settings import JointSettings, StartingWeights
from mujoban_baselines.mpo import MPOLearner, MPOTrainingConfig, WindowStore
from mujoban_baselines.networks import RecurrentAgent
from mujoban_baselines.task import MujobanTask, TaskConfig
from mujoban_core.bodies import get_body
from mujoban_core.program import read_options, run_command
from mujoban_core.ranges import check_counts, check_positive
from mujoban_core.threads import set_threads
from mujoban_msgs_py.bags.training import bags_digest
from mujoban_rl.actors import ActorOptions, ActorSource, Rollouts, learner_generators
from mujoban_rl.engine import Budget, Cadence, Learner, Source, Trainer
from mujoban_rl.exploration import Exploration
from mujoban_rl.run_directory import RunDirectory
from mujoban_rl.weights import load_weights, origin, provenance
from mujoban_sim.presets import DEFAULT_WORLD

PROG = "mujoban_baselines.train"
MPO_PACE: Final = {"log_updates": 50, "publish_updates": 5}
"""How often a run of MPO logs and publishes."""
Size = Literal["S", "M", "L"]


@dataclass(frozen=True)
class RunConfig:
    """What must not change between the bits of a run, whatever the method."""

    steps: int = 20_000_000
    """Environment steps of all robots together, or ticks of bags, at which the run is complete."""
    cpu_seconds: float = 1e9
    """CPU seconds of all its processes at which it is complete, if its steps have not come first."""
    seed: int = 0
    """Seed of networks and of all that is drawn."""

    def __post_init__(self) -> None:
        """Reject a budget of nothing and what is no seed."""
        check_counts(self, "steps")
        check_positive(self, "cpu_seconds")
        check_counts(self, "seed", least=0)

    @property
    def budget(self) -> Budget:
        """When the run is complete."""
        return Budget(samples=self.steps, cpu_seconds=self.cpu_seconds)

    @property
    def data(self) -> dict[str, Any]:
        """What it learns from, as far as this says it, for the record."""
        return {}


@dataclass(frozen=True)
class PlayConfig(RunConfig):
    """A run that learns from its own play."""

    task: Annotated[TaskConfig, tyro.conf.arg(name="")] = field(default_factory=TaskConfig)

    @property
    def data(self) -> dict[str, Any]:
        """The levels that are played, their world, and the steps of an episode, whoever set them."""
        levels = f"own play of generated levels ({self.task.levels}), training seeds"
        return {"data": levels, "world": self.task.world, "time_limit": self.task.steps}


@dataclass(frozen=True)
class AgentRunConfig(PlayConfig):
    """A run of an agent that says torques itself."""

    repeat: int = 1
    """Ticks for which each torque is held, in play as well (action repeat); returns, and windows, unrolls and the
    replay count decisions."""
    draws: Exploration | None = None
    """Noise by which its torques are drawn in play, too, such as that by which it explores, whatever weights to start
    from were drawn by; None: their means."""

    @property
    def play(self) -> dict[str, Any]:
        """What an agent's class is to be told of both; nothing of what holds for every agent."""
        told = {"repeat": self.repeat, "draws": self.draws}
        return {name: value for name, value in told.items() if value != getattr(RecurrentAgent, name)}


@dataclass(frozen=True)
class MPORunConfig(AgentRunConfig):
    """A run of monolithic MPO."""

    size: Size = "S"
    """Variant of the network."""
    critic: Literal["asymmetric", "symmetric"] = "asymmetric"
    """What the critic sees: the simulator's truth, or what the agent sees, on one torso."""
    start: Path | None = None
    """Weights to start from, such as those of a cloning, of the same size."""
    mpo: MPOTrainingConfig = field(default_factory=MPOTrainingConfig)


@dataclass(frozen=True)
class VTraceRunConfig(AgentRunConfig):
    """A run of V-trace."""

    task: Annotated[TaskConfig, tyro.conf.arg(name="")] = field(
        default_factory=lambda: TaskConfig(levels="curriculum", episode_seconds=None)
    )
    vtrace: VTraceTrainingConfig = field(default_factory=VTraceTrainingConfig)


@dataclass(frozen=True)
class CloneRunConfig(RunConfig):
    """A run of behaviour cloning."""

    body: str = "ball"
    """Body of the robot in the bags, by name."""
    size: Size = "S"
    """Variant of the network."""
    world: str = DEFAULT_WORLD
    """Of the bags."""
    cloning: CloningConfig = field(default_factory=CloningConfig)


@dataclass(frozen=True)
class JointRunConfig(PlayConfig):
    """A joint fine-tuning of planner and controller."""

    task: Annotated[TaskConfig, tyro.conf.arg(name="")] = field(
        default_factory=lambda: TaskConfig(robots=32, episode_seconds=None)
    )
    start: StartingWeights = field(default_factory=StartingWeights)
    """Weights of the four modules; by default what ships."""
    joint: Annotated[JointSettings, tyro.conf.arg(name="")] = field(default_factory=JointSettings)

    @property
    def data(self) -> dict[str, Any]:
        """Also the ticks of a look around."""
        return {**super().data, "look_around": self.joint.turn(get_body(self.task.body))}


Parts = tuple[Learner[Any], Source[Any]]
"""What a trainer drives."""


def mpo_parts(
    config: MPORunConfig, actors: ActorOptions, task: TaskFactory | None = None,
    kind: type[RecurrentAgent] = MonolithicAgent,
) -> Parts:  # fmt: skip
    """Return learner and source of MPO (paper D.1) with an agent of a kind, on Mujoban or on a task of one's own."""
    torch.manual_seed(config.seed)  # the initial weights
    body, mpo, agent = config.task.body, config.mpo, _agent(config, kind)
    build = partial(kind, **agent.config)
    critic: Critic = AsymmetricCritic(body) if config.critic == "asymmetric" else SymmetricCritic(body, agent.width)
    generators = learner_generators(config.seed, 2)
    plays = task or partial(MujobanTask, config.task)
    factory = partial(make_actor, plays, build, mpo.window, mpo.overlap, critic.sees, mpo.exploration, config.seed)
    store = WindowStore(mpo, generators[0])
    steps = agent.repeat * mpo.steps_per_update
    source = ActorSource(actors.pool(factory), store, steps_per_update=steps, first_steps=mpo.first)
    return MPOLearner(agent, critic, mpo, generators[1]), source


def _agent(config: MPORunConfig, kind: type[RecurrentAgent]) -> RecurrentAgent:
    """Return the agent of a kind that a run trains: a new one, or what its weights to start from are of.

    Raises:
        ValueError: If the weights do not fit, are of another size, or of torques that are held for other ticks.
    """
    body, start = config.task.body, config.start
    sizes = {"size": config.size} if kind is MonolithicAgent else {}
    if not sizes and config.size != MPORunConfig.size:
        raise ValueError(f"--size {config.size}: {kind.__name__} has no sizes")
    if start is None:
        return kind(body, **sizes, **config.play)  # pyright: ignore[reportCallIssue]
    found = load_weights(kind, start, body=body)
    # Weights of a class that takes no `repeat` do not name it: it is the class's own then.
    held = {**{name: found.config.get(name) for name in sizes}, "repeat": found.repeat}
    for name, value in held.items():
        if value != (asked := getattr(config, name)):
            raise ValueError(f"--{name} {asked}: {start} holds weights of {name} {value}, expected that")
    if found.draws == config.draws:
        return found.train()
    plays = {name: value for name, value in found.config.items() if name != "draws"}
    if config.draws is not None:
        plays["draws"] = config.draws
    agent = kind(**plays)
    agent.load_state_dict(found.state_dict())
    return agent


def vtrace_parts(
    config: VTraceRunConfig, kind: type[RecurrentAgent], actors: ActorOptions, task: TaskFactory | None = None
) -> Parts:
    """Return learner and source of V-trace with an agent of a kind (paper D.2)."""
    torch.manual_seed(config.seed)  # the initial weights
    unroll, build = config.vtrace, partial(kind, config.task.body, **config.play)
    plays = task or partial(MujobanTask, config.task)
    factory = partial(make_actor, plays, build, unroll.length, 1, (), unroll.exploration, config.seed)
    source = ActorSource(actors.pool(factory), Rollouts(axis=1, count=actors.num_actors))
    return VTraceLearner(build(), unroll), source


def clone_parts(config: CloneRunConfig, bags: Sequence[Path]) -> Parts:
    """Return learner and source of a cloning from bags.

    Raises:
        BagError: If there is no bag at a path, or one lacks a topic, is of another body or world, or not for training.
    """
    torch.manual_seed(config.seed)  # the initial weights
    agent = MonolithicAgent(config.body, config.size)
    about = {"body": config.body, "world": config.world}
    source = BagSource(bags, agent, config.cloning, np.random.default_rng(config.seed), about)
    return CloningLearner(agent, config.cloning), source


def make_trainer(
    config: RunConfig, parts: Parts, run: Path, cadence: Cadence, method: str, *, data: Mapping[str, Any] | None = None,
    start: str | dict[str, str] | None = None,
) -> Trainer[Any]:  # fmt: skip
    """Make, or resume, a run of a method.

    Args:
        config: What must not change between its bits.
        parts: Learner and source.
        run: Its directory.
        cadence: How often it logs, publishes and saves.
        method: Its name.
        data: What it learns from beside what `config` says, for the record.
        start: Digest of the weights that it starts from, or of each of them by name.
    """
    directory = RunDirectory(run, config, beside={"method": method, "origins": start})
    record = {
        **provenance(),
        "training": {**directory.options, "method": method},
        "start": start,
        **config.data,
        **(data or {}),
    }
    return Trainer(directory, *parts, config.budget, cadence, record=record)


@dataclass(frozen=True)
class _Command(ABC):
    """What all trainings have in common."""

    run: Path
    """Run directory; an existing one is resumed."""
    seconds: float | None = None
    """Stop after so many seconds; resume later."""
    save_every: float = 300.0
    """Seconds between checkpoints."""
    threads: int = 1
    """Threads of the networks."""

    @abstractmethod
    def trainer(self) -> Trainer[Any]:
        """Make or resume the run."""

    def cadence(self, log_updates: int, publish_updates: int) -> Cadence:
        """Return how often the run logs, publishes and saves."""
        return Cadence(log_updates, publish_updates, save_seconds=self.save_every)


@dataclass(frozen=True)
class _ActorCommand(_Command):
    """What trainings with actors have in common."""

    actors: Annotated[ActorOptions, tyro.conf.arg(name="")] = field(default_factory=ActorOptions)
    """Where the robots are."""


@dataclass(frozen=True)
class MonolithicMPO(_ActorCommand):
    """Monolithic RL: camera, proprioception and pose to torques, by MPO (paper D.1).

    A subclass of this or of `MonolithicVTrace` trains another `kind` of agent, under a `method`'s name of its own.
    """

    kind: ClassVar[type[RecurrentAgent]] = MonolithicAgent
    method: ClassVar[str] = "monolithic-mpo"

    config: Annotated[MPORunConfig, tyro.conf.arg(name="")] = field(default_factory=MPORunConfig)

    def trainer(self) -> Trainer[Any]:
        """Make or resume the run."""
        parts, start = mpo_parts(self.config, self.actors, kind=self.kind), origin(self.config.start)
        return make_trainer(self.config, parts, self.run, self.cadence(**MPO_PACE), self.method, start=start)


@dataclass(frozen=True)
class Clone(_Command):
    """Behaviour cloning of whoever played recorded bags, for `monolithic-mpo --start`."""

    bags: tuple[Path, ...] = ()
    """Bags, or folders of bags, such as `bringup/record.py --undisturbed` writes."""
    config: Annotated[CloneRunConfig, tyro.conf.arg(name="")] = field(default_factory=CloneRunConfig)

    def trainer(self) -> Trainer[Any]:
        """Make or resume the run."""
        if not self.bags:
            raise ValueError("--bags is missing, expected bags or folders of bags")
        parts = clone_parts(self.config, self.bags)
        names = ", ".join(bag.name for bag in self.bags)
        data = {"data": f"bags {names}", "bags_digest": bags_digest(self.bags), "world": self.config.world}
        return make_trainer(self.config, parts, self.run, self.cadence(100, 1000), "cloning", data=data)


@dataclass(frozen=True)
class MonolithicVTrace(_ActorCommand):
    """Fully observable monolithic RL: view from above and proprioception to torques, by V-trace (paper D.2)."""

    kind: ClassVar[type[RecurrentAgent]] = TopDownAgent
    method: ClassVar[str] = "monolithic-vtrace"

    config: Annotated[VTraceRunConfig, tyro.conf.arg(name="")] = field(default_factory=VTraceRunConfig)

    def trainer(self) -> Trainer[Any]:
        """Make or resume the run."""
        parts = vtrace_parts(self.config, self.kind, self.actors)
        return make_trainer(self.config, parts, self.run, self.cadence(20, 1), self.method)


@dataclass(frozen=True)
class StructuredVTrace(MonolithicVTrace):
    """Fully observable structured RL: also the abstract state, and pseudo rewards for adjacent ones (paper D.2)."""

    kind: ClassVar[type[RecurrentAgent]] = StructuredAgent
    method: ClassVar[str] = "structured-vtrace"


@dataclass(frozen=True)
class Joint(_ActorCommand):
    """The modular stack fine-tuned: planner and controller together by MPO on the overall reward."""

    config: Annotated[JointRunConfig, tyro.conf.arg(name="")] = field(default_factory=JointRunConfig)

    def trainer(self) -> Trainer[Any]:
        """Make or resume the run."""
        config = self.config
        parts = joint_parts(config.task, config.start, config.joint, config.seed, self.actors)
        start = config.start.digests(config.task.body)
        return make_trainer(config, parts, self.run, self.cadence(**MPO_PACE), "joint", start=start)


COMMANDS: dict[str, type[_Command]] = {
    "monolithic-mpo": MonolithicMPO,
    "clone": Clone,
    "monolithic-vtrace": MonolithicVTrace,
    "structured-vtrace": StructuredVTrace,
    "joint": Joint,
}


def main(
    command_line: Sequence[str] | None = None, prog: str = PROG,
    kinds: type[_Command] | Mapping[str, type[_Command]] = COMMANDS,
) -> int:  # fmt: skip
    """Run a command line of one of these kinds of training, or of the only one."""
    command = read_options(kinds, command_line, prog, __doc__ if kinds is COMMANDS else None)
    set_threads(command.threads)
    command.trainer().run(limit_seconds=command.seconds)
    return 0


if __name__ == "__main__":
    run_command(PROG, main)
