"""How long a step of the controllers that ship takes, how fast they train, and whether MPO solves a known problem.

``python -m benchmarks.controller`` prints JSON; ``--pendulum-steps 20000`` adds Gymnasium's ``Pendulum-v1`` learned
from scratch (solved: a mean return above -250). ``--random-steps 10000000`` drives robots at random over levels of
difficulty 5 and looks whether anything explodes or leaves the grid.

Step times are processor time of one thread, so that other work on the machine hardly changes them.
"""

from __future__ import annotations

import time
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import Progress
from torch import Tensor, nn

import mujoban_controller
from benchmarks.command import run_benchmark
from benchmarks.timing import milliseconds
from mujoban_controller import camera_weights, train
from mujoban_controller.train import TrainConfig, make_trainer
from mujoban_core.bodies import BODIES
from mujoban_core.grid import GRID_SIZE, xy_to_cell
from mujoban_core.interfaces import ControllerInput
from mujoban_core.signals import StopSignal
from mujoban_core.terminal import progress_console
from mujoban_rl.engine import Learner, Source
from mujoban_rl.limits import NaNGuard
from mujoban_rl.losses.mpo_continuous import MPOConfig, MPOLoss
from mujoban_rl.losses.returns import td_target
from mujoban_rl.networks import Gaussian, gaussian, gaussian_layers
from mujoban_sim.world import World
from mujoban_sokoban.episodes import EpisodeSpec
from mujoban_sokoban.generator import VALIDATION_SEEDS, generate_level


@dataclass(frozen=True)
class Options:
    """What to measure."""

    repeats: int = 200
    rounds: int = 8
    """Updates to time."""
    pendulum_steps: int = 0
    """Environment steps of MPO on Pendulum-v1."""
    random_steps: int = 0
    """Environment steps of random torques, summed over 64 robots."""
    seed: int = 0


def step_times(repeats: int) -> dict[str, float]:
    """Return the times of one step of each policy that ships with batch 1 in milliseconds, as a graph and without."""
    frame = np.random.default_rng(0).integers(0, 256, (1, 64, 64, 3), dtype=np.uint8)
    times = {}
    for body in BODIES.values():
        inputs = ControllerInput(np.array([1]), frame, np.zeros((1, body.proprio_size), np.float32), np.array([False]))
        for suffix, compiled in (("", True), ("_without_graph", False)):
            controller = mujoban_controller.load(camera_weights(body.name), compiled=compiled)
            step = partial(controller.step, inputs, controller.initial_memory(1))
            times[f"controller_step_ms_{body.name}{suffix}"] = milliseconds(step, repeats)
    return times


def training_rates(rounds: int) -> dict[str, float]:
    """Return environment steps per CPU second of training, and the share of learning in them.

    Of the teacher by PPO and by MPO, and of MPO of the camera policy.
    """
    stages = {
        "ppo": TrainConfig(algorithm="ppo"),
        "mpo": TrainConfig(algorithm="mpo"),
        "camera_mpo": TrainConfig(stage="mpo", asymmetric=replace(TrainConfig().asymmetric, first=2_048)),
    }
    rates = {}
    with TemporaryDirectory() as folder:
        for name, config in stages.items():
            trainer = make_trainer(train.Options(Path(folder) / name, config, evaluation_episodes=0))
            steps, playing, learning = _time(trainer.learner, trainer.source, rounds)
            rates[f"{name}_steps_per_second"] = steps / (playing + learning)
            rates[f"{name}_share_of_learning"] = learning / (playing + learning)
    return rates


def _time(learner: Learner[Any], source: Source[Any], rounds: int) -> tuple[int, float, float]:
    """Return the environment steps of some updates, and the CPU seconds of playing and of learning."""
    guard, playing, learning = NaNGuard(), 0.0, 0.0
    source.publish(learner.weights(), 0)
    learner.update(source.next_batch(), 0.0, guard)
    before = source.samples
    for _ in range(rounds):
        start = time.process_time()
        batch = source.next_batch()
        middle = time.process_time()
        learner.update(batch, 0.0, guard)
        playing, learning = playing + middle - start, learning + time.process_time() - middle
    source.close()
    return source.samples - before, playing, learning


