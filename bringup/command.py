"""What the commands have in common: the modules that they play with, and the levels that may be recorded.

Whatever takes long to import is imported where it is used, so that a command can tell its options, and be interrupted,
at once.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from mujoban_core.agent import Agent, AgentPolicy, beyond_senses
from mujoban_core.bodies import BALL, get_body
from mujoban_core.look_around import look_around
from mujoban_core.plugins import (
    AGENT,
    LEARNED,
    ORACLE,
    PRIVILEGED,
    ROLES,
    SCOUT,
    SCRIPTED,
    check_body,
    check_told,
    chosen_weights,
    load_module,
    load_scout,
    shipped_weights,
)
from mujoban_core.program import say
from mujoban_planner.deliberation import Deliberation

if TYPE_CHECKING:
    from mujoban_core.interfaces import Module
    from mujoban_core.sense_plan_act import SensePlanAct


@dataclass(frozen=True)
class Choice:
    """Which module plays a role."""

    role: str
    source: str = LEARNED
    weights: Path | None = None

    @classmethod
    def parse(cls, role: str, text: str) -> Choice:
        """Read `learned`, `oracle`, a `.safetensors` file or `package.module:Class`."""
        if text.endswith(".safetensors"):
            return cls(role, LEARNED, Path(text))
        return cls(role, text)

    def of(self, body: str) -> Choice:
        """Return the same with the weights that ship for a body, or its oracle, where it takes those that ship."""
        if (self.role, self.source) == ("controller", ORACLE):
            return oracle(self.role, body)
        return replace(self, weights=chosen_weights(self.role, self.source, self.weights, body))

    def load(self, device: str = "cpu") -> Module:
        """Return the module.

        Raises:
            ValueError: If it cannot be found, or its weights are missing or damaged.
        """
        return load_module(self.role, self.source, self.weights, device)

    @cached_property
    def told(self) -> bool | None:
        """Whether it asks for the ground truth, as reports say; None of an oracle, whose name says so in any case.

        An instance made for it is asked, once; what plays is held to the answer, see `check_told`.

        Raises:
            ValueError: See `load`.
        """
        if self.source == ORACLE:
            return None
        # A scout is told the estimate alone, and what ships nothing else than the robot perceives.
        if self.role == SCOUT or (self.source == LEARNED and self.weights is None):
            return False
        module = self.load()
        return beyond_senses(module.sees) if isinstance(module, Agent) else bool(module.privileged)

    def check(self, asks: bool) -> None:
        """Raise a `ValueError` if an instance that is to play asks for the ground truth otherwise than reports say."""
        check_told(self.role, self.source, asks, self.told)

    def identity(self) -> str:
        """Return the SHA-256 digest of the weights in use, or what stands in for a learned module.

        What receives the ground truth, as oracles do, is named so: a class of the user's own, or a teacher's weights.

        Raises:
            WeightsError: If the weights are missing.
            ValueError: See `load`.
        """
        from mujoban_core.files import digest

        name = self.source
        if self.source == LEARNED:
            path = self.weights or shipped_weights(self.role)
            if not path.is_file():
                from mujoban_rl.weights import WeightsError  # with PyTorch, which oracles play without

                raise WeightsError(f"no weights of the {self.role} at {path}: expected --{self.role} FILE")
            name = digest(path)
        return f"{name}{PRIVILEGED if self.told else ''}"


@dataclass(frozen=True)
class Stack:
    """The four modules that a command plays with."""

    choices: dict[str, Choice] = field(default_factory=lambda: {role: Choice(role) for role in ROLES})
    device: str = "cpu"
    look_around: int | None = None
    """Ticks of looking around at the start of an episode; None: the body's `look_ticks`, or 0 where no module needs it.
    """
    deliberation: Deliberation = field(default_factory=Deliberation)
    """How long the planner thinks."""
    threads: int = 1
    """Threads of the networks in each process."""

    body: str = BALL.name
    """The robot's body; learned modules have to be of it, and those that ship for it are taken."""
    scout: Choice = Choice(SCOUT, SCRIPTED)
    """What says where to look before pushing."""

    def __post_init__(self) -> None:
        """Choose the weights that ship for the body."""
        object.__setattr__(self, "choices", {role: choice.of(self.body) for role, choice in self.choices.items()})

    @cached_property
    def look_around_ticks(self) -> int:
        """Ticks of looking around at the start of an episode."""
        if self.look_around is not None:
            return self.look_around
        body = get_body(self.body)
        if self.choices["estimator"].source != ORACLE:
            return body.look_ticks
        if not body.seeking_ticks:
            return 0
        seeing = self.choices["controller"].told is False
        return body.seeking_ticks if seeing else 0

    def policy(self) -> SensePlanAct:
        """Return the modules composed into one policy.

        Raises:
            ValueError: If a module cannot be loaded, is of another body or asks for the ground truth otherwise than
                `identities` says, `look_around` is negative, or the planner cannot think longer.
        """
        from mujoban_core.sense_plan_act import SensePlanAct

        modules = {role: choice.load(self.device) for role, choice in self.choices.items()}
        for role, module in modules.items():
            check_body(role, module, self.body)
        modules["planner"] = self.deliberation.prepare(modules["planner"], self.choices["planner"].source)
        ticks = self.look_around_ticks
        scout = load_scout(self.scout.source, self.scout.weights, self.device, self.body) if ticks else None
        body = get_body(self.body)
        looking = {role: look_around(module, ticks, scout, body) for role, module in modules.items()}
        policy = SensePlanAct(**looking)  # pyright: ignore
        for role, choice in self.choices.items():
            choice.check(role in policy.told)
        return policy

    def identities(self) -> dict[str, str]:
        """Return what identifies each module in a report, and what says where to look, if anything does."""
        scout = {SCOUT: self.scout.identity()} if self.look_around_ticks else {}
        return {role: choice.identity() for role, choice in self.choices.items()} | scout

    def settings(self) -> dict[str, int | float]:
        """Return what a report says, beside `identities`, of how the modules play."""
        thinking = self.deliberation.settings(self.choices["planner"].source)
        return {"look_around": self.look_around_ticks, **thinking}


