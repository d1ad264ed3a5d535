"""Ticks for the camera policy from recorded bags of the running stack (see `mujoban_msgs_py.bags`).

What the goal task would have said is worked out from the ground truth in the bag: goals, privileged features,
rewards and discounts, and with them what a privileged teacher would have done. The memory before a tick is that of
the policy that learns, which is run over the episode for it.

Shapes: L ticks of an episode, R rows, K boxes, N rows and columns of the grid, U actuators.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mujoban_controller.controller import INPUT_FIELDS, MEMORY_FIELDS, Recurrent, VisuomotorController
from mujoban_controller.goal_features import goal_offsets, privileged_features
from mujoban_controller.goal_rewards import GoalReward, fallen
from mujoban_controller.goal_settings import GoalTaskConfig
from mujoban_controller.goal_task import Outcome
from mujoban_controller.goal_view import StoredView
from mujoban_controller.play import Fields, Player
from mujoban_controller.privileged import PrivilegedPolicy
from mujoban_core.bodies import Body, get_body
from mujoban_core.grid import CONTROL_PERIOD, INSTRUCTION_LIMIT, WALL, robot_cells
from mujoban_core.interfaces import renew_rows
from mujoban_msgs_py import topics
from mujoban_msgs_py.bags import Bag, BagError
from mujoban_msgs_py.bags.training import bag_digest, episodes, find_bags, open_training_bag, require_about
from mujoban_rl.engine import State
from mujoban_rl.recordings import EndlessEpisodes
from mujoban_sim.goals import GoalTracker
from mujoban_sim.oracles import cells_of_boxes

TOPICS: Final = (
    topics.TRUE_EPISODE,
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


def transitions(ticks: Sequence[tuple[Any, ...]], config: GoalTaskConfig) -> Fields:
    """Return the fields of MPO's replay for all but the last tick of an episode, [L - 1, ...].

    An episode ends where the robot falls, as in the goal task. A push beyond its target goes on, as in the bag, until
    its instruction ends.

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
    cells = cells_of_boxes(boxes, body.cell_size)
    wall, completed = abstract[..., WALL] > 0.5, np.array([t.terminated for t in true])
    # Bags do not hold the boxes' speed. It is that over the ticks before and after.
    velocity_of_boxes = np.gradient(boxes, CONTROL_PERIOD, axis=0)
    goals, elapsed = _goals(instruction, completed, wall, robot_cells(abstract), cells, body)
    view = StoredView(
        body, len(ticks), goals, np.stack(proprio), np.stack(pose), np.stack(velocity),
        boxes, np.linalg.norm(velocity_of_boxes, axis=-1), cells, wall,
    )  # fmt: skip
    now = np.arange(len(ticks) - 1)
    ended = np.array([t.terminated for t in said])[1:]
    lying = fallen(view)[1:]
    failed = (ended & ~completed[1:] & np.array([t.timed_out for t in said])[1:]) | lying
    terminated = np.array([t.terminated for t in said])
    terminated[0] = False
    applied = np.stack(torque).astype(np.float32)
    before = np.concatenate([np.zeros_like(applied[:1]), applied[:-1]])
    rule = GoalReward(config.reward)
    there = rule.before(view.at(now, now))
    change = (applied - before)[:-1]
    discount = (~failed).astype(np.float32)
    last = int(lying.argmax()) if lying.any() else len(now) - 1
    # What comes after the last tick is another episode.
    discount[last] = 0.0
    fields = {
        "features": privileged_features(view, elapsed, before)[:-1],
        "first": now == 0,
        "frame": np.stack(frame)[:-1],
        "proprio": view.proprio[:-1],
        "instruction": np.array([i.direction for i in instruction], np.int64)[:-1],
        "terminated": terminated[:-1],
        "action": applied[:-1],
        "reward": rule.after(view.at(now + 1, now), there, change, ended & completed[1:], failed),
        "discount": discount,
        "truncated": (discount == 0.0) & ~failed,
        "goal": goal_offsets(view)[:-1],
        "kind": goals.kind[:-1].copy(),
        "pose": view.pose[:-1].astype(np.float32),
    }
    return {name: values[: last + 1] for name, values in fields.items()}


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


