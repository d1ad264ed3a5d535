"""Sequences for MPO from recorded bags of the running stack (see `mujoban_msgs_py.bags`).

What the goal task would have said is worked out from the ground truth in the bag: goals, privileged features,
rewards and discounts. A sequence's recurrent state at its start is that of the policy that learns, which is run over
the episode for it.

Shapes: L ticks of an episode, T ticks of a sequence, K boxes, N rows and columns, U actuators.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from mujoban_controller.controller import Recurrent, VisuomotorController
from mujoban_controller.goal_features import drift, privileged_features
from mujoban_controller.goal_task import GoalTaskConfig, goal_reward
from mujoban_controller.privileged import PrivilegedPolicy
from mujoban_controller.replay import memory_fields
from mujoban_core.bodies import Body, get_body
from mujoban_core.grid import AGENT, CONTROL_PERIOD, GRID_SIZE, INSTRUCTION_LIMIT, WALL, xy_to_cell
from mujoban_core.interfaces import Memory
from mujoban_msgs_py import topics
from mujoban_msgs_py.bags import Bag, BagError
from mujoban_msgs_py.bags.training import episode_ticks, find_bags, open_training_bag
from mujoban_sim.driving import forward_speed
from mujoban_sim.goals import GoalTracker

TOPICS: Final = (
    topics.EPISODE,
    topics.CAMERA,
    topics.PROPRIO,
    topics.INSTRUCTION,
    topics.TERMINATION,
    topics.TORQUE,
    topics.TRUE_POSE,
    topics.TRUE_TWIST,
    topics.TRUE_BOXES,
    topics.TRUE_ABSTRACT_STATE,
    topics.TRUE_TERMINATION,
)
"""What training needs of a bag."""

Fields = dict[str, NDArray]
Policy = PrivilegedPolicy | VisuomotorController


def episodes(bag: Bag) -> Iterator[list[tuple[Any, ...]]]:
    """Yield the ticks of each episode, in the order of `TOPICS`, from its start up to a tick that is missing.

    Raises:
        BagError: As `episode_ticks`.
    """
    found: list[tuple[Any, ...]] = []
    for reading, values in episode_ticks(bag, TOPICS):
        if reading.step == 0 and found:
            yield found
            found = []
        found.append(values)
    if found:
        yield found


@dataclass
class RecordedView:
    """Ticks of an episode as `goal_features` sees a world; the batch is the ticks, L."""

    body: Body
    batch: int
    goals: GoalTracker
    proprio: NDArray[np.float32]
    pose: NDArray[np.float32]
    velocity: NDArray[np.float32]
    box_position: NDArray[np.float32]
    box_speed: NDArray[np.float32]
    box_cell: NDArray[np.int64]
    wall: NDArray[np.bool_]

    def at(self, ticks: NDArray[np.int64], goals_of: NDArray[np.int64]) -> RecordedView:
        """Return what was at the given ticks, with the goals of others, [M] each."""
        goals = GoalTracker(len(ticks), cell_size=self.body.cell_size)
        goals.restore([m[goals_of] for m in self.goals.memory()])
        return RecordedView(
            self.body, len(ticks), goals, self.proprio[ticks], self.pose[ticks], self.velocity[ticks],
            self.box_position[ticks], self.box_speed[ticks], self.box_cell[ticks], self.wall[ticks],
        )  # fmt: skip


def transitions(ticks: Sequence[tuple[Any, ...]], config: GoalTaskConfig) -> Fields:
    """Return the fields of MPO's replay for all but the last tick of an episode, [L - 1, ...].

    Args:
        ticks: As `episodes` yields them.
        config: Rewards and body.

    Raises:
        BagError: If the bag is of another body.
    """
    body = get_body(config.body)
    _, frame, proprio, instruction, said, torque, pose, velocity, box, state, true = zip(*ticks, strict=True)
    if len(proprio[0]) != body.proprio_size or len(torque[0]) != body.action_size:
        raise BagError(f"proprioception of {len(proprio[0])} values: expected a bag of the body {body.name}")
    boxes, abstract = np.stack(box), np.stack(state)
    cells = xy_to_cell(boxes, body.cell_size)
    cells[((cells < 0) | (cells >= GRID_SIZE)).any(-1)] = -1
    agent = abstract[..., AGENT].reshape(len(ticks), -1).argmax(-1)
    wall, completed = abstract[..., WALL] > 0.5, np.array([t.terminated for t in true])
    # Bags do not hold the boxes' speed. It is that over the ticks before and after.
    velocity_of_boxes = np.gradient(boxes, CONTROL_PERIOD, axis=0)
    goals, elapsed = _goals(
        instruction, completed, wall, np.stack([agent // GRID_SIZE, agent % GRID_SIZE], -1), cells, body
    )
    view = RecordedView(
        body, len(ticks), goals, np.stack(proprio), np.stack(pose), np.stack(velocity),
        boxes, np.linalg.norm(velocity_of_boxes, axis=-1), cells, wall,
    )  # fmt: skip
    now = np.arange(len(ticks) - 1)
    ended = np.array([t.terminated for t in said])[1:]
    failed = ended & ~completed[1:] & np.array([t.timed_out for t in said])[1:]
    terminated = np.array([t.terminated for t in said])
    terminated[0] = False
    return {
        "state": privileged_features(view, elapsed)[:-1],
        "first": now == 0,
        "frame": np.stack(frame)[:-1],
        "proprio": view.proprio[:-1],
        "instruction": np.array([i.direction for i in instruction], np.int64)[:-1],
        "terminated": terminated[:-1],
        "action": np.stack(torque)[:-1].astype(np.float32),
        "reward": _rewards(view, ended & completed[1:], failed, config),
        "discount": (~failed).astype(np.float32),
    }


def _goals(
    instruction: Sequence[Any],
    completed: NDArray[np.bool_],
    wall: NDArray[np.bool_],
    agent: NDArray[np.int64],
    boxes: NDArray[np.int64],
    body: Body,
) -> tuple[GoalTracker, NDArray[np.float64]]:
    """Return the goals in force at each tick and the share of the time limit that they have had, [L]."""
    tracker, row = GoalTracker(1, cell_size=body.cell_size), np.zeros(1, np.int64)
    memories, elapsed, since = [], [], 0
    for t, reading in enumerate(instruction):
        if t == 0 or reading.sequence != instruction[t - 1].sequence:
            tracker.reached[:] = completed[t] and t > 0
            direction = np.array([reading.direction], np.int64)
            tracker.begin(row, direction, wall[t : t + 1], agent[t : t + 1], boxes[t : t + 1])
            since = t
        memories.append(tracker.memory())
        elapsed.append((t - since) / INSTRUCTION_LIMIT)
    goals = GoalTracker(len(memories), cell_size=body.cell_size)
    goals.restore([np.concatenate(values) for values in zip(*memories, strict=True)])
    return goals, np.array(elapsed)


def _rewards(
    view: RecordedView, completed: NDArray[np.bool_], failed: NDArray[np.bool_], config: GoalTaskConfig
) -> NDArray[np.float32]:
    """Return the goal task's rewards for the torques of all ticks but the last, [L - 1]."""
    now = np.arange(view.batch - 1)
    before, after = view.at(now, now), view.at(now + 1, now)
    forward = forward_speed(after.pose, after.velocity, view.body.cell_size)
    return goal_reward(config, completed, failed, drift(after) - drift(before), forward)


