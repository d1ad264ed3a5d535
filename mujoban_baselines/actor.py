"""An actor that plays a task with a recurrent agent, and what its sequences hold.

Shapes: L ticks of a sequence, B robots, U actuators.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mujoban_baselines.networks import Recurrent, RecurrentAgent
from mujoban_baselines.subgoals import SUBGOAL_REWARD, Subgoals
from mujoban_baselines.task import Task, TaskStep
from mujoban_core.agent import AgentInput
from mujoban_core.interfaces import Memory, renew_rows
from mujoban_rl.actors import Actor, Experience
from mujoban_rl.engine import State
from mujoban_rl.exploration import Exploration, Noise
from mujoban_rl.replay import SequenceBuilder

MEMORY_FIELDS: Final = ("memory0", "memory1")
"""The LSTM's memory before a tick, as sequences name it."""
COMPACT: Final = {"abstract_state": np.bool_}
"""Types in which sights are kept, where they are not those of the simulator."""


def memory_of(batch: Mapping[str, Tensor]) -> Recurrent:
    """Return the memory with which an agent went into sequences [M, L, ...]."""
    return Recurrent(*(batch[name][:, 0] for name in MEMORY_FIELDS))


class AgentActor(Actor):
    """Explores with the agent's distribution over torques.

    The agent decides in every so many ticks (`RecurrentAgent.repeat`), which are one tick of a sequence. Delivered are,
    [L, B, ...] each: what it read and what `beside` names; `action` [U], not limited to [-1, 1], and `log_prob` of what
    the world takes of it; `reward`, `terminated` and `truncated` of the step; `first` before which ticks an episode
    begins, and the memory before each; for agents with subgoals also `pseudo_reward` and `pseudo_over`.
    """

    def __init__(
        self,
        task: Task,
        agent: RecurrentAgent,
        *,
        length: int,
        overlap: int,
        beside: tuple[str, ...] = (),
        exploration: Exploration = "white",
        seed: int = 0,
    ) -> None:
        """Take a seat.

        Args:
            task: What is played.
            agent: Plays, with the weights of the learner.
            length: L.
            overlap: Ticks of a sequence that were in the one before.
            beside: What critics see of the task.
            exploration: How alike the noise of successive ticks is.
            seed: Of exploration, and of the agent's own random streams.
        """
        self._task, self._agent = task, agent.eval()
        self._beside = tuple(name for name in beside if name not in agent.sees)
        self._builder = SequenceBuilder(length, overlap)
        self._generator = torch.Generator().manual_seed(seed)
        self._noise = Noise(exploration, task.batch, agent.action_size, self._generator, ticks=agent.repeat)
        self._rng = np.random.default_rng(seed)
        self._state = agent.initial_state(self._streams(task.batch))
        self._first = np.ones(task.batch, np.bool_)

    def _streams(self, count: int) -> NDArray[np.int64]:
        return self._rng.integers(0, 2**31, count)

    def set_weights(self, weights: Mapping[str, Tensor], version: int) -> None:
        """Play with newer weights."""
        self._agent.load_state_dict(dict(weights))

    def act(self) -> Experience:
        """Play on until there is a sequence."""
        sequence, ticks = None, 0
        outcomes: dict[str, list[float]] = {}
        while sequence is None:
            sequence, ticks = self._builder.add(self._tick(outcomes)), ticks + 1
        steps = ticks * self._agent.repeat * self._task.batch
        return Experience(sequence, steps, {k: np.array(v) for k, v in outcomes.items()})

    @torch.no_grad()
    def _tick(self, outcomes: dict[str, list[float]]) -> dict[str, NDArray[Any]]:
        """Play one tick; return what is to be kept of it, and add outcomes of the episodes that ended with it."""
        agent, task, first = self._agent, self._task, self._first
        seen = task.observe((*agent.sees, *self._beside))
        sights, memory, others = agent.look(AgentInput(**{name: seen[name] for name in agent.sees}), self._state)
        output = agent(agent.to_tensors(sights), memory)
        action = output.action.at(self._noise.draw()[:, None])
        log_prob = output.action.limited_log_prob(action)[:, 0]
        taken = action[:, 0].numpy()
        step = self._hold(taken.clip(-1.0, 1.0))
        kept = {**sights, **{name: seen[name] for name in self._beside}}
        kept = {name: values.astype(COMPACT.get(name, values.dtype)) for name, values in kept.items()}
        kept |= {name: m.numpy() for name, m in zip(MEMORY_FIELDS, memory, strict=True)}
        kept |= {"action": taken, "log_prob": log_prob.numpy(), "first": first, **step._asdict()}
        kept |= self._pseudo_rewards(others, step.over)
        self._state, self._first = (*output.memory, *others), step.over
        rows = np.flatnonzero(step.over)
        if rows.size:
            self._noise.renew(rows)
            for name, values in task.renew(rows).items():
                outcomes.setdefault(name, []).extend(values)
            fresh = agent.initial_state(self._streams(task.batch))
            self._state = renew_rows(self._state, fresh, step.over)
        return kept

    def _hold(self, torque: NDArray[np.float32]) -> TaskStep:
        """Apply torques for as many ticks as the agent holds them; where an episode ends, nothing follows."""
        step = self._task.step(torque)
        for _ in range(1, self._agent.repeat):
            more, on = self._task.step(torque), ~step.over
            ends = (step.terminated | (more.terminated & on), step.truncated | (more.truncated & on))
            step = TaskStep(step.reward + more.reward * on, *ends)
        return step

    def _pseudo_rewards(self, others: Memory, over: NDArray[np.bool_]) -> dict[str, NDArray[Any]]:
        """Return what an agent with subgoals got for the step that has been taken."""
        if not others:
            return {}
        subgoals, state = Subgoals(*others), self._task.observe(("abstract_state",))["abstract_state"]
        reward = np.float32(SUBGOAL_REWARD) * subgoals.reached(state)
        return {"pseudo_reward": reward.astype(np.float32), "pseudo_over": subgoals.over(state) | over}

    def state(self) -> State:
        """Return all that changes but the weights."""
        memory = {f"memory{i}": torch.as_tensor(np.asarray(part)) for i, part in enumerate(self._state)}
        own = State(
            {"rng": self._rng.bit_generator.state},
            {"generator": self._generator.get_state(), "first": torch.from_numpy(self._first), **memory},
        )
        parts = {"noise": self._noise, "task": self._task, "builder": self._builder}
        return State.of({"own": own, **{name: part.state() for name, part in parts.items()}})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        own = state.part("own")
        self._rng.bit_generator.state = own.values["rng"]
        self._generator.set_state(own.tensors["generator"])
        self._first = own.tensors["first"].numpy()
        # Copies lie in memory as what torch makes does: matrix products round by that.
        restored: list[Any] = [own.tensors[f"memory{i}"].clone() for i in range(len(self._state))]
        self._state = tuple(
            part if isinstance(before, Tensor) else part.numpy()
            for part, before in zip(restored, self._state, strict=True)
        )
        self._noise.restore(state.part("noise"))
        self._task.restore(state.part("task"))
        self._builder.restore(state.part("builder"))

    def close(self) -> None:
        """Free the cameras."""
        self._task.close()


TaskFactory = Callable[[np.random.Generator], Task]
"""Makes a task whose randomness comes from a generator; must be picklable."""
AgentFactory = Callable[[], RecurrentAgent]
"""Builds the agent that actors play with; must be picklable."""


def make_actor(
    task: TaskFactory, agent: AgentFactory, length: int, overlap: int, beside: tuple[str, ...],
    exploration: Exploration, seed: int, stream: int,
) -> AgentActor:  # fmt: skip
    """Return the actor with a number of its own; with a `functools.partial`, an `ActorFactory`."""
    streams = np.random.SeedSequence([seed, stream]).spawn(2)
    player = agent()
    player.mixed_precision = True
    return AgentActor(
        task(np.random.default_rng(streams[0])), player, length=length, overlap=overlap, beside=beside,
        exploration=exploration, seed=int(streams[1].generate_state(1)[0]),
    )  # fmt: skip
