"""The options that programs share: the same one for the same thing everywhere.

A program embeds them with `Annotated[ModuleOptions, tyro.conf.arg(name="")]`. Whatever takes long to import is
imported where it is used, so that a program can tell its options at once.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from ipaddress import ip_address
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from tyro.conf import arg
from tyro.constructors import PrimitiveConstructorSpec

from bringup.command import Choice, Player, Solo, Stack, oracle
from mujoban_core.bodies import BALL, BODIES
from mujoban_core.grid import DIFFICULTIES, FASTEST
from mujoban_core.plugins import AGENT, LEARNED, ROLES, SCOUT, SCRIPTED
from mujoban_core.program import say
from mujoban_planner.deliberation import CERTAINTY, PER_TICK, Deliberation
from mujoban_sim.presets import DEFAULT_WORLD, WORLDS

if TYPE_CHECKING:
    from mujoban_sokoban.episodes import Episodes

HERE = "here"
"""Stands for a cluster on this machine, which is started for the command."""
LOOPBACK = "127.0.0.1"
"""Where a view is served unless the user asks otherwise."""


def _spec(metavar: str, read: Callable[[list[str]], Any], *, optional: bool = False) -> PrimitiveConstructorSpec[Any]:
    """Return what reads a value, which may be left out where it is optional."""
    return PrimitiveConstructorSpec(
        nargs="*" if optional else 1, metavar=metavar, instance_from_str=read, is_instance=lambda _: True,
        str_from_instance=lambda value: [str(value)],
    )  # fmt: skip


def one_of(values: Iterable[Any]) -> PrimitiveConstructorSpec[Any]:
    """Return what reads one of some values."""
    named = {str(value): value for value in values}

    def read(given: list[str]) -> Any:
        if given[0] not in named:
            raise ValueError(f"{given[0]}, expected one of {', '.join(named)}")
        return named[given[0]]

    return _spec("|".join(named), read)


def whole(metavar: str, least: int = 1) -> PrimitiveConstructorSpec[Any]:
    """Return what reads a whole number from `least` on."""

    def read(given: list[str]) -> int:
        if not given[0].lstrip("-").isdecimal() or int(given[0]) < least:
            raise ValueError(f"{given[0]}, expected a whole number from {least} on")
        return int(given[0])

    return _spec(metavar, read)


def _speed(given: list[str]) -> float:
    try:
        speed = float(*given) if given else 1.0
    except (ValueError, TypeError):
        speed = 0.0
    if not 0.0 < speed <= FASTEST:
        raise ValueError(f"{' '.join(given)}, expected a number above 0, at most {FASTEST:g}")
    return speed


def _address(given: list[str]) -> str:
    if len(given) > 1:
        raise ValueError(f"{' '.join(given)}, expected one address")
    return given[0] if given else HERE


def _interface(given: list[str]) -> str:
    if not given:
        return LOOPBACK
    text = " ".join(given)
    try:
        address = str(ip_address(text))
    except ValueError:
        raise ValueError(f"{text}, expected an IP address, such as {LOOPBACK} or 0.0.0.0") from None
    try:
        check_own_address(address)
    except OSError as error:
        raise ValueError(f"{text}: {error.strerror}, expected an address of this machine, or 0.0.0.0 for all") from None
    return address


def check_own_address(address: str) -> None:
    """Raise an OSError unless something on this machine can listen on an IP address."""
    with socket.socket(address_family(address)) as probe:
        probe.bind((address, 0))


def address_family(address: str) -> socket.AddressFamily:
    """Return the family of an IP address."""
    return socket.AF_INET6 if ":" in address else socket.AF_INET


SPEED = _spec("[SPEED]", _speed, optional=True)
ADDRESS = _spec("[ADDRESS]", _address, optional=True)
INTERFACE = _spec("[ADDRESS]", _interface, optional=True)

ModuleSource = Annotated[str, arg(metavar="WEIGHTS|MODULE:CLASS|NAME")]
FilePath = Annotated[Path | None, arg(metavar="FILE")]
FolderPath = Annotated[Path | None, arg(metavar="DIR")]
Count = Annotated[int, whole("N")]


@dataclass(frozen=True)
class ModuleOptions:
    """Which modules play, and how."""

    estimator: ModuleSource = LEARNED
    """Weights (.safetensors) of the learned estimator, a class of your own, or the name of an installed module."""
    termination: ModuleSource = LEARNED
    """The same for the termination."""
    planner: ModuleSource = LEARNED
    """The same for the planner."""
    controller: ModuleSource = LEARNED
    """The same for the controller."""
    oracle: Annotated[str, arg(metavar="ROLES")] = ""
    """Modules to replace by their oracle: some of estimator,termination,planner,controller."""
    device: str = "cpu"
    """Device of the learned modules: cpu or cuda, such as cuda:0."""
    threads: Count = 1
    """Threads of the networks and of batched physics."""
    look_around: Annotated[int | None, whole("TICKS", 0)] = None
    """Look around before the first decision, and walk to where more can be seen: the length of each turn on the spot,
    0 for none; by default that of docs/estimator.md."""
    scout: ModuleSource = SCRIPTED
    """What says where to look: scripted, weights of a learned one (`mujoban_planner.train explorer`; none ship), or a
    class of your own."""

    look_ahead: Annotated[int | None, whole("N", 0)] = None
    """Let the learned planner search ahead by N evaluations of its network as the robot moves.
    0 is its policy alone; by default 400, and none for a planner of your own or the oracle."""
    look_ahead_per_tick: Annotated[int, whole("N")] = PER_TICK
    """Of them, in one tick; in real time as many as fit into a fifth of it."""
    look_ahead_certainty: float = CERTAINTY
    """Probability with which all must be as it seems that a plan of the search rests on."""
    thinking: Annotated[int, whole("K", 0)] = 0
    """Thinking time of the planner's network in each decision (docs/planner.md); 0 for its own."""

    def stack(self, body: str = BALL.name) -> Stack:
        """Return the modules.

        Raises:
            ValueError: If a role of `--oracle` is unknown.
        """
        choices = {role: Choice.parse(role, getattr(self, role)) for role in ROLES}
        for role in filter(None, self.oracle.split(",")):
            if role not in ROLES:
                raise ValueError(f"--oracle {role}: expected some of {','.join(ROLES)}")
            choices[role] = oracle(role, body)
        scout = Choice.parse(SCOUT, self.scout)
        thought = Deliberation(self.thinking, self.look_ahead, self.look_ahead_per_tick, self.look_ahead_certainty)
        return Stack(choices, self.device, self.look_around, thought, self.threads, body, scout)