@dataclass(frozen=True)
class Solo:
    """An agent that plays alone, where commands expect a `Stack`."""

    choice: Choice
    device: str = "cpu"
    threads: int = 1
    """Threads of its network."""
    body: str = BALL.name

    def policy(self) -> AgentPolicy:
        """Return the agent as a policy.

        Raises:
            ValueError: If it cannot be loaded, is of another body or sees otherwise than `identities` says.
        """
        from typing import cast

        agent = cast(Agent, self.choice.load(self.device))
        check_body(AGENT, agent, self.body)
        policy = AgentPolicy(agent)
        self.choice.check(policy.privileged)
        return policy

    def identities(self) -> dict[str, str]:
        """Return what identifies the agent in a report, and whether it sees what the robot cannot perceive."""
        return {AGENT: self.choice.identity()}

    def settings(self) -> dict[str, int | float]:
        """Return what a report says, beside `identities`, of how the agent plays: nothing."""
        return {}


Player = Stack | Solo
"""What commands play with."""


def recorded_seeds(seed: int | None, *, allow_test_seeds: bool, noted: bool = False) -> range:
    """Return the seeds with which a recording begins: those for training where nobody says otherwise.

    That test levels are recorded is said on stderr.

    Args:
        seed: As given on the command line; None where it was not.
        allow_test_seeds: Whether episodes may be recorded though they are not for training.
        noted: Whether a report notes the use of test levels, or levels are none of the generator's.

    Raises:
        ValueError: If they are not for training and that is not allowed.
    """
    from mujoban_sokoban.generator import TEST_SEEDS, TRAIN_SEEDS

    if seed is None:
        return TRAIN_SEEDS
    if seed not in TRAIN_SEEDS and not allow_test_seeds:
        raise ValueError(
            f"--seed {seed}: its levels are not for training; expected one from {TRAIN_SEEDS.start} on for a "
            "recording, or --allow-test-seeds"
        )
    if seed in TEST_SEEDS and not noted:
        say(f"test levels are recorded, from seed {seed} on, and this is written nowhere but in the bags")
    return range(seed, TRAIN_SEEDS.stop)


def oracle(role: str, body: str) -> Choice:
    """Return what knows the truth in a role; a body that no script drives is driven by its privileged teacher.

    Raises:
        ValueError: If the body is unknown, or no weights of such a teacher ship.
    """
    if role != "controller" or get_body(body).scripted:
        return Choice(role, ORACLE)
    from mujoban_controller import teacher_weights

    weights = teacher_weights(body)
    if not weights.is_file():
        raise ValueError(
            f"no oracle drives the body {body}: expected its privileged teacher at {weights}, or one named by "
            "--controller WEIGHTS"
        )
    return Choice(role, LEARNED, weights)


def import_from_here() -> None:
    """Let `package.module:Class` name modules of the working directory, as `python -m` does."""
    if "" not in sys.path:
        sys.path.insert(0, "")


def forget_command_line(command_line: Sequence[str] | None) -> None:
    """Take the options out of what this process, and any that it starts, can read of its command line with `sys`.

    They say which levels are played, which no plugin is to know (docs/security.md).

    Args:
        command_line: What the command has read; nothing is done unless that is the process's own, None.
    """
    if command_line is None and (options := len(sys.argv) - 1):
        del sys.argv[-options:], sys.orig_argv[-options:]
