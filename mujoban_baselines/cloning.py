"""Behaviour cloning: the monolithic agent copies the torques of the modular stack, from recorded bags.

Sequences follow each other: the LSTM's memory goes on from batch to batch, and is cleared where an episode begins.

Shape legend: R rows, each of which reads episodes of its own, W ticks of a batch.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from mujoban_baselines.agents import MonolithicAgent
from mujoban_baselines.networks import Recurrent
from mujoban_core.ranges import check_counts, check_positive
from mujoban_msgs_py import topics
from mujoban_msgs_py.bags import Bag, BagError
from mujoban_msgs_py.bags.training import (
    bag_digest,
    episodes,
    find_bags,
    open_training_bag,
    require_about,
    require_training_seeds,
)
from mujoban_rl.engine import Learner, Scalars, Source, State
from mujoban_rl.limits import NaNGuard
from mujoban_rl.optimise import ProgressSchedule, guarded_step, warm_up_cosine
from mujoban_rl.recordings import EndlessEpisodes, Fields
from mujoban_rl.run_directory import RunDirectory
from mujoban_rl.weights import save_weights

Batch = dict[str, Tensor]
TOPICS: Final = (topics.TRUE_EPISODE, topics.CAMERA, topics.PROPRIO, topics.POSE, topics.TORQUE)
"""What cloning needs of a bag."""
FIELDS: Final = ("frame", "proprio", "pose", "action")
"""What it makes of them."""


@dataclass(frozen=True)
class CloningConfig:
    """Settings of cloning."""

    rows: int = 16
    """R, rows of a batch, each of which reads episodes of its own."""
    window: int = 32
    """W, ticks of a batch."""
    rate: float = 5e-4
    """Largest learning rate; it falls to 0 along a half cosine."""
    clip: float = 10.0
    """Largest norm of the gradient."""
    normalised: int = 500
    """Updates after which the normalisation of proprioception stays as it is."""

    def __post_init__(self) -> None:
        """Reject batches without a tick."""
        check_counts(self, "rows", "window")
        check_counts(self, "normalised", least=0)
        check_positive(self, "rate", "clip")


class BagSource(Source[Batch]):
    """The next W ticks of R episodes at a time."""

    def __init__(
        self, paths: Sequence[Path], agent: MonolithicAgent, config: CloningConfig, rng: np.random.Generator,
        about: Mapping[str, str] | None = None,
    ) -> None:  # fmt: skip
        """Read bags.

        Args:
            paths: Bags, or folders of bags.
            agent: Who copies; bags have to be of its body.
            config: Rows and ticks.
            rng: Draws the order of the bags.
            about: Body and world that bags have to be of, by `body` and `world`.

        Raises:
            BagError: If there is no bag at a path, or one lacks a topic, is of another body or world, or begins with a
                level that is not for training.
        """
        self._sizes, self._window = (agent.proprio_size, agent.action_size), config.window
        bags = [open_training_bag(path, TOPICS) for path in find_bags(paths)]
        for bag in bags:
            require_training_seeds(bag)
            require_about(bag, about or {}, "--{}")
        self._episodes = EndlessEpisodes(bags, self._read, rng, config.rows, lambda bag: bag_digest(bag.path))

    def _read(self, bag: Bag) -> Iterator[Fields]:
        """Yield the fields of a bag's episodes, [L, ...] each."""
        for ticks in episodes(bag, TOPICS):
            columns = [np.stack(values) for values in list(zip(*ticks, strict=True))[1:]]
            fields: Fields = dict(zip(FIELDS, columns, strict=True))
            if (fields["proprio"].shape[1], fields["action"].shape[1]) != self._sizes:
                raise BagError(f"{bag.path}: expected a bag of the agent's body, with {self._sizes[1]} torques")
            floats = {name: values.astype(np.float32) for name, values in fields.items() if name != "frame"}
            yield {**fields, **floats, "first": np.arange(len(ticks)) == 0}

    def next_batch(self) -> Batch:
        """Return the next ticks of every row, [R, W, ...] each."""
        window = [self._episodes.next() for _ in range(self._window)]
        self.samples += len(self._episodes) * self._window
        return {
            name: torch.from_numpy(np.stack([np.stack([fields[name][t] for fields, t in tick]) for tick in window], 1))
            for name in (*FIELDS, "first")
        }

    def state(self) -> State:
        """Return where the bags are."""
        return self._episodes.state()

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        self._episodes.restore(state)


class CloningLearner(Learner[Batch]):
    """Brings the mean torque near to the recorded one."""

    def __init__(self, agent: MonolithicAgent, config: CloningConfig) -> None:
        """Train `agent` in place; its scale stays what it is, for MPO to explore with."""
        self.agent, self.config = agent, config
        agent.mixed_precision = True
        self._adam = torch.optim.Adam(agent.parameters(), config.rate, fused=True)
        self._schedule = ProgressSchedule(self._adam, warm_up_cosine(0.02))
        self._memory = Recurrent(*agent.initial_memory(config.rows))

    @property
    def modules(self) -> Mapping[str, nn.Module]:
        """The agent."""
        return {"agent": self.agent}

    @property
    def optimisers(self) -> Mapping[str, torch.optim.Optimizer]:
        """Adam."""
        return {"adam": self._adam}

    def state(self) -> State:
        """Return the memory in which the next batch begins."""
        return State(tensors=dict(self._memory._asdict()))

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        self._memory = Recurrent(*(state.tensors[name].clone() for name in Recurrent._fields))

    def export(self, directory: RunDirectory, record: Mapping[str, Any]) -> None:
        """Write the agent."""
        save_weights(directory.path / "agent.safetensors", self.agent, self.agent.config, record)

    def update(self, batch: Batch, progress: float, guard: NaNGuard) -> Scalars:
        """Take one step along a batch."""
        self._schedule.follow(progress)
        output = self.agent({name: batch[name] for name in self.agent.reads}, self._memory, batch["first"])
        loss = functional.mse_loss(output.action.mean, batch["action"])
        norm = guarded_step(loss, [self._adam], guard, clip=self.config.clip)
        if norm is None:
            return {}
        self._memory = Recurrent(*(part.detach() for part in output.memory))
        self.agent.sense.meet(batch["proprio"][:, 0], self.config.normalised)
        return {"loss/torque": float(loss.detach()), "gradient_norm": float(norm)}
