"""Privileged stand-ins for the four modules: perfect sensing, perfect plans, a scripted driver.

They show that the world is sound, isolate a learned module among perfect ones (paper Table 2), and teach.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mujoban_core.bodies import BODIES
from mujoban_core.grid import AGENT, BOX, GRID_SIZE, OFFSETS_XY, TARGET, WALL, Instruction, robot_cells, xy_to_cell
from mujoban_core.interfaces import (
    Controller,
    ControllerInput,
    Estimator,
    EstimatorInput,
    GroundTruth,
    Memory,
    Planner,
    Termination,
    TerminationInput,
)
from mujoban_sim.driving import (
    SteeringGains,
    forward_speed,
    limit_speed,
    plot_course,
    push_speed,
    roll_and_steer,
    touches,
)
from mujoban_sim.goals import GoalKind, GoalTracker
from mujoban_sokoban.rules import apply
from mujoban_sokoban.solver import MAX_NODES, Status, solve

_ABSENT: Final = 1000.0
"""Where in the map boxes lie that are not there [m]."""
_MAX_PLAN: Final = 1024
"""Moves of a plan that are remembered; the rest of a longer one is found again when they are done."""
_WEIGHTS: Final = (1.0, 2.0)
"""Weights of the searches that are tried in turn."""


def _require(truth: GroundTruth | None) -> GroundTruth:
    if truth is None:
        raise ValueError("an oracle got no ground truth: expected the simulator's")
    return truth


class OracleEstimator(Estimator):
    """Returns the true abstract state."""

    privileged = True

    def initial_memory(self, batch: int) -> Memory:
        """Return no memory."""
        return ()

    def step(self, inputs: EstimatorInput, state: Memory) -> tuple[NDArray[np.float32], Memory]:
        """Return s_abst, [B, N, N, 4]."""
        return _require(inputs.truth).abstract_state, state


class OracleTermination(Termination):
    """Reports the completion rule of paper C.4."""

    privileged = True

    def initial_memory(self, batch: int) -> Memory:
        """Return no memory."""
        return ()

    def probability(self, inputs: TerminationInput, memory: Memory) -> tuple[NDArray[np.float32], Memory]:
        """Return 1 where the instruction in force is completed, else 0, [B]."""
        return _require(inputs.truth).completed.astype(np.float32), memory


class _SokobanState(NamedTuple):
    """An abstract state as the rules and the solver take it."""

    wall: NDArray[np.bool_]
    target: NDArray[np.bool_]
    boxes: NDArray[np.int64]
    player: NDArray[np.int64]

    @classmethod
    def from_abstract(cls, state: NDArray[np.float32]) -> _SokobanState:
        """Read a (possibly estimated) abstract state, [N, N, 4]: cells above 1/2, and the likeliest agent's."""
        layer = state > 0.5
        player = np.array(np.unravel_index(state[..., AGENT].argmax(), state.shape[:2]))
        return cls(layer[..., WALL], layer[..., TARGET], np.argwhere(layer[..., BOX]), player)

    def movable(self) -> NDArray[np.bool_]:
        """Return where agent and boxes are, [N, N, 2]."""
        layers = np.zeros((GRID_SIZE, GRID_SIZE, 2), np.bool_)
        layers[(*self.player, 0)] = True
        layers[self.boxes[:, 0], self.boxes[:, 1], 1] = True
        return layers

    def after(self, move: int) -> _SokobanState:
        """Return the state that a move leads to by the rules."""
        result = apply(self.wall, self.target, self.boxes, self.player, move)
        return self._replace(boxes=result.boxes, player=result.player)


class OraclePlanner(Planner):
    """Follows the solver's plan, and plans again when the abstract state is not the one that the plan led to.

    Where there is no plan (the state cannot be solved, is solved, or is no Sokoban state) it says stay. It sees what
    every planner sees, so it also works on estimates.
    """

    privileged = True

    def __init__(self, *, max_nodes: int = MAX_NODES) -> None:
        """Give the optimal search `max_nodes` states, and if it fails a weighted one as many."""
        self._max_nodes = max_nodes

    def initial_memory(self, batch: int) -> Memory:
        """Return empty plans: moves int8 [B, L], cursor int64 [B], expected agent and boxes bool [B, N, N, 2]."""
        return (
            np.zeros((batch, _MAX_PLAN), np.int8),
            np.zeros(batch, np.int64),
            np.zeros((batch, GRID_SIZE, GRID_SIZE, 2), np.bool_),
        )

    def decide(self, abstract_state: NDArray[np.float32], memory: Memory) -> tuple[NDArray[np.int64], Memory]:
        """Return the next move of each plan, [M], from abstract states [M, N, N, 4]."""
        plan, cursor, expected = (m.copy() for m in memory)
        moves = np.zeros(len(plan), np.int64)
        for m, state in enumerate(abstract_state):
            grid = _SokobanState.from_abstract(state)
            if cursor[m] == _MAX_PLAN or not np.array_equal(grid.movable(), expected[m]):
                plan[m], cursor[m] = self._plan(grid), 0
            moves[m] = plan[m, cursor[m]]
            # A plan ends with stay, and there it rests.
            cursor[m] += moves[m] != Instruction.STAY
            expected[m] = grid.after(moves[m]).movable()
        return moves, (plan, cursor, expected)

    def _plan(self, grid: _SokobanState) -> NDArray[np.int8]:
        """Return the solution's moves, padded with stay, [L]."""
        plan = np.full(_MAX_PLAN, Instruction.STAY, np.int8)
        for weight in _WEIGHTS:
            try:
                solution = solve(*grid, max_nodes=self._max_nodes, weight=weight)
            except ValueError:
                # An estimate with, say, more boxes than targets.
                break
            if solution.status != Status.BUDGET:
                moves = solution.moves[:_MAX_PLAN]
                plan[: len(moves)] = moves
                break
        return plan


