"""What the simulator hands over is what the readers of its messages make of them."""

import numpy as np
import pytest

from mujoban_core.bodies import get_body
from mujoban_core.interfaces import GroundTruth, Observation
from mujoban_msgs_py.adapted import Adapted
from mujoban_msgs_py.checks import ConversionError
from mujoban_msgs_py.decoders import DECODERS
from mujoban_msgs_py.topics import POSE, PROPRIO
from mujoban_sim.tick_messages import EpisodeProgress, SimulatorTick, TickComposer, TickLabel
from mujoban_sim.world import World
from mujoban_sokoban.episodes import Episodes


@pytest.fixture(scope="module", params=["ball", "ant"])
def played(request):
    """Return the composer of a body, and some ticks of a robot that drives about."""
    episodes, rng = Episodes(1, 3, difficulty=3), np.random.default_rng(0)
    world = World(1, body=request.param, max_boxes=episodes.max_boxes)
    world.reset([0], [episodes[0]])
    ticks = []
    for step in range(1, 60):
        world.step(rng.uniform(-1, 1, (1, world.body.action_size)).astype(np.float32))
        observation = Observation(world.render().copy(), world.proprio.copy(), world.pose.copy())
        truth = GroundTruth(
            world.abstract_state().copy(), world.pose.copy(), world.velocity.copy(), world.box_position.copy(),
            world.completed.copy(),
        )  # fmt: skip
        progress = EpisodeProgress(episodes[0], step, np.float64(-0.1), -0.1 * step, False, False)
        ticks.append(SimulatorTick(TickLabel(step * 50_000_000, 1, 3, 0), progress, observation, truth, 0))
    world.close()
    return TickComposer(get_body(request.param)), ticks


def assert_same(read, value):
    """Assert that two values are of one type and equal to the bit."""
    assert type(read) is type(value)
    if isinstance(read, np.ndarray):
        assert (read.dtype, read.shape) == (value.dtype, value.shape)
        assert read.tobytes() == value.tobytes()
    else:
        assert [(type(part), part) for part in read] == [(type(part), part) for part in value]


def test_a_value_that_is_handed_over_is_to_the_bit_what_its_message_says(played):
    composer, ticks = played
    adapted = set()
    for tick in ticks:
        for topic in composer.topics:
            said = composer.say(topic, tick)
            if isinstance(said, Adapted):
                adapted.add(topic.name)
                assert_same(DECODERS[topic](composer.compose(topic, tick)), said.value)
                assert said.stamp == tick.label.stamp
    readings = {"/ground_truth/episode", "/ground_truth/termination"}
    assert {"/camera/image_raw", "/proprio", "/pose", "/ground_truth/abstract_state"} | readings <= adapted


def test_a_value_that_is_handed_over_does_not_change_with_the_world(played):
    composer, ticks = played
    for topic in composer.topics:
        said = composer.say(topic, ticks[0])
        if isinstance(said, Adapted):
            arrays = (*ticks[0].observation, *ticks[0].truth)
            shared = isinstance(said.value, np.ndarray) and any(np.shares_memory(said.value, a) for a in arrays)
            assert not shared, topic.name


@pytest.mark.parametrize("where", ["proprio", "pose"])
def test_a_robot_that_is_nowhere_is_not_said_to_be_anywhere(played, where):
    composer, (tick, *_) = played
    astray = getattr(tick.observation, where).copy()
    astray[0, 0] = np.nan
    tick = tick._replace(observation=tick.observation._replace(**{where: astray}))
    with pytest.raises(ConversionError, match=f"{where} must be finite"):
        composer.say(PROPRIO if where == "proprio" else POSE, tick)
