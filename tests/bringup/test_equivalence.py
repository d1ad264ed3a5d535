"""The lockstep graph and the rollout in process are one policy: same instructions, torques and rewards, exactly."""

from collections import defaultdict
from functools import partial

import numpy as np
import pytest
from rclpy.node import Node

from bringup.command import Choice, Stack
from bringup.rollout import ticks
from mujoban_msgs_py import topics
from mujoban_msgs_py.conversions import stamp_of
from mujoban_msgs_py.topics import TICK
from mujoban_planner.deliberation import Deliberation
from mujoban_sim.world import World
from mujoban_sokoban.episodes import Episodes


def rolled_out(stack, episodes, time_limit):
    """Return per tick (sequence, direction), torque and reward of the rollout with batch 1."""
    world = World(1, body=stack.body, max_boxes=episodes.max_boxes, time_limit=time_limit)
    return [
        (
            (int(t.decision.sequence[0]), int(t.decision.instruction[0])),
            t.decision.torque[0].tolist(),
            float(t.reward[0]),
            bool(t.solved[0] | t.truncated[0]),
        )
        for t in ticks(stack.policy(), world, episodes)
    ]


def assert_equal_runs(play_graph, stack, episodes, time_limit, **options):
    expected = rolled_out(stack, episodes, time_limit)
    graph = play_graph(stack, episodes, time_limit=time_limit, **options)
    graph.finish()
    said, stamp = graph.said, 0
    for instruction, torque, reward, ended in expected:
        stamp += TICK
        assert said.instruction[stamp] == instruction
        assert said.torque[stamp] == torque
        assert said.reward[stamp + TICK] == reward
        stamp += TICK * ended  # an episode's last observation is a tick of its own
    assert len(said.torque) == len(expected)


@pytest.mark.parametrize("handed", [True, False])
def test_oracles_do_the_same_in_the_graph_as_in_process(play_graph, oracles, handed):
    assert_equal_runs(play_graph, oracles, Episodes(2, 3, difficulty=2), 400, intra_process=handed)


@pytest.mark.parametrize("handed", [True, False])
def test_networks_do_the_same_in_the_graph_as_in_process(play_graph, fresh_weights, handed):
    stack = Stack(fresh_weights.choices, look_around=10)
    assert_equal_runs(play_graph, stack, Episodes(2, 5, difficulty=3), 40, intra_process=handed)


def test_who_listens_for_a_while_from_outside_hears_all_of_it_and_changes_nothing(play_graph, fresh_weights):
    stack, episodes = Stack(fresh_weights.choices, look_around=5), Episodes(1, 9, difficulty=2)
    heard = defaultdict(list)
    undisturbed = play_graph(stack, episodes, time_limit=60)
    undisturbed.finish()
    undisturbed.__exit__(None, None, None)
    graph = play_graph(stack, episodes, time_limit=60)
    graph.spin_until(lambda: len(graph.said.torque) >= 10)
    stranger = graph.graph.add(Node("stranger"))
    for topic in topics.MODULE_TOPICS:
        note = partial(lambda name, message: heard[name].append(stamp_of(message) // TICK), topic.name)
        stranger.create_subscription(topic.type, topic.name, note, topic.qos)
    graph.spin_until(lambda: len(graph.said.torque) >= 40)
    graph.graph.end(stranger)
    graph.finish()
    assert (graph.said.instruction, graph.said.torque) == (undisturbed.said.instruction, undisturbed.said.torque)
    assert graph.said.estimate == undisturbed.said.estimate and graph.said.reward == undisturbed.said.reward
    for name in (topic.name for topic in topics.MODULE_TOPICS):
        assert heard[name] == [*range(heard[name][0], heard[name][-1] + 1)] and heard[name][-1] - heard[name][0] > 20


@pytest.mark.parametrize("role", ["estimator", "termination", "controller"])
def test_one_network_among_oracles_does_the_same(play_graph, oracles, fresh_weights, role):
    stack = Stack(oracles.choices | {role: fresh_weights.choices[role]}, look_around=5)
    assert_equal_runs(play_graph, stack, Episodes(1, 7, difficulty=1), 25)


def test_an_ant_does_the_same_in_the_graph_as_in_process(play_graph, oracles, ant_teacher):
    stack = Stack(oracles.choices | {"controller": Choice("controller", weights=ant_teacher)}, body="ant")
    assert_equal_runs(play_graph, stack, Episodes(1, 3, difficulty=1), 30)


def test_the_ant_that_ships_sees_and_does_the_same_in_the_graph_as_in_process(play_graph):
    # It looks around, is told to go at tick 10 and, having come there, once more at 48.
    assert_equal_runs(play_graph, Stack(body="ant", look_around=10), Episodes(1, 5_000_003, difficulty=1), 55)


def test_a_planner_that_looks_ahead_while_the_robot_moves_does_the_same(play_graph, oracles):
    thinking = Deliberation(thinking=2, look_ahead=30, per_tick=3)
    stack = Stack(oracles.choices | {"planner": Choice("planner")}, deliberation=thinking)
    assert_equal_runs(play_graph, stack, Episodes(1, 7, difficulty=1), 60)


def test_two_runs_of_the_graph_are_equal(play_graph, fresh_weights):
    runs = []
    for _ in range(2):
        graph = play_graph(Stack(fresh_weights.choices, look_around=5), Episodes(1, 9, difficulty=2), time_limit=20)
        graph.finish()
        runs.append((graph.said.instruction, graph.said.torque, graph.said.reward))
        graph.__exit__(None, None, None)
    assert runs[0] == runs[1]
    assert np.isfinite([t for torque in runs[0][1].values() for t in torque]).all()


def test_a_class_of_ones_own_plays_a_role(play_graph, oracles):
    stack = Stack(oracles.choices | {"planner": Choice("planner", "mujoban_sim.oracles:OraclePlanner")})
    (result,) = play_graph(stack, Episodes(1, 0, difficulty=1)).finish()
    assert result.solved