@dataclass(frozen=True)
class DrivingGains(SteeringGains):
    """Gains of the oracle; lengths in cells, speeds in cells per second, angles in radians."""

    move_speed: float = 1.5
    braking: float = 3.0
    """Speed per cell of distance left."""
    lane_gain: float = 1.5
    """Weight of the distance from the lane in the direction to drive in."""


def follow_goals(inputs: ControllerInput, memory: Memory, cell_size: float) -> tuple[GoalTracker, GroundTruth]:
    """Return the goals in force, given the memory of a `GoalTracker` from the tick before, and the truth.

    Every box that a goal may be about has a place in the truth that is returned; absent ones are far away.

    Raises:
        ValueError: if there is no ground truth.
    """
    truth = _require(inputs.truth)
    goals = GoalTracker(len(inputs.instruction), cell_size=cell_size)
    goals.restore(memory)
    boxes = int(goals.box_index.max(initial=0)) + 1
    truth = truth._replace(box_position=_with_absent(truth.box_position, boxes))
    goals.reached[:] = truth.completed
    issued = np.flatnonzero(inputs.terminated | (goals.kind == GoalKind.NONE))
    if issued.size:
        layers = truth.abstract_state
        boxes_at = cells_of_boxes(truth.box_position, cell_size)
        goals.begin(issued, inputs.instruction, layers[..., WALL] > 0.5, robot_cells(layers), boxes_at)
    return goals, truth


def cells_of_boxes(position: NDArray[np.floating], cell_size: float) -> NDArray[np.int64]:
    """Return the (row, column) of boxes, [..., K, 2], given their positions in metres; -1 for those off the grid."""
    cells = xy_to_cell(position, cell_size)
    cells[((cells < 0) | (cells >= GRID_SIZE)).any(-1)] = -1
    return cells


class OracleController(Controller):
    """A scripted driver that knows where everything is: turn, drive along the lane, reverse to recentre."""

    privileged = True

    def __init__(self, gains: DrivingGains | None = None) -> None:
        """Drive the body that scripts drive, and no other, with the given gains."""
        body = next(body for body in BODIES.values() if body.scripted)
        self.config = {"body": body.name}
        self._gains, self._cell_size = gains or DrivingGains(), body.cell_size

    def initial_memory(self, batch: int) -> Memory:
        """Return goals of robots without an instruction."""
        return GoalTracker(batch, cell_size=self._cell_size).memory()

    def step(self, inputs: ControllerInput, state: Memory) -> tuple[NDArray[np.float32], Memory]:
        """Return torques, [B, 2], and the goals in force."""
        goals, truth = follow_goals(inputs, state, self._cell_size)
        return drive(goals, truth, self._gains, self._cell_size), goals.memory()


def drive(goals: GoalTracker, truth: GroundTruth, gains: DrivingGains, size: float) -> NDArray[np.float32]:
    """Return the scripted driver's torques (roll, steer), normalised, [B, 2].

    Args:
        goals: the instructions in force.
        truth: where everything is.
        gains: the driver's gains.
        size: edge of a cell [m].
    """
    g = gains
    pose, velocity = truth.pose.astype(np.float64), truth.velocity.astype(np.float64)
    push = goals.kind == GoalKind.PUSH
    # Shape [B, 2]; zero where the robot holds its cell.
    lane = OFFSETS_XY[goals.direction] * (push | (goals.kind == GoalKind.MOVE))[:, None]
    course = plot_course(goals.robot_target, pose, lane, g.lane_gain, g, size)
    box = truth.box_position[np.arange(len(pose)), goals.box_index]
    box_left = ((goals.box_target - box) / size * lane).sum(-1)
    ahead = forward_speed(pose, velocity, size)
    pushing = push & ~course.recentre
    left = np.where(course.recentre, course.off_lane, np.maximum(course.along, 0.0))
    wanted = np.where(pushing, push_speed(box_left, ahead, g), g.braking * left)
    speed = limit_speed(wanted, g.move_speed, course, g)
    pushing &= touches(pose, box, lane, g, size)
    return roll_and_steer(speed, course.error, pushing, ahead, velocity[:, 2], g)


def _with_absent(box_position: NDArray[np.float32], count: int) -> NDArray[np.float32]:
    """Return box centres, [B, K, 2], of at least `count` boxes, none of them further out than `_ABSENT`.

    In the graph a box that is being pushed may be missing from what somebody says of the boxes.
    """
    missing = max(0, count - box_position.shape[1])
    return np.pad(box_position.clip(-_ABSENT, _ABSENT), ((0, 0), (0, missing), (0, 0)), constant_values=_ABSENT)
