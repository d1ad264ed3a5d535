"""Train the planner or what says where to look: `python -m mujoban_planner.train METHOD`.

METHOD is imitation, expert-iteration, ppo, mpo, mpo-pushes, stages or explorer.
"""

from __future__ import annotations

if __name__ == "__main__":
    from mujoban_core.early import end_at_once

    end_at_once()

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro

from mujoban_core.program import read_options, run_command
from mujoban_core.threads import set_threads
from mujoban_msgs_py.bags.training import check_share_has_bags
from mujoban_planner.expert_iteration import ExpertIterationConfig, expert_iteration
from mujoban_planner.exploration_mpo import ExplorerConfig, explore
from mujoban_planner.imitation import ImitationConfig, imitation
from mujoban_planner.push_mpo import PushMPOConfig, push_mpo
from mujoban_planner.push_ppo import PPO_PACE, PushPPOConfig, push_ppo
from mujoban_planner.reinforcement import MPO_PACE, MPOConfig, reinforcement
from mujoban_planner.stages import StagesConfig, train_stages
from mujoban_rl.actors import ActorOptions
from mujoban_rl.engine import Cadence
from mujoban_rl.weights import usable_device

PROG = "mujoban_planner.train"


@dataclass(frozen=True)
class _Command(ABC):
    """What all trainings have in common."""

    seconds: float | None = None
    """Stop after so many seconds and judge what was learned, which takes minutes; a later call resumes."""
    evaluate_every: float = 300.0
    """Seconds between evaluations on held-out levels."""
    evaluate_samples: float = math.inf
    """Samples between evaluations, beside those by seconds; the first is then of what the run begins with."""
    save_every: float = 120.0
    """Seconds between checkpoints."""
    threads: int = 1
    """Threads of the network on a CPU."""

    @abstractmethod
    def main(self) -> None:
        """Train."""

    def cadence(self, *, log_updates: int = 100, publish_updates: int = 10) -> Cadence:
        """Return how often the run logs, publishes, evaluates and saves."""
        return Cadence(
            log_updates, publish_updates, self.evaluate_samples, self.evaluate_every, self.save_every,
            evaluate_first=math.isfinite(self.evaluate_samples),
        )  # fmt: skip


@dataclass(frozen=True)
class _ActorCommand(_Command):
    """What trainings with actors have in common."""

    actors: Annotated[ActorOptions, tyro.conf.arg(name="")] = field(default_factory=ActorOptions)
    """Where levels are played or searched."""


@dataclass(frozen=True)
class Imitation(_ActorCommand):
    """Imitate the solver."""

    run: Path = Path("runs/planner")
    """Run directory; an existing one is resumed."""
    device: str = "cpu"
    """Device of the network."""
    samples: float = 1e12
    """Stop at so many samples; a later call resumes."""
    bags: tuple[Path, ...] = ()
    """Recorded bags, or folders of bags, whose decisions join the lessons, labelled by the solver."""
    actors: Annotated[ActorOptions, tyro.conf.arg(name="")] = field(default_factory=partial(ActorOptions, "processes"))
    """Where lessons are made: in a process beside, unless told otherwise."""
    config: tyro.conf.OmitArgPrefixes[ImitationConfig] = field(default_factory=ImitationConfig)

    def __post_init__(self) -> None:
        """Reject a share of nothing."""
        check_share_has_bags(self.config.bag_share, ImitationConfig.bag_share, self.bags)

    def main(self) -> None:
        """Train."""
        trainer = imitation(
            self.config, self.run, self.cadence(), device=self.device, actors=self.actors, bags=self.bags
        )
        trainer.run(limit_seconds=self.seconds, limit_samples=self.samples)