class BagTicks(Iterator[Fields]):
    """Endless ticks of R episodes at a time, with the memory of the policy that learns."""

    def __init__(
        self, paths: Sequence[Path], config: GoalTaskConfig, policy: VisuomotorController, rows: int,
        rng: np.random.Generator, teacher: PrivilegedPolicy | None = None,
    ) -> None:  # fmt: skip
        """Read `rows` rows.

        Args:
            paths: Bags, or folders of bags.
            config: Rewards and body.
            policy: The one that acts, whose weights change.
            rows: R.
            rng: Draws the order of the bags.
            teacher: Labels each tick with the torques that it would have applied.

        Raises:
            BagError: If there is no bag at a path, or one lacks a topic or names another body or world.
        """
        self._config, self._policy, self._teacher = config, policy, teacher
        bags = [open_training_bag(path, TOPICS) for path in find_bags(paths)]
        for bag in bags:
            require_about(bag, {"body": config.body, "world": config.world}, "--task.{}")
        self._episodes = EndlessEpisodes(bags, self._read, rng, rows, lambda bag: bag_digest(bag.path))
        self._memory = Recurrent(*policy.initial_memory(rows))

    def _read(self, bag: Bag) -> Iterator[Fields]:
        """Yield the fields of a bag's episodes of two ticks or more."""
        for ticks in episodes(bag, TOPICS):
            if len(ticks) > 1:
                fields = transitions(ticks, self._config)
                yield fields if self._teacher is None else fields | {"label": self._teacher.act(fields["features"])}

    @torch.no_grad()
    def __next__(self) -> Fields:
        """Return one tick of every row with the policy's memory before it, [R, ...] each.

        Raises:
            BagError: As `episodes` and `transitions`.
            ValueError: If no episode has two ticks.
        """
        found = self._episodes.next()
        tick = {name: np.stack([fields[name][t] for fields, t in found]) for name in found[0][0]}
        fresh = self._policy.initial_memory(len(found))
        memory = Recurrent(*renew_rows(self._memory, fresh, tick["first"]))
        seen = (torch.from_numpy(tick[name]).to(self._policy.device)[:, None] for name in INPUT_FIELDS)
        output = self._policy(*seen, memory=memory)
        self._memory = output.memory
        if self._teacher is None:
            # The policy that learns did not play these ticks, but it is the one whose values are asked for.
            mean, scale = (x[:, 0].cpu().numpy() for x in output.action)
            tick |= {"mean": mean, "scale": scale}
        return tick | {name: m.cpu().numpy() for name, m in zip(MEMORY_FIELDS, memory, strict=True)}

    def state(self) -> State:
        """Return where each row is, with the policy's memory."""
        memory = State(tensors=dict(zip(MEMORY_FIELDS, self._memory, strict=True)))
        return State.of({"episodes": self._episodes.state(), "memory": memory})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        self._episodes.restore(state.part("episodes"))
        tensors = state.part("memory").tensors
        self._memory = Recurrent(*(tensors[name].to(self._policy.device) for name in MEMORY_FIELDS))


class BagPlayer(Player):
    """Plays nothing: its ticks are those of recordings."""

    def __init__(self, ticks: BagTicks, policy: VisuomotorController) -> None:
        """Take ticks from `ticks`, whose memory is that of `policy`."""
        self._ticks, self._policy = ticks, policy

    def tick(self) -> tuple[Fields, Sequence[Outcome]]:
        """Return the next tick of each row, [R, ...] each; nobody counts how instructions ended."""
        return next(self._ticks), ()

    def take(self, weights: Mapping[str, Tensor]) -> None:
        """Remember with these weights from now on."""
        self._policy.load_state_dict(dict(weights))

    def state(self) -> State:
        """Return where the recordings are."""
        return self._ticks.state()

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        self._ticks.restore(state)

    def close(self) -> None:
        """Do nothing: bags are open only while they are read."""
