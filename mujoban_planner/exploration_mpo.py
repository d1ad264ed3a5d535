"""Train the explorer by MPO: `python -m mujoban_planner.train explorer --run DIR`.

Shapes: E levels, A actions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mujoban_core.bodies import Body, get_body
from mujoban_core.grid import DIFFICULTIES, Instruction
from mujoban_core.look_around import WALKS, Scout, ScriptedScout
from mujoban_core.ranges import check_counts, check_positive, check_shares
from mujoban_planner.boards import abstract_states
from mujoban_planner.discrete_mpo import Answer, DiscreteMPOLearner, MPOBatch, StepStore
from mujoban_planner.exploration_env import SHOWN, ExplorationEnvironment, ExplorationReward
from mujoban_planner.explorer import Explorer
from mujoban_planner.moves import LevelStream, PlayConfig, Resumable, SequenceActor
from mujoban_planner.symmetry import SYMMETRIES, view_states
from mujoban_planner.validation import difficulty_shares, validation_levels
from mujoban_rl.actors import ActorOptions, ActorSource
from mujoban_rl.engine import Budget, Cadence, Trainer
from mujoban_rl.limits import NaNGuard
from mujoban_rl.losses.mpo_discrete import DiscreteMPOConfig
from mujoban_rl.optimise import ProgressSchedule, warm_up_cosine
from mujoban_rl.precision import autocast
from mujoban_rl.run_directory import RunDirectory
from mujoban_rl.weights import provenance

_JUDGED: Final = 128
"""Validation levels of an evaluation."""
_STREAM: Final = 3
"""Tells the random streams of exploration from others of the same seed."""


@dataclass(frozen=True)
class ExplorerConfig(PlayConfig):
    """What defines a run."""

    body: str = "ball"
    """Key in `mujoban_core.bodies.BODIES`: whose camera it is."""
    channels: int = 16
    blocks: int = 3
    horizon: float = 10.0
    """Mean instructions of an episode, which ends at random: what there is to learn happens soon after its start."""
    reward: ExplorationReward = field(default_factory=ExplorationReward)
    environments: int = 128
    levels: int = 4096
    """Levels of each actor, of which every episode takes one under one of eight symmetries."""
    steps_per_update: float = 0.25
    mpo: DiscreteMPOConfig = field(
        default_factory=lambda: DiscreteMPOConfig(epsilon_policy=0.01, initial_temperature=0.3, initial_alpha=1.0)
    )
    n_step: int = 3
    replay_steps: int = 300
    discount: float = 0.97
    learning_rate: float = 1e-3
    """Learning rate."""
    warm_up: float = 0.01
    """Share of the budget over which the learning rate rises; then it falls to 0."""
    q_weight: float = 5.0
    cpu_seconds: float = 1200.0
    """CPU seconds after which the run is complete."""
    updates: float = 1e9
    """Updates after which it is complete."""

    def __post_init__(self) -> None:
        """Reject networks, levels and budgets of nothing, and what is no share."""
        super().__post_init__()
        check_counts(self, "channels", "blocks", "levels")
        check_positive(self, "horizon", "cpu_seconds", "updates")
        check_shares(self, "warm_up")


class ExplorerActor(SequenceActor):
    """Explores levels."""

    def __init__(self, config: ExplorerConfig, network: Mapping[str, Any], stream: int) -> None:
        """Begin E levels; `stream` is the number of the random stream."""
        self._explorer, self._horizon = Explorer(**network), config.horizon
        levels = LevelStream(difficulty_shares(config.mix), config.seed, stream)
        self._pool = levels.draw(config.levels)
        rng = np.random.default_rng([config.seed, _STREAM, stream])
        generator = torch.Generator().manual_seed(int(rng.integers(1 << 31)))
        super().__init__(config, self._explorer, generator)
        levels = self._draw(config.environments)
        self._environment = ExplorationEnvironment(levels, rng, get_body(config.body), config.reward)

    @property
    def _parts(self) -> dict[str, Resumable]:
        return {"environment": self._environment}

    def _draw(self, count: int) -> NDArray[np.float32]:
        """Return random levels of the pool under random symmetries, [count, N, N, 4]."""
        rows = torch.randint(len(self._pool), (count,), generator=self._generator)
        symmetries = torch.randint(SYMMETRIES, (count, 1), generator=self._generator)
        return view_states(self._pool[rows], symmetries).numpy()

    def _ends(self, count: int) -> NDArray[np.bool_]:
        return (torch.rand(count, generator=self._generator) < 1.0 / self._horizon).numpy()

    def _step(self) -> tuple[dict[str, NDArray[Any]], dict[str, list[float]]]:
        state = self._environment.observe()
        with autocast("cpu"):
            policy = self._explorer(torch.from_numpy(state)).policy
        action = self._choose(policy.float()).numpy()
        step = self._environment.step(action)
        cut = step.truncated | ~step.complete & self._ends(len(action))
        over = np.flatnonzero(step.complete | cut)
        self._environment.begin(over, self._draw(len(over)))
        kept = {"state": state.astype(np.float16), "instruction": action, "reward": step.reward}
        return {**kept, "terminated": step.complete, "dropped": cut}, {"reward": step.reward.tolist()}


def judge_scout(scout: Scout, reward: ExplorationReward, levels: int, body: Body) -> dict[str, float]:
    """Let a scout of a body explore validation levels; return averages over them.

    `found` is the share of what can be seen and the first turn has not shown; `steps` and `looks` are the instructions
    of an episode, `reward` their return.
    """
    states = abstract_states(validation_levels(max(DIFFICULTIES), levels))
    environment = ExplorationEnvironment(states, np.random.default_rng(0), body, reward)
    hidden, going = environment.remaining, np.ones(levels, np.bool_)
    left = hidden.copy()
    steps, looks, returns = np.zeros(levels), np.zeros(levels), np.zeros(levels)
    while going.any():
        action = np.zeros(levels, np.int64)
        observed = environment.observe()
        for i in np.flatnonzero(going):
            answer = scout.step(observed[i, ..., :SHOWN], observed[i, ..., SHOWN] > 0.5)
            going[i] = answer is not None
            action[i] = answer or Instruction.STAY
        # Those who have stopped turn where they are, which does not count.
        step = environment.step(action)
        looks += going & (action == Instruction.STAY)
        steps += going & (action != Instruction.STAY)
        returns += np.where(going, step.reward, 0.0)
        left = np.where(going, environment.remaining, left)
        going &= environment.steps < WALKS
    found = 1.0 - left.sum() / max(int(hidden.sum()), 1)
    means = {"steps": steps.mean(), "looks": looks.mean(), "reward": returns.mean()}
    return {"found": float(found)} | {name: float(value) for name, value in means.items()}


class ExplorerLearner(DiscreteMPOLearner):
    """Learns where to look."""

    target: Explorer

    def __init__(self, config: ExplorerConfig) -> None:
        """Build the network."""
        torch.manual_seed(config.seed)  # the initial weights
        super().__init__(config, Explorer(config.channels, config.blocks, config.body))
        self._reward, self._body = config.reward, get_body(config.body)
        # What looks are worth differs by little, which a constant rate does not settle.
        self._schedule = ProgressSchedule(self._adam, warm_up_cosine(config.warm_up))

    def update(self, batch: MPOBatch, progress: float, guard: NaNGuard) -> dict[str, float]:
        """Take one gradient step at the rate that this share of the budget has."""
        self._schedule.follow(progress)
        return super().update(batch, progress, guard)

    def value(self, answer: Answer) -> Tensor:
        """Return what states are worth to one who may stop, [B]."""
        return super().value(answer).clamp(min=0.0)

    def evaluate(self) -> dict[str, float]:
        """Return what the target network gets to see of validation levels, and what the scripted scout does.

        It is kept if none has earned more.
        """
        scouts = self.target, ScriptedScout(self._body)
        learned, scripted = (judge_scout(scout, self._reward, _JUDGED, self._body) for scout in scouts)
        self.best.judge(self.target, (learned["reward"],), learned)
        return learned | {f"scripted/{name}": value for name, value in scripted.items()}

    def export(self, directory: RunDirectory, record: Mapping[str, Any]) -> None:
        """Write the target network that has earned most, or the present one, with its record."""
        self.best.save(directory.path / "explorer.safetensors", self.target, self.target.config, record)


def explore(
    config: ExplorerConfig, directory: Path, cadence: Cadence | None = None, actors: ActorOptions | None = None
) -> Trainer[MPOBatch]:
    """Open or resume a run."""
    learner = ExplorerLearner(config)
    pool = (actors or ActorOptions()).pool(partial(ExplorerActor, config, learner.target.config))
    source = ActorSource(
        pool, StepStore(config), steps_per_update=config.steps_per_update * config.environments,
        first_steps=config.warm_up_steps * config.environments,
    )  # fmt: skip
    record = {
        **provenance(),
        "method": "mpo, reward for cells that come into view",
        "training": asdict(config),
        "data": "a grid model of visibility on generated levels, training seeds",
    }
    budget = Budget(cpu_seconds=config.cpu_seconds, updates=config.updates)
    return Trainer(RunDirectory(directory, config), learner, source, budget, cadence, record=record)