@dataclass(frozen=True)
class MPO(_ActorCommand):
    """Maximum a posteriori policy optimisation in the abstract environment (paper C.2)."""

    run: Path = Path("runs/planner_mpo")
    """Run directory; an existing one is resumed."""
    init: Path | None = None
    """Weights to start from, such as those of an imitation, of the same or fewer channels and blocks; none trains by
    MPO alone."""
    bags: tuple[Path, ...] = ()
    """Recorded bags whose transitions join the replay."""
    device: str = "cpu"
    """Device of the network, and of actors in the same process."""
    updates: float = float("inf")
    """Stop at so many updates; a later call resumes."""
    config: tyro.conf.OmitArgPrefixes[MPOConfig] = field(default_factory=MPOConfig)

    def __post_init__(self) -> None:
        """Reject a share of nothing."""
        check_share_has_bags(self.config.bag_share, MPOConfig.bag_share, self.bags)

    def main(self) -> None:
        """Train."""
        trainer = reinforcement(
            self.config, self.run, self.cadence(**MPO_PACE), device=self.device,
            actors=self.actors, init=self.init, bags=self.bags,
        )  # fmt: skip
        trainer.run(limit_seconds=self.seconds, limit_updates=self.updates)


@dataclass(frozen=True)
class ExpertIteration(_ActorCommand):
    """Learn from what the planner's own search finds, without a solver."""

    run: Path = Path("runs/planner_search")
    """Run directory; an existing one is resumed."""
    device: str = "cpu"
    """Device of the networks, of the learner and of those who search."""
    config: tyro.conf.OmitArgPrefixes[ExpertIterationConfig] = field(default_factory=ExpertIterationConfig)

    def main(self) -> None:
        """Train."""
        trainer = expert_iteration(self.config, self.run, self.cadence(), self.actors, device=self.device)
        trainer.run(limit_seconds=self.seconds)


@dataclass(frozen=True)
class PPO(_ActorCommand):
    """Proximal policy optimisation over pushes."""

    run: Path = Path("runs/planner_ppo")
    """Run directory; an existing one is resumed."""
    config: tyro.conf.OmitArgPrefixes[PushPPOConfig] = field(default_factory=PushPPOConfig)

    def main(self) -> None:
        """Train."""
        push_ppo(self.config, self.run, self.cadence(**PPO_PACE), self.actors).run(limit_seconds=self.seconds)


@dataclass(frozen=True)
class MPOPushes(_ActorCommand):
    """Maximum a posteriori policy optimisation over pushes."""

    run: Path = Path("runs/planner_mpo_pushes")
    """Run directory; an existing one is resumed."""
    config: tyro.conf.OmitArgPrefixes[PushMPOConfig] = field(default_factory=PushMPOConfig)

    def main(self) -> None:
        """Train."""
        push_mpo(self.config, self.run, self.cadence(), self.actors).run(limit_seconds=self.seconds)


@dataclass(frozen=True)
class Stages(_ActorCommand):
    """Several methods one after the other, each from the weights of the one before."""

    run: Path = Path("runs/planner_stages")
    """Run directory, with a folder for each stage; an existing one is resumed."""
    device: str = "cpu"
    """Device of the networks; PPO and MPO over pushes compute on the CPU all the same."""
    config: tyro.conf.OmitArgPrefixes[StagesConfig] = field(default_factory=StagesConfig)

    def main(self) -> None:
        """Train."""
        usable_device(self.device)  # what needs it may come hours later
        train_stages(self.config, self.run, self.cadence(), self.actors, self.seconds, device=self.device)


@dataclass(frozen=True)
class ExplorerRun(_ActorCommand):
    """Learn by MPO where to look before pushing."""

    run: Path = Path("runs/explorer")
    """Run directory; an existing one is resumed."""
    config: tyro.conf.OmitArgPrefixes[ExplorerConfig] = field(default_factory=ExplorerConfig)

    def main(self) -> None:
        """Train."""
        explore(self.config, self.run, self.cadence(), self.actors).run(limit_seconds=self.seconds)


def main(command_line: Sequence[str] | None = None, prog: str = PROG) -> int:
    """Run the command line."""
    commands: dict[str, type[_Command]] = {
        "imitation": Imitation,
        "expert-iteration": ExpertIteration,
        "ppo": PPO,
        "mpo": MPO,
        "mpo-pushes": MPOPushes,
        "stages": Stages,
        "explorer": ExplorerRun,
    }
    command = read_options(commands, command_line, prog, __doc__)
    set_threads(command.threads)
    command.main()
    return 0


if __name__ == "__main__":
    run_command(PROG, main)
