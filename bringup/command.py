"""What the commands have in common: options, module selection, and one line on stderr for bad input.

Whatever takes long to import is imported where it is used, so that a command can tell its options, and be interrupted,
at once.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from mujoban_core.bodies import BALL, BODIES
from mujoban_core.children import end_with_parent
from mujoban_core.grid import DIFFICULTIES
from mujoban_core.look_around import LOOK_AROUND_TICKS, look_around
from mujoban_core.plugins import LEARNED, ORACLE, PRIVILEGED, ROLES, load_module, shipped_weights
from mujoban_core.signals import interrupt_status, interruptible, interruption, leave
from mujoban_sim.presets import DEFAULT_WORLD, WORLDS

if TYPE_CHECKING:
    from mujoban_core.interfaces import Module
    from mujoban_core.sense_plan_act import SensePlanAct
    from mujoban_sokoban.episodes import Episodes

USAGE_ERROR = 2
"""Exit status of a command whose input was bad."""


class Parser(argparse.ArgumentParser):
    """An argument parser that reports an error in one line."""

    def error(self, message: str) -> NoReturn:
        """Print the error and leave."""
        self.exit(USAGE_ERROR, f"{self.prog}: error: {message}\n")


def run_command(prog: str, command: Callable[[], int]) -> NoReturn:
    """Run a command and end the process with its `exit_status`."""
    leave(exit_status(prog, command))


def exit_status(prog: str, command: Callable[[], int]) -> int:
    """Run a command and return its exit status.

    Bad input is one line on stderr and status 2; a signal that asks the command to end is status 130 or 143.
    """
    end_with_parent()
    try:
        with interruptible():
            return command()
    except (ValueError, OSError) as error:
        if (earlier := interruption(error)) is not None:
            return interrupt_status(earlier)
        say(f"{prog}: error: {' '.join(str(error).split())}")
        return USAGE_ERROR
    except KeyboardInterrupt as error:
        say(f"{prog}: interrupted")
        return interrupt_status(error)
    except SystemExit as leaving:
        return leaving.code if isinstance(leaving.code, int) else USAGE_ERROR


def say(line: str) -> None:
    """Print a line on stderr, if that can still be written to: the terminal may have been closed."""
    with suppress(OSError):
        print(line, file=sys.stderr, flush=True)


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

    def load(self, device: str = "cpu") -> Module:
        """Return the module.

        Raises:
            ValueError: If it cannot be found, or its weights are missing or damaged.
        """
        return load_module(self.role, self.source, self.weights, device)

    def identity(self) -> str:
        """Return the SHA-256 digest of the weights in use, or what stands in for a learned module.

        A class of the user's own that receives the ground truth, as oracles do, is named so.

        Raises:
            WeightsError: If the weights are missing.
        """
        from mujoban_rl.weights import WeightsError, digest

        if self.source == ORACLE:
            return self.source
        if self.source != LEARNED:
            return f"{self.source}{PRIVILEGED}" if self.load().privileged else self.source
        path = self.weights or shipped_weights(self.role)
        if not path.is_file():
            raise WeightsError(f"no weights of the {self.role} at {path}: expected a .safetensors file")
        return digest(path)


@dataclass(frozen=True)
class Stack:
    """The four modules that a command plays with."""

    choices: dict[str, Choice] = field(default_factory=lambda: {role: Choice(role) for role in ROLES})
    device: str = "cpu"
    look_around: int | None = None
    """Ticks of looking around at the start of an episode; None: `LOOK_AROUND_TICKS`, or 0 for the oracle estimator."""
    look_ahead: int = 0
    """Evaluations of the planner's tree search; 0 for none."""
    threads: int = 1
    """Threads of the networks in each process."""

    body: str = BALL.name
    """The robot's body; learned modules have to be of it."""

    @property
    def look_around_ticks(self) -> int:
        """Ticks of looking around at the start of an episode."""
        if self.look_around is not None:
            return self.look_around
        return 0 if self.choices["estimator"].source == ORACLE else LOOK_AROUND_TICKS

    def policy(self) -> SensePlanAct:
        """Return the modules composed into one policy.

        Raises:
            ValueError: If a module cannot be loaded or is of another body, `look_around` is negative, or the planner
                cannot look ahead.
        """
        from mujoban_core.sense_plan_act import SensePlanAct

        modules = {role: choice.load(self.device) for role, choice in self.choices.items()}
        for role, module in modules.items():
            check_body(role, module, self.body)
        if self.look_ahead:
            from mujoban_planner.lookahead import look_ahead

            modules["planner"] = look_ahead(modules["planner"], self.look_ahead)
        ticks = self.look_around_ticks
        return SensePlanAct(**{role: look_around(module, ticks) for role, module in modules.items()})  # pyright: ignore

    def identities(self) -> dict[str, str]:
        """Return what identifies each module in a report."""
        return {role: choice.identity() for role, choice in self.choices.items()}


def check_body(role: str, module: Module, body: str) -> None:
    """Raise a `ValueError` if a learned module was trained for another body than the one that is played."""
    config = getattr(module, "config", {})
    trained = config.get("body") if isinstance(config, dict) else getattr(config, "body", None)
    if trained not in (None, body):
        raise ValueError(
            f"the {role} was trained for the body {trained}: expected weights for {body}, or --oracle {role}"
        )