class _Policy(nn.Module):
    """A small Gaussian policy with a critic, for problems with few observations."""

    def __init__(self, observations: int, actions: int, width: int = 128) -> None:
        super().__init__()
        self.trunk = nn.Sequential(nn.Linear(observations, width), nn.LayerNorm(width), nn.Tanh(),
                                   nn.Linear(width, width), nn.ELU())  # fmt: skip
        self.mean, self.scale = gaussian_layers(width, actions)
        self.critic = nn.Sequential(nn.Linear(observations + actions, width), nn.LayerNorm(width), nn.Tanh(),
                                    nn.Linear(width, width), nn.ELU(), nn.Linear(width, 1))  # fmt: skip

    def forward(self, observation: Tensor) -> Gaussian:
        x = self.trunk(observation)
        return gaussian(self.mean(x), self.scale(x))

    def q(self, observation: Tensor, action: Tensor) -> Tensor:
        wide = observation.expand(*action.shape[:-1], -1)
        return self.critic(torch.cat([wide, action.clamp(-1, 1)], -1)).squeeze(-1)


class PendulumMPO:
    """MPO on Pendulum-v1 with torques normalised to [-1, 1]."""

    def __init__(self, seed: int) -> None:
        """Start from nothing."""
        torch.manual_seed(seed)
        self._rng = np.random.default_rng(seed)
        self._environment = gymnasium.make("Pendulum-v1")
        self._policy = _Policy(3, 1)
        self._target = deepcopy(self._policy)
        self._loss = MPOLoss(1, MPOConfig(epsilon_scale=1e-5))
        self._optimiser = torch.optim.Adam(self._policy.parameters(), 1e-3)
        self._duals = self._loss.duals.adam(1e-2)
        self._data: list[NDArray[np.float32]] = []
        self._seed = seed
        self._updates = 0

    def train(self, steps: int) -> list[float]:
        """Play `steps` steps, one update after each; return the episodes' returns."""
        returns = []
        for episode in range(-(-steps // 200)):
            returns.append(self.play(explore=True, seed=self._seed + 1000 + episode))
        return returns

    @torch.no_grad()
    def _act(self, observation: NDArray[np.float32], explore: bool) -> NDArray[np.float32]:
        action = self._target(torch.from_numpy(observation))
        return (action.sample() if explore else action.mean).clamp(-1, 1).numpy()

    def play(self, *, explore: bool, seed: int) -> float:
        """Play one episode of 200 steps, learning if `explore`; return its return."""
        observation, _ = self._environment.reset(seed=seed)
        total = 0.0
        for _ in range(200):
            action = self._act(observation, explore)
            following, reward, *_ = self._environment.step(2.0 * action)
            if explore:
                row = np.concatenate([observation, action, [float(reward) / 10], following], dtype=np.float32)
                self._data.append(row)
                if len(self._data) > 1000:
                    self._update()
            observation, total = following, total + float(reward)
        return total

    def _update(self, batch: int = 128, samples: int = 20, gamma: float = 0.98) -> None:
        chosen = self._rng.integers(len(self._data), size=batch)
        rows = torch.from_numpy(np.stack([self._data[i] for i in chosen]))
        state, taken, reward, following = rows[:, :3], rows[:, 3:4], rows[:, 4:5], rows[:, 5:]
        with torch.no_grad():
            target, ahead = self._target(state), self._target(following)
            later = ahead.mean + ahead.scale * torch.randn(samples, *ahead.mean.shape)
            value = td_target(reward, torch.ones_like(reward), self._target.q(following, later).mean(0), gamma)
            action = target.mean + target.scale * torch.randn(samples, *target.mean.shape)
            q = self._target.q(state, action)
        loss, _ = self._loss(self._policy(state), target, action, q)
        loss = loss + nn.functional.mse_loss(self._policy.q(state, taken), value)
        self._optimiser.zero_grad()
        self._duals.zero_grad()
        loss.backward()
        self._optimiser.step()
        self._duals.step()
        self._updates += 1
        if self._updates % 50 == 0:
            self._target.load_state_dict(self._policy.state_dict())


_LOOK_EVERY = 5
"""Steps between two looks at the world in which robots drive at random."""


class RandomDrive:
    """Robots that are driven at random: half of them hold a torque for a while, half draw one in each step."""

    def __init__(self, seed: int, batch: int = 64, levels: int = 512) -> None:
        """Play `levels` validation levels of difficulty 5 over and over."""
        self._rng = np.random.default_rng(seed)
        self._pool = [EpisodeSpec(generate_level(5, level), level) for level in VALIDATION_SEEDS[:levels]]
        self.world = World(batch)
        self._torque = np.zeros((batch, self.world.body.action_size), np.float32)
        self._reset(np.arange(batch))
        self.report = {"random_steps": 0, "episodes": 0, "not_finite": 0, "robots_outside": 0, "boxes_outside": 0,
                       "fastest_robot": 0.0, "fastest_box": 0.0}  # fmt: skip
        self._ticks = 0

    def _reset(self, rows: NDArray[np.int64]) -> None:
        self.world.reset(rows, [self._pool[i] for i in self._rng.integers(len(self._pool), size=len(rows))])

    def play(self, steps: int) -> dict[str, float]:
        """Play, until a signal asks to stop; return numbers of looks with something wrong, highest speeds in m/s."""
        world, rng, report = self.world, self._rng, self.report
        with StopSignal() as stop, Progress(console=progress_console()) as bar:
            task = bar.add_task("steps", total=steps)
            while report["random_steps"] < steps and not stop.requested:
                drawn = rng.uniform(-1.0, 1.0, self._torque.shape).astype(np.float32)
                renewed = rng.random(world.batch) < 0.05
                renewed[::2] = True
                self._torque[renewed] = drawn[renewed]
                world.step(self._torque)
                self._ticks += 1
                # What has left the grid or is not finite stays so.
                if self._ticks % _LOOK_EVERY == 0:
                    self._check()
                report["random_steps"] += world.batch
                bar.advance(task, world.batch)
                over = np.flatnonzero(world.done)
                report["episodes"] += len(over)
                if over.size:
                    self._reset(over)
        return report

    def _check(self) -> None:
        world, report = self.world, self.report
        rows, size = np.arange(world.batch), world.body.cell_size
        state = np.concatenate([world.pose, world.velocity, world.proprio], 1)
        present = np.arange(world.max_boxes) < world.box_count[:, None]
        boxes = np.where(present[..., None], world.box_position, world.pose[:, None, :2])
        finite = np.isfinite(state).all(1) & np.isfinite(boxes).all((1, 2))
        report["not_finite"] += int((~finite).sum())
        # A cell inside of the walls, whatever the numbers are.
        robot, box = (np.clip(xy_to_cell(np.nan_to_num(p), size), 0, GRID_SIZE - 1) for p in (world.pose[:, :2], boxes))
        report["robots_outside"] += int(world.wall[rows, robot[:, 0], robot[:, 1]].sum())
        report["boxes_outside"] += int((world.wall[rows[:, None], box[..., 0], box[..., 1]] & present).sum())
        robots, pushed = np.hypot(*world.velocity[:, :2].T).max(), (world.box_speed * present).max()
        report["fastest_robot"] = max(report["fastest_robot"], float(robots))
        report["fastest_box"] = max(report["fastest_box"], float(pushed))


def run() -> dict[str, object]:
    """Return the quick measurements: the time of a step, and the speed of training."""
    torch.set_num_threads(1)
    return {**step_times(200), **training_rates(4)}


def measure(options: Options) -> dict[str, object]:
    """Return the quick measurements, and those that were asked for."""
    torch.set_num_threads(1)
    result: dict[str, object] = {**step_times(options.repeats), **training_rates(options.rounds)}
    if options.pendulum_steps:
        pendulum = PendulumMPO(options.seed)
        curve = pendulum.train(options.pendulum_steps)
        final = [pendulum.play(explore=False, seed=seed) for seed in range(10)]
        result |= {"pendulum_curve": curve, "pendulum_return": float(np.mean(final))}
    if options.random_steps:
        result |= RandomDrive(options.seed).play(options.random_steps)
    return result


if __name__ == "__main__":
    run_benchmark("benchmarks.controller", Options, measure)
