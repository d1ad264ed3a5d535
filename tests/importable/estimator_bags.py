"""Made-up episodes, recorded and not, for tests of what learns from bags."""

import numpy as np

from bringup.record import MixedEpisodes
from bringup.rollout import Ending, Tick
from bringup.rollout_recorder import TOPICS as RECORDED
from mujoban_core.bodies import BALL
from mujoban_core.interfaces import GroundTruth, Observation, TerminationOutput
from mujoban_core.sense_plan_act import Decision
from mujoban_estimator.data import Stretch
from mujoban_msgs_py.bags import BagWriter
from mujoban_sokoban.generator import TRAIN_SEEDS

SEED = TRAIN_SEEDS.start
LENGTHS = (7, 12)
"""Ticks of the recorded episodes."""


def made_up_ticks(episodes, lengths=LENGTHS):
    """Ticks of one row whose frame, pose and so on tell which tick of which episode they are."""
    for index, length in enumerate(lengths):
        spec = episodes[index]
        for step in range(length):
            mark = 20 * index + step
            state = spec.level.abstract_state()[None]
            pose = np.array([[0.01 * mark, 0.5, 0.1]], np.float32)
            boxes = np.zeros((1, 4, 2), np.float32)
            issued = np.array([step % 4 == 0])
            frame = np.full((1, 64, 64, 3), mark, np.uint8)
            observation = Observation(frame, np.full((1, BALL.proprio_size), mark, np.float32), pose)
            truth = GroundTruth(state, pose, np.zeros((1, 3), np.float32), boxes, np.array([step % 4 == 3]))
            yield Tick(
                np.array([0]), np.array([index]), np.array([step]), observation, truth,
                Decision(
                    state, TerminationOutput(np.array([0.25], np.float32), issued & (step > 0), np.array([False])),
                    np.array([1 + step // 4]), np.array([1 + step // 4]), issued, np.zeros((1, 2), np.float32),
                ),
                np.zeros(1, np.float32), np.zeros(1, np.float32),
                np.array([False]), np.array([step == length - 1]),
                Ending(observation, truth) if step == length - 1 else None,
            )  # fmt: skip


def copy_without(bag, path, drop):
    """Copy the messages of a bag for which `drop(topic, stamp)` is false."""
    names = [t for t in RECORDED if not drop(t.name, None)]
    with BagWriter(path, names) as writer:
        for message in bag.messages():
            if not drop(message.topic, None) and not drop(message.topic, message.stamp):
                writer.write(message.topic, message.stamp, message.data)


def stretch(ticks, *, first=True, terminated=(), completed=(), body=BALL):
    rng = np.random.default_rng(ticks)
    state = MixedEpisodes(1, SEED, [1])[0].level.abstract_state()
    flags = np.arange(ticks)
    return Stretch(
        rng.integers(0, 256, (ticks, 64, 64, 3), dtype=np.uint8),
        np.tile(np.float32([-0.5, 0.5, 0.0]), (ticks, 1)),
        np.tile(upright(body), (ticks, 1)),
        np.ones(ticks, np.int64),
        np.isin(flags, terminated),
        np.isin(flags, completed),
        np.repeat(state[None], ticks, 0),
        first,
    )


def upright(body):
    proprio = np.zeros(body.proprio_size, np.float32)
    proprio[body.proprio.up_axis] = (0.0, 0.0, 1.0)
    return proprio
