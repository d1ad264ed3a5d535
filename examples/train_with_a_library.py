"""Train a policy with Stable-Baselines3 on `Mujoban-v0`: `python examples/train_with_a_library.py [STEPS]`.

Needs `pip install 'mujoban[examples]'`. The library's PPO sees the robot's proprioception, its pose and the abstract
state, since a camera policy takes days; `observations="default"` and "CnnPolicy" would be the task itself. The weights
are written to `ppo_mujoban.zip`; examples/evaluate_beside_the_stack.py shows how to evaluate a policy of your own.
"""

from __future__ import annotations

import sys

import gymnasium

import mujoban_sim  # noqa: F401 - registers the environment


def make() -> gymnasium.Env:
    """Return an easy Mujoban with flat observations."""
    env = gymnasium.make("Mujoban-v0", difficulty=1, observations="state", time_limit=600)
    return gymnasium.wrappers.FlattenObservation(env)


def main(steps: int) -> None:
    """Train for a number of environment steps and say what an episode brings."""
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.monitor import Monitor

    torch.set_num_threads(1)  # so small a network gains nothing by more, and on a busy machine they wait for each other
    env = Monitor(make())
    model = PPO("MlpPolicy", env, n_steps=min(2048, steps), seed=0, verbose=1)
    model.learn(steps)
    model.save("ppo_mujoban")
    mean, deviation = evaluate_policy(model, env, n_eval_episodes=2)
    print(f"return {mean:.2f} +- {deviation:.2f} over 2 episodes")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 200_000)
