import numpy as np
import pytest

from bringup.command import Choice, Stack
from bringup.rollout import ticks
from mujoban_controller.controller import VisuomotorController
from mujoban_controller.privileged import PrivilegedPolicy
from mujoban_core.bodies import ANT, BALL, BODIES
from mujoban_core.grid import AGENT, BOX, WALL, Instruction
from mujoban_core.interfaces import ControllerInput, Planner
from mujoban_core.look_around import LookAroundPlanner, Scout, look_around
from mujoban_core.sense_plan_act import SensePlanAct
from mujoban_core.viewpoints import step_to_view, walk_view
from mujoban_rl.weights import save_weights
from mujoban_sim.oracles import OracleController, OracleEstimator, OraclePlanner, OracleTermination
from mujoban_sim.world import World
from mujoban_sokoban.episodes import Episodes

NOTHING_SEEN = np.zeros((10, 10), np.bool_)


def estimate(*rows):
    """Return an estimate whose interior is drawn: '#' wall, ' ' floor, '$' box, '@' robot, '?' never seen."""
    state = np.zeros((10, 10, 4), np.float32)
    state[..., WALL] = 1.0
    for r, row in enumerate(rows, 1):
        for c, cell in enumerate(row, 1):
            state[r, c, WALL] = {"#": 0.99, "?": 0.75}.get(cell, 0.01)
            state[r, c, BOX] = cell == "$"
            state[r, c, AGENT] = cell == "@"
    return state


ROOM = ("########", "#@  ####", "#   ####", "## #####", "## ?????", "## ?????", "########", "########")


def test_the_robot_turns_once_on_the_spot_then_solves_the_level_as_ever():
    parts = (OracleEstimator(), OracleTermination(), OraclePlanner(), OracleController())
    policy = SensePlanAct(*(look_around(part, BALL.look_ticks) for part in parts))  # pyright: ignore
    headings, places, instructions = [], [], []
    solved = False
    for tick in ticks(policy, World(1), Episodes(1, 7, difficulty=1)):
        headings.append(tick.observation.pose[0, 2])
        places.append(tick.observation.pose[0, :2])
        instructions.append(int(tick.decision.instruction[0]))
        solved |= bool(tick.solved[0])
    looking = BALL.look_ticks
    assert not any(instructions[:looking]) and any(instructions[looking : looking + 3])
    turned = np.abs(np.unwrap(headings[:looking])[-1] - headings[0])
    assert turned > 0.9 * 2 * np.pi
    assert np.abs(np.array(places[:looking]) - places[0]).max() < 0.1
    assert solved


def test_the_robot_walks_to_where_it_sees_into_the_unknown_room_and_looks_there():
    state = estimate(*ROOM)
    way = []
    for _ in range(20):
        step = step_to_view(state, NOTHING_SEEN)
        if step == Instruction.STAY:
            break
        assert step is not None
        way.append(step)
        row, column = np.argwhere(state[..., AGENT] > 0.5)[0]
        offset = {1: (-1, 0), 2: (0, 1), 3: (1, 0), 4: (0, -1)}[int(step)]
        state[row, column, AGENT] = 0.0
        assert state[row + offset[0], column + offset[1], WALL] < 0.5
        state[row + offset[0], column + offset[1], AGENT] = 1.0
    assert len(way) >= 3 and state[5:7, 3, AGENT].any()


def test_no_walk_where_all_is_known_was_looked_at_or_lies_behind_a_box():
    known = tuple(row.replace("?", "#") for row in ROOM)
    assert step_to_view(estimate(*known), NOTHING_SEEN) is None
    assert step_to_view(estimate(*ROOM), estimate(*ROOM)[..., WALL] == np.float32(0.75)) is None
    closed = (*ROOM[:3], "##$#####", *ROOM[4:])
    step = step_to_view(estimate(*closed), NOTHING_SEEN)
    assert step is None or step == Instruction.STAY  # boxes hide nothing, but are in the way


def test_a_robot_comes_to_rest_before_it_turns_and_turns_on_only_while_it_stays_there():
    controller = look_around(OracleController(), 40)
    state, driven = controller.initial_memory(1), []
    #             a push, told to stay, has stayed, ...      drifts off, is said to have stayed,  goes on, stays
    said = [(2, 0), (0, 1), (0, 0), (0, 0), (0, 1), (0, 1), *[(0, 0)] * 12, (0, 1), (2, 1), (0, 1), (0, 0), (0, 1)]
    truth = World(1).truth()
    for instruction, terminated in said:
        observation = ControllerInput(
            np.array([instruction]), np.zeros((1, 64, 64, 3), np.uint8), np.zeros((1, 17), np.float32),
            np.array([terminated == 1]), truth,
        )  # fmt: skip
        torque, state = controller.step(observation, state)
        driven.append(bool((torque[0] == np.float32([0.0, 0.7])).all()))
    turns = [False] * 4 + [True] * 2 + [True] * 9 + [False] * 3 + [True] + [False] * 3 + [True]
    assert driven == turns


