"""An actor that plays the overall task with the whole stack: sense, terminate, plan, act, in every tick.

Shapes: L ticks of a sequence, B robots, U actuators, D decisions that were finished meanwhile.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import mujoban_estimator
from mujoban_baselines.joint.decisions import DecisionLog
from mujoban_baselines.joint.settings import JointSettings, StartingWeights
from mujoban_baselines.joint.stack import DrawingController, DrawingPlanner
from mujoban_baselines.task import MujobanTask, TaskConfig
from mujoban_controller.controller import MEMORY_FIELDS, VisuomotorController
from mujoban_controller.goal_features import NEIGHBOURS, neighbour_cells, privileged_features
from mujoban_core.bodies import get_body
from mujoban_core.grid import CHANNELS, GRID_SIZE, INSTRUCTION_AXES, INSTRUCTION_LIMIT, TARGET
from mujoban_core.interfaces import Observation, renew_rows
from mujoban_core.look_around import LookAroundController, look_around
from mujoban_core.sense_plan_act import Decision, PolicyState, SensePlanAct
from mujoban_core.trees import leaves, map_leaves
from mujoban_planner.networks import ARCHITECTURES
from mujoban_planner.planner import LearnedPlanner
from mujoban_rl.actors import Actor, Experience
from mujoban_rl.engine import State
from mujoban_rl.replay import SequenceBuilder
from mujoban_sim.world import World

SEEN: Final = GRID_SIZE * GRID_SIZE * len(CHANNELS) + NEIGHBOURS
"""Features of the critic that tell what earns a reward, behind those of the goal: `around_instruction`."""
DECISION: Final = "decision/"
"""Begins the names of what is delivered of decisions."""

_QUARTERS: Final = -np.round(np.arctan2(INSTRUCTION_AXES[:, 1], INSTRUCTION_AXES[:, 0]) / (np.pi / 2))
"""Quarter turns of the map that bring an instruction's direction along its rows."""


def around_instruction(world: World) -> NDArray[np.float32]:
    """Return the true map, turned so that the instruction points along its rows, and which neighbours are targets.

    The critic sees all else from the instruction, too: in a map that stands still nothing says which way is ahead.
    Of shape [B, SEEN].
    """
    state, direction = world.abstract_state(), world.goals.direction
    turned = state.copy()
    for rotated in np.unique(direction):
        rows = direction == rotated
        turned[rows] = np.rot90(state[rows], int(_QUARTERS[rotated]), (1, 2))
    cells = neighbour_cells(world)
    targets = state[np.arange(world.batch)[:, None], cells[..., 0], cells[..., 1], TARGET]
    return np.concatenate([turned.reshape(world.batch, -1), targets], 1, dtype=np.float32)


class Networks(NamedTuple):
    """What learns."""

    controller: VisuomotorController
    planner: LearnedPlanner

    def weights(self) -> dict[str, Tensor]:
        """Return the weights of both by name."""
        return {
            f"{name}.{k}": v for name, network in self._asdict().items() for k, v in network.state_dict().items()
        }

    def take(self, weights: Mapping[str, Tensor]) -> None:
        """Take over what `weights` returned."""
        for name, network in self._asdict().items():
            own = {k.removeprefix(f"{name}."): v for k, v in weights.items() if k.startswith(f"{name}.")}
            network.load_state_dict(own)

    def plans(self) -> tuple[dict[str, Any], str, dict[str, Any]]:
        """Return what `built` makes networks like these of."""
        return self.controller.config, type(self.planner).__name__, self.planner.config

    @classmethod
    def built(cls, controller: dict[str, Any], architecture: str, planner: dict[str, Any]) -> Networks:
        """Return networks without weights, by the keyword arguments of both."""
        networks = cls(VisuomotorController(**controller), ARCHITECTURES[architecture](**planner))
        networks.controller.mixed_precision = True
        networks.planner.lay_out()
        return networks