_OF_ALL: Final = ("device", "threads")
"""Options of the modules that an agent has as well."""


@dataclass(frozen=True)
class PlayerOptions(ModuleOptions):
    """What plays, and how: the four modules or one agent."""

    agent: Annotated[str | None, arg(metavar="WEIGHTS|MODULE:CLASS|NAME")] = None
    """An agent that plays alone, in the place of all modules (docs/baselines.md)."""

    def player(self, body: str = BALL.name) -> Player:
        """Return the modules, or the agent.

        Raises:
            ValueError: If a role of `--oracle` is unknown, or what is of the modules alone is named beside an agent.
        """
        if self.agent is None:
            return self.stack(body)
        named = [o.name for o in fields(ModuleOptions) if o.name not in _OF_ALL and getattr(self, o.name) != o.default]
        if named:
            other = f"--{named[0].replace('_', '-')}"
            raise ValueError(f"--agent {self.agent} {other}: expected one of the two, since an agent plays alone")
        return Solo(Choice.parse(AGENT, self.agent), self.device, self.threads, body)


@dataclass(frozen=True)
class WorldOptions:
    """The physical world and the robot in it."""

    body: Annotated[str, one_of(sorted(BODIES))] = BALL.name
    """The robot's body."""
    world: Annotated[str, one_of(WORLDS)] = DEFAULT_WORLD
    """Physical world, see docs/world.md."""


@dataclass(frozen=True)
class EpisodeOptions(WorldOptions):
    """Which episodes are played."""

    difficulty: Annotated[int, one_of(sorted(DIFFICULTIES))] = max(DIFFICULTIES)
    """Difficulty of generated levels."""
    episodes: Annotated[int | None, whole("N")] = None
    """Number of episodes; by default one (evaluate.py: 256), or as many as the level file has."""
    seed: Annotated[int | None, whole("N", 0)] = None
    """Seed of the first episode; episode i has seed + i. By default none of those for results (docs/levels.md)."""
    time_limit: Annotated[int | None, whole("STEPS")] = None
    """Steps of an episode; by default those of the body."""
    levels: FilePath = None
    """Play the levels of a Boxoban text file instead of generated ones."""

    def make(self, seed: int | None, seeds: range | None = None) -> Episodes:
        """Return the episodes from a seed on (None: see `Episodes`); say on stderr which of a file are unsolvable."""
        from mujoban_sokoban.episodes import Episodes
        from mujoban_sokoban.solver import Status, solve_levels

        episodes = Episodes(self.episodes, seed, difficulty=self.difficulty, level_file=self.levels, seeds=seeds)
        levels = episodes.source.levels
        for index in sorted({seed % len(levels) for seed in episodes.seeds}) if levels else ():
            # One by one: Ctrl-C is heard between two.
            if solve_levels([levels[index]]).status[0] == Status.UNSOLVABLE:
                say(f"level {index} of {self.levels} is unsolvable; it is played all the same")
        return episodes


@dataclass(frozen=True)
class ClusterOptions:
    """Whether a command's work is shared out over a cluster."""

    cluster: Annotated[str | None, ADDRESS] = None
    """Share the work out over a Ray cluster (auto, HOST:PORT or ray://HOST:PORT); without ADDRESS a new one here."""
    num_actors: Count = 2
    """Processes on the cluster."""
