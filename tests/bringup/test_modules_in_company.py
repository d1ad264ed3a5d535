"""Modules that share a process, and with it what they are given."""

import pytest
from scribblers import SEEN

from bringup.command import Choice, Stack
from bringup.rollout import ticks
from mujoban_sim.world import World
from mujoban_sokoban.episodes import Episodes


@pytest.fixture
def stacks(oracles):
    """Two stacks with a controller that notes what it is given: an estimator that leaves it as it is, and one not."""
    controller = Choice("controller", "scribblers:Noting")
    return [
        Stack(oracles.choices | {"estimator": Choice("estimator", name), "controller": controller}, look_around=0)
        for name in ("oracle", "scribblers:Scribbling")
    ]


EPISODES = Episodes(1, 0, difficulty=1)


@pytest.mark.parametrize("handed", [True, False])
def test_what_a_module_writes_into_its_inputs_no_other_sees(play_graph, stacks, handed):
    said = []
    for stack in stacks:
        SEEN.clear()
        graph = play_graph(stack, EPISODES, time_limit=8, intra_process=handed)
        graph.finish()
        said.append(([*SEEN], graph.said.torque))
        graph.__exit__(None, None, None)
    assert len(said[0][0]) == 8
    assert said[0] == said[1]


def test_nor_does_it_in_a_rollout(stacks):
    said = []
    for stack in stacks:
        SEEN.clear()
        played = ticks(stack.policy(), World(1, time_limit=8), EPISODES, camera=True)
        frames = [tick.observation.frame.tolist() for tick in played]
        said.append(([*SEEN], frames))
    assert len(said[0][0]) == 8
    assert said[0] == said[1]