class JointActor(Actor):
    """Explores with the policies of planner and controller.

    Delivered are of each tick, [L, B, ...]: what the controller read (`frame`, `proprio`, `instruction` and the
    signal `terminated`) and its memory; `action` [U], limited to [-1, 1], and whether it has `driven`; the critic's
    `features`; `reward`, `discount` (0 where the level was solved) and `truncated`; `first`, before which ticks an
    episode begins. And of the decisions that were finished meanwhile, [D, ...]: the fields of `DecisionLog`.
    """

    def __init__(
        self, task: MujobanTask, networks: Networks, start: StartingWeights, settings: JointSettings, seed: int
    ) -> None:
        """Take a seat; `seed` is that of exploration, and of the modules' own random streams."""
        self._task, self._networks = task, networks
        self._generator = torch.Generator().manual_seed(seed)
        self._rng = np.random.default_rng(seed)
        own, body = settings.controller, get_body(networks.controller.body)
        turn = settings.turn(body)
        for network in networks:
            network.eval()
        planner = DrawingPlanner(networks.planner, self._generator)
        controller = DrawingController(networks.controller, self._generator, own.explore, own.steady)
        looking = [look_around(module, turn, body=body) for module in (planner, controller)]
        # The controller of a body that no single action turns does so itself, and learns it like all else.
        self._turns = isinstance(looking[1], LookAroundController)
        self._stack = SensePlanAct(
            mujoban_estimator.load(start.path("estimator", body.name), compiled=False),
            mujoban_estimator.load_termination(start.path("termination", body.name), compiled=False),
            *looking,  # pyright: ignore[reportArgumentType]
        )
        self._builder = SequenceBuilder(own.sequence, own.skipped)
        self._log = DecisionLog(task.batch, settings.planner.n_step, settings.planner.discount)
        self._state: PolicyState = self._fresh()
        self._first = np.ones(task.batch, np.bool_)
        self._torque = np.zeros((task.batch, networks.controller.action_size), np.float32)

    def _fresh(self) -> PolicyState:
        return self._stack.initial_state(self._rng.integers(0, 2**31, self._task.batch))

    def set_weights(self, weights: Mapping[str, Tensor], version: int) -> None:
        """Play with newer weights."""
        self._networks.take(weights)

    def act(self) -> Experience:
        """Play on until there is a sequence."""
        sequence, ticks = None, 0
        outcomes: dict[str, list[float]] = {}
        while sequence is None:
            sequence, ticks = self._builder.add(self._tick(outcomes)), ticks + 1
        decisions = {f"{DECISION}{name}": values for name, values in self._log.take().items()}
        statistics = {name: np.array(values) for name, values in outcomes.items()}
        return Experience({**sequence, **decisions}, ticks * self._task.batch, statistics)

    def _tick(self, outcomes: dict[str, list[float]]) -> dict[str, NDArray[Any]]:
        """Play one tick; return what is to be kept of it, and add outcomes of what ended with it."""
        task, world, first = self._task, self._task.world, self._first
        seen, memory = world.observation(), self._state.controller
        said, state = self._stack.step(seen, world.truth(), self._state)
        world.instruct(said.instruction, said.issued)
        features = self._features(state)
        # Looks, and the ways to them, are part of the decision before: the planner did not ask for them.
        own = np.flatnonzero(state.planner.memory[0] != self._state.planner.memory[0])
        self._log.decided(own, said.abstract_state[own], said.instruction[own])
        step = task.step(said.torque)
        self._log.rewarded(step.reward)
        self._log.ended(step.terminated, step.truncated)
        read = zip(MEMORY_FIELDS, memory[: len(MEMORY_FIELDS)], strict=True)
        kept = self._read(seen, said, state) | {name: m.numpy() for name, m in read}
        kept |= {
            "features": features, "first": first, "reward": step.reward, "truncated": step.truncated,
            "discount": (~step.terminated).astype(np.float32),
        }  # fmt: skip
        ended = said.termination.terminated
        outcomes.setdefault("instructions/completed", []).extend((~said.termination.timed_out[ended]).astype(float))
        self._state, self._first, self._torque = state, step.over, np.where(step.over[:, None], 0.0, said.torque)
        rows = np.flatnonzero(step.over)
        if rows.size:
            for name, values in task.renew(rows).items():
                outcomes.setdefault(name, []).extend(values)
            self._state = renew_rows(self._state, self._fresh(), step.over)
        return kept

    def _read(self, seen: Observation, said: Decision, state: PolicyState) -> dict[str, NDArray[Any]]:
        """Return what the controller read and did, and whether it was itself that drove."""
        turned = state.controller[-1] > 0 if self._turns else np.zeros(self._task.batch, np.bool_)
        return {
            "frame": seen.frame, "proprio": seen.proprio, "instruction": said.instruction,
            "terminated": said.termination.terminated, "action": said.torque, "driven": ~turned,
        }  # fmt: skip

    def _features(self, state: PolicyState) -> NDArray[np.float32]:
        """Return what the critic sees, with the instructions in force."""
        world = self._task.world
        # The tick in which an instruction is given counts as its first.
        elapsed = (state.termination.elapsed - 1) / INSTRUCTION_LIMIT
        goal = privileged_features(world, elapsed, self._torque)
        return np.concatenate([goal, around_instruction(world)], 1, dtype=np.float32)

    def state(self) -> State:
        """Return all that changes but the weights."""
        said = {f"{i:03d}": torch.as_tensor(leaf) for i, leaf in enumerate(leaves(self._state))}
        own = {
            "generator": self._generator.get_state(), "first": torch.from_numpy(self._first),
            "torque": torch.from_numpy(self._torque),
        }  # fmt: skip
        return State.of({
            "own": State({"rng": self._rng.bit_generator.state}, own), "stack": State(tensors=said),
            "log": self._log.state(), "task": self._task.state(), "builder": self._builder.state(),
        })  # fmt: skip

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        own, said = state.part("own"), state.part("stack").tensors
        self._rng.bit_generator.state = own.values["rng"]
        self._generator.set_state(own.tensors["generator"])
        self._first, self._torque = own.tensors["first"].numpy(), own.tensors["torque"].numpy()
        kept = iter(said[name] for name in sorted(said))

        def taken(leaf: Any) -> Any:
            # Copies lie in memory as what torch makes does: matrix products round by that.
            tensor = next(kept).clone()
            return tensor.numpy() if isinstance(leaf, np.ndarray) else tensor

        self._state = map_leaves(taken, self._state)
        for name, part in (("log", self._log), ("task", self._task), ("builder", self._builder)):
            part.restore(state.part(name))

    def close(self) -> None:
        """Free the cameras."""
        self._task.close()


def make_actor(
    task: TaskConfig, plans: tuple[dict[str, Any], str, dict[str, Any]], start: StartingWeights,
    settings: JointSettings, seed: int, stream: int,
) -> JointActor:  # fmt: skip
    """Return the actor with a number of its own; with a `functools.partial`, an `ActorFactory`."""
    streams = np.random.SeedSequence([seed, stream]).spawn(2)
    levels, own = np.random.default_rng(streams[0]), int(streams[1].generate_state(1)[0])
    return JointActor(MujobanTask(task, levels), Networks.built(*plans), start, settings, own)