class BagSequences:
    """Endless sequences from bags, one bag after the other in an order that is drawn anew each time."""

    def __init__(
        self, paths: Sequence[Path], config: GoalTaskConfig, policy: Policy, length: int, rng: np.random.Generator
    ) -> None:
        """Read sequences of `length` ticks from bags, or folders of bags.

        Raises:
            BagError: If there is no bag at a path, or one lacks a topic.
        """
        self._config, self._policy, self._length, self._rng = config, policy, length, rng
        self._bags = [open_training_bag(path, TOPICS) for path in find_bags(paths)]
        self._stream = self._endless()

    def __next__(self) -> tuple[Fields, Fields]:
        """Return per-tick fields, [T, 1, ...], and the memory at their start, [1, ...].

        Raises:
            BagError: As `episodes` and `transitions`, or if no episode is long enough.
        """
        return next(self._stream)

    def _endless(self) -> Iterator[tuple[Fields, Fields]]:
        while True:
            count = 0
            for i in self._rng.permutation(len(self._bags)):
                for ticks in episodes(self._bags[i]):
                    for sequence in self._cut(ticks):
                        count += 1
                        yield sequence
            if not count:
                raise BagError(f"no episode of {self._length + 1} ticks in {len(self._bags)} bags")

    def _cut(self, ticks: Sequence[tuple[Any, ...]]) -> Iterator[tuple[Fields, Fields]]:
        """Yield an episode's sequences; the last overlaps the one before, so that its end is not lost."""
        last = len(ticks) - 1 - self._length
        if last < 0:
            return
        fields = transitions(ticks, self._config)
        starts = sorted({*range(0, last + 1, self._length), last})
        memory: Memory = ()
        if isinstance(self._policy, VisuomotorController):
            memory = self._policy.initial_memory(1)
        else:
            fields = {k: v for k, v in fields.items() if k in ("state", "first", "action", "reward", "discount")}
        for start, following in zip(starts, [*starts[1:], last], strict=True):
            part = {k: v[start : start + self._length, None] for k, v in fields.items()}
            yield part, memory_fields(memory)
            memory = self._advance(memory, {k: v[None, start:following] for k, v in fields.items()})

    @torch.inference_mode()
    def _advance(self, memory: Memory, passed: Fields) -> Memory:
        """Return the policy's memory after some ticks, [1, M, ...]."""
        policy = self._policy
        if not isinstance(policy, VisuomotorController) or not passed["first"].size:
            return memory
        device = policy.mean.weight.device
        inputs = (torch.from_numpy(passed[k]).to(device) for k in ("frame", "proprio", "instruction", "terminated"))
        return policy(*inputs, Recurrent(*memory)).memory
