"""Evaluate a policy of your own beside the stack: `python examples/evaluate_beside_the_stack.py [POLICY]`.

Needs `pip install 'mujoban[examples]'`, and POLICY, by default `ppo_mujoban.zip`: run examples/train_with_a_library.py
first, which writes it. It and the learned modules play the same levels, 32 easy ones for validation, and are judged
alike: of both is printed how many they solved, with the interval, the mean return, and the seeds of the others by
cause. With `--oracle estimator,termination,planner,controller` oracles stand in for the modules. Load no file that you
do not trust: it holds pickles, which may run any program. Other programs play the policy, too:

    PYTHONPATH=examples python bringup/evaluate.py --agent evaluate_beside_the_stack:Trained --difficulty 1
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from gymnasium.spaces import Dict
from numpy.typing import NDArray
from tyro.conf import arg

from bringup.evaluate import evaluate
from bringup.options import EpisodeOptions, ModuleOptions
from bringup.results import report, summary
from mujoban_core.agent import Agent, AgentInput, AgentPolicy
from mujoban_core.bodies import BODIES
from mujoban_core.files import digest
from mujoban_core.interfaces import Memory
from mujoban_core.plugins import AGENT, PRIVILEGED, check_body
from mujoban_core.program import exit_status, read_options
from mujoban_core.threads import set_threads
from mujoban_sokoban.generator import VALIDATION_SEEDS

PROG = "evaluate_beside_the_stack.py"
POLICY = Path("ppo_mujoban.zip")


def load(path: Path) -> Any:
    """Return the library's model in a file.

    Raises:
        ValueError: If the library or the file is missing, or the file holds no policy that sees named observations.
    """
    try:
        from stable_baselines3 import PPO
    except ModuleNotFoundError as error:
        raise ValueError(f"{error.name} is not installed: expected pip install 'mujoban[examples]'") from None
    expected = "expected one that train_with_a_library.py wrote"
    if not path.is_file():
        raise ValueError(f"no policy at {path}: {expected}")
    try:
        model = PPO.load(path, device="cpu")
    except (ValueError, AssertionError) as error:
        raise ValueError(f"{path} is no policy of PPO ({error}): {expected}") from error
    if not isinstance(model.observation_space, Dict):
        raise ValueError(f"{path} is a policy whose observations have no names: {expected}")
    return model


class Trained(Agent):
    """A policy of Stable-Baselines3 that sees the observations which it was trained on."""

    def __init__(self, path: Path = POLICY) -> None:
        """Load it.

        Raises:
            ValueError: See `load`.
        """
        self._model = load(path)
        self.sees = tuple(self._model.observation_space.spaces)
        # By this every program tells whether it is of the body that is played.
        actions = self._model.action_space.shape
        self.config = {"body": next((name for name, body in BODIES.items() if (body.action_size,) == actions), None)}

    def initial_memory(self, batch: int) -> Memory:
        """Return nothing: it goes by what it sees now."""
        return ()

    def step(self, inputs: AgentInput, state: Memory) -> tuple[NDArray[np.float32], Memory]:
        """Return the torques that it holds for best, [B, U]."""
        seen = {name: getattr(inputs, name) for name in self.sees}
        torque, _ = self._model.predict(seen, deterministic=True)
        return torque, state


@dataclass(frozen=True)
class Options:
    """Evaluate a trained policy beside the stack."""

    policy: Annotated[Path, tyro.conf.Positional] = POLICY
    """What train_with_a_library.py wrote."""
    play: Annotated[EpisodeOptions, arg(name="")] = field(
        default_factory=lambda: EpisodeOptions(difficulty=1, episodes=32)
    )
    modules: Annotated[ModuleOptions, arg(name="")] = field(default_factory=ModuleOptions)


def main(command_line: Sequence[str] | None = None) -> int:
    """Play and print both reports."""
    options = read_options(Options, command_line, PROG, __doc__)
    play, stack, agent = options.play, options.modules.stack(options.play.body), Trained(options.policy)
    check_body(AGENT, agent, play.body)
    set_threads(stack.threads)
    levels = play.make(VALIDATION_SEEDS.start if play.seed is None else play.seed)
    identity = digest(options.policy) + (PRIVILEGED if agent.privileged else "")
    players = {
        "trained policy": (AgentPolicy(agent), {AGENT: identity}),
        "stack": (stack.policy(), stack.identities()),
    }
    for name, (policy, weights) in players.items():
        results = evaluate(
            policy, levels, body=play.body, world=play.world, time_limit=play.time_limit, threads=stack.threads
        )
        print(name, *summary(report(results, weights)), sep="\n  ", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(exit_status(PROG, main))
