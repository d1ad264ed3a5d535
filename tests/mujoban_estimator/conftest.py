"""What tests of the senses share: a bag of two short episodes."""

import pytest
from estimator_bags import LENGTHS, SEED, made_up_ticks

from bringup.record import MixedEpisodes
from bringup.rollout_recorder import Recorder
from mujoban_core.bodies import BALL


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    path = tmp_path_factory.mktemp("bags")
    episodes = MixedEpisodes(len(LENGTHS), SEED, [1])
    with Recorder(path, BALL, episodes, [1, 1]) as recorder:
        for tick in made_up_ticks(episodes):
            recorder.write(tick)
    return path