def positive(text: str) -> int:
    """Read an integer from 1 on."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"{text} is too small: expected at least 1")
    return number


def add_episode_options(parser: argparse.ArgumentParser, *, episodes: int | None = None, seed: int = 0) -> None:
    """Add the options that say which episodes are played."""
    parser.add_argument(
        "--difficulty", type=int, choices=sorted(DIFFICULTIES), default=max(DIFFICULTIES), help="of generated levels"
    )
    parser.add_argument("--episodes", type=positive, default=episodes, help="number of episodes")
    parser.add_argument("--seed", type=int, default=seed, help="seed of the first episode; episode i has seed + i")
    parser.add_argument("--time-limit", type=positive, metavar="STEPS", help="of an episode; the body's by default")
    parser.add_argument("--levels", type=Path, metavar="FILE", help="play the levels of a Boxoban text file instead")
    add_world_option(parser)


def add_world_option(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose the physical world and the robot's body."""
    parser.add_argument("--body", choices=sorted(BODIES), default=BALL.name, help="the robot's body")
    parser.add_argument("--world", choices=WORLDS, default=DEFAULT_WORLD, help="physical world, see docs/world.md")


def add_module_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose the modules."""
    every = ",".join(ROLES)
    parser.add_argument("--oracle", default="", metavar="ROLES", help=f"modules to replace by their oracle: {every}")
    for role in ROLES:
        parser.add_argument(
            f"--{role}",
            default=LEARNED,
            metavar="WEIGHTS|MODULE:CLASS",
            help=f"weights (.safetensors) of the learned {role}, or a class of your own to play it",
        )
    parser.add_argument("--device", default="cpu", help="device of the learned modules")
    parser.add_argument("--threads", type=positive, default=1, help="threads of the networks and of batched physics")
    parser.add_argument(
        "--look-around",
        type=int,
        metavar="TICKS",
        help="look around before the first decision, and walk to where more can be seen: the length of each turn on "
        f"the spot, 0 for none; {LOOK_AROUND_TICKS} by default, 0 for the oracle estimator",
    )
    parser.add_argument(
        "--look-ahead",
        type=positive,
        default=0,
        metavar="N",
        help="let the learned planner search ahead by N evaluations of its network as the robot moves; off by default",
    )


def add_recording_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that say what may be recorded; `recorded_seed` reads them."""
    parser.set_defaults(seed=None)
    parser.add_argument(
        "--allow-test-seeds", action="store_true", help="record also levels that are kept for tests, not for training"
    )


def recorded_seed(seed: int | None, *, records: bool, allow_test_seeds: bool) -> int:
    """Return the seed of the first episode: of those for training where it is recorded and nobody says otherwise.

    Args:
        seed: As given on the command line; None where it was not.
        records: Whether the episodes are recorded.
        allow_test_seeds: Whether they may be recorded though they are kept for tests.

    Raises:
        ValueError: If they are kept for tests and that is not allowed.
    """
    from mujoban_sokoban.generator import TEST_SEEDS, TRAIN_SEEDS

    if seed is None:
        return TRAIN_SEEDS.start if records else 0
    if records and seed in TEST_SEEDS and not allow_test_seeds:
        raise ValueError(
            f"--seed {seed}: its levels are kept for tests; expected one from {TEST_SEEDS.stop} on for a recording, "
            "or --allow-test-seeds"
        )
    return seed


def episodes_from(arguments: argparse.Namespace) -> Episodes:
    """Return the episodes that the options ask for; say on stderr which levels of a file are unsolvable."""
    from mujoban_sokoban.episodes import Episodes
    from mujoban_sokoban.solver import Status, solve_levels

    episodes = Episodes(
        arguments.episodes, arguments.seed, difficulty=arguments.difficulty, level_file=arguments.levels
    )
    if episodes.source.levels:
        for index in (solve_levels(episodes.source.levels).status == Status.UNSOLVABLE).nonzero()[0]:
            print(f"level {index} of {arguments.levels} is unsolvable; it is played all the same", file=sys.stderr)
    return episodes


def stack_from(arguments: argparse.Namespace) -> Stack:
    """Return the modules that the options ask for.

    Raises:
        ValueError: If a role of `--oracle` is unknown.
    """
    choices = {role: Choice.parse(role, getattr(arguments, role)) for role in ROLES}
    for role in filter(None, arguments.oracle.split(",")):
        if role not in ROLES:
            raise ValueError(f"--oracle {role}: expected some of {','.join(ROLES)}")
        choices[role] = _oracle(role, arguments.body)
    return Stack(
        choices, arguments.device, arguments.look_around, arguments.look_ahead, arguments.threads, arguments.body
    )


def _oracle(role: str, body: str) -> Choice:
    """Return what knows the truth in a role; the script that drives the ball can drive no other body."""
    if role == "controller" and body != BALL.name:
        from mujoban_controller import teacher_weights

        return Choice(role, LEARNED, teacher_weights(body))
    return Choice(role, ORACLE)


def import_from_here(path: Sequence[str] = ("",)) -> None:
    """Let `package.module:Class` name modules of the working directory, as `python -m` does."""
    sys.path[:0] = [entry for entry in path if entry not in sys.path]