class Northward(Planner):
    """Goes north."""

    def initial_memory(self, batch):
        return ()

    def decide(self, abstract_state, memory):
        return np.full(len(abstract_state), int(Instruction.NORTH)), memory


class OnceMore(Scout):
    """Wants a second look."""

    wanted = True

    def step(self, abstract_state, shown):
        wanted, self.wanted = self.wanted, False
        return Instruction.STAY if wanted else None


def test_a_look_after_a_walk_begins_when_the_robot_has_come_to_rest():
    planner = LookAroundPlanner(Northward(), 5, scout=OnceMore())
    now, instructions = planner.initial_state(np.zeros(1, np.int64)), []
    for tick in range(15):
        # The first look ends with tick 5, in which the robot is told to stay for another; it rests from tick 9 on.
        terminated = np.array([tick < 6 or tick > 8])
        instruction, now = planner.step(estimate(*ROOM)[None], terminated, now)
        instructions.append(int(instruction[0]))
    assert instructions == [Instruction.STAY] * 14 + [Instruction.NORTH]


@pytest.mark.parametrize(("direction", "room", "behind"), [(3, True, False), (1, False, True)])
def test_a_robot_has_seen_what_lies_ahead_of_where_it_walked(direction, room, behind):
    state = estimate(*(row.replace("@", " ") for row in ROOM))
    state[4, 3, AGENT] = 1.0
    seen = walk_view(state, Instruction(direction))
    assert seen[5:7, 3].all() == room and seen[1:4, 3].all() == behind


def test_no_second_look_at_what_was_in_view_on_a_walk():
    class Wanderer(Scout):
        """Walks east once, and notes what it is told was in view."""

        told: list = []  # noqa: RUF012

        def step(self, abstract_state, shown):
            self.told.append(shown.copy())
            return Instruction.EAST if len(self.told) == 1 else None

    scout, state = Wanderer(), estimate(*ROOM)
    planner = LookAroundPlanner(Northward(), 1, scout=scout)
    now = planner.initial_state(np.zeros(1, np.int64))
    for _ in range(4):
        _, now = planner.step(state[None], np.array([True]), now)
    turned, walked = scout.told[:2]
    assert (walked == turned | walk_view(state, Instruction.EAST)).all()


def test_looks_come_to_an_end():
    planner = LookAroundPlanner(OraclePlanner(), 2, walks=5)
    state = estimate(*ROOM)[None]
    state[0, 1, 1, BOX] = 0.0
    now = planner.initial_state(np.zeros(1, np.int64))
    instructions = []
    for _ in range(12):
        instruction, now = planner.step(state, np.array([True]), now)
        instructions.append(int(instruction[0]))
    assert instructions[:2] == [0, 0]
    assert now.memory[-3][0] == 0


def test_a_body_that_no_single_action_turns_is_told_to_stay_and_its_controller_has_to_turn_it():
    controller = OracleController()
    assert look_around(controller, 30, body=ANT) is controller
    planner = look_around(OraclePlanner(), 30, body=ANT)
    now, instructions = planner.initial_state(np.zeros(1, np.int64)), []
    for _ in range(32):
        instruction, now = planner.step(estimate(*ROOM)[None], np.array([True]), now)
        instructions.append(int(instruction[0]))
    assert not any(instructions[:30]) and any(instructions[30:])


def test_each_body_looks_around_for_as_long_as_it_takes_to_turn():
    assert [Stack(body=body.name).look_around_ticks for body in BODIES.values()] == [
        body.look_ticks for body in BODIES.values()
    ]
    assert Stack({"estimator": Choice("estimator", "oracle")}).look_around_ticks == 0


def test_who_finds_its_heading_by_sight_looks_around_though_its_estimator_is_the_oracle(tmp_path):
    seeing, told = tmp_path / "controller.safetensors", tmp_path / "teacher.safetensors"
    for path, network in (
        (seeing, VisuomotorController("ant", (8, 8), 8, 8)), (told, PrivilegedPolicy("ant", width=8)),
    ):  # fmt: skip
        save_weights(path, network, network.config, {})
    for weights, expected in ((seeing, ANT.look_ticks), (told, 0)):
        choices = {"estimator": Choice("estimator", "oracle"), "controller": Choice("controller", weights=weights)}
        assert Stack(choices, body="ant").look_around_ticks == expected


def test_a_negative_time_is_refused():
    with pytest.raises(ValueError, match="look_around -1: expected a number of ticks"):
        look_around(OraclePlanner(), -1)
