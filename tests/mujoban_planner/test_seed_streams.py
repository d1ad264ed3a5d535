import pytest

from mujoban_planner.moves import LevelStream
from mujoban_planner.seed_streams import LESSONS, LEVELS, MOVES, first_seed
from mujoban_sokoban.generator import TRAIN_SEEDS


def test_streams_of_all_kinds_and_runs_share_no_level():
    ends = []
    for streams in (LESSONS, MOVES, LEVELS):
        first, second, last = (first_seed(streams, number) for number in (0, 1, len(streams) - 1))
        ends += [first, last + second - first]
    assert ends == sorted(ends) and ends[0] in TRAIN_SEEDS and ends[-1] - 1 in TRAIN_SEEDS


def test_a_seed_beyond_those_of_its_kind_is_refused():
    with pytest.raises(ValueError, match="stream 100000: expected 0 to 99999, those of the seeds 0 to 99 of runs"):
        LevelStream({5: 1.0}, seed=100)
