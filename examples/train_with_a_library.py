"""Train a policy with Stable-Baselines3 on `Mujoban-v0`: `python examples/train_with_a_library.py [STEPS]`.

Needs `pip install 'mujoban[examples]'`. The library's PPO sees the robot's proprioception, its pose and the abstract
state, since a camera policy takes days; `gymnasium.make("Mujoban-v0")` alone would be the task itself, and all else
would stay as it is. Printed are the library's progress and, at the end, the mean return of two episodes. The policy is
written to `ppo_mujoban.zip`, which examples/evaluate_beside_the_stack.py plays.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import gymnasium
import tyro

import mujoban_sim  # noqa: F401 - registers the environment
from bringup.options import whole
from mujoban_core.program import exit_status, read_options

PROG = "train_with_a_library.py"
SEES = ("proprio", "pose", "abstract_state")


@dataclass(frozen=True)
class Options:
    """Train a policy with Stable-Baselines3."""

    steps: Annotated[int, whole("STEPS", 2), tyro.conf.Positional] = 200_000
    """Environment steps."""


def make() -> gymnasium.Env:
    """Return an easy Mujoban that shows what the policy shall see; an agent may see no more than `AgentInput` has."""
    env = gymnasium.make("Mujoban-v0", difficulty=1, observations="state", time_limit=600)
    return gymnasium.wrappers.FilterObservation(env, SEES)


def main(command_line: Sequence[str] | None = None) -> int:
    """Train and say what an episode brings."""
    steps = read_options(Options, command_line, PROG, __doc__).steps
    try:
        import torch
        from stable_baselines3 import PPO
        from stable_baselines3.common.evaluation import evaluate_policy
        from stable_baselines3.common.logger import HumanOutputFormat, Logger
        from stable_baselines3.common.monitor import Monitor
    except ModuleNotFoundError as error:
        raise ValueError(f"{error.name} is not installed: expected pip install 'mujoban[examples]'") from None
    torch.set_num_threads(1)  # so small a network gains nothing by more, and on a busy machine they wait for each other
    env = Monitor(make())
    # The observations keep their names, which the file then has as well.
    model = PPO("MultiInputPolicy", env, n_steps=min(2048, steps), seed=0, device="cpu", verbose=1)
    model.set_logger(Logger(None, [HumanOutputFormat(sys.stdout)]))  # the default one makes a folder in /tmp as well
    model.learn(steps)
    model.save("ppo_mujoban")
    mean, deviation = evaluate_policy(model, env, n_eval_episodes=2)
    print(f"return {mean:.2f} +- {deviation:.2f} over 2 episodes")
    return 0


if __name__ == "__main__":
    sys.exit(exit_status(PROG, main))
