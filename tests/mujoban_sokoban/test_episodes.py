"""Episodes of a run: made when they are asked for, and forgotten when nobody plays them any more."""

import gc
import pickle
import weakref

from mujoban_sokoban.episodes import Episodes
from mujoban_sokoban.generator import PLAY_SEEDS, VALIDATION_SEEDS, generate_level
from mujoban_sokoban.levels import write_levels


def test_an_episode_is_kept_while_somebody_plays_it_and_no_longer():
    episodes = Episodes(1_000_000, 5_000_000, difficulty=1)
    played = episodes[3]
    assert episodes[3] is played
    forgotten = weakref.ref(played)
    del played
    gc.collect()
    assert forgotten() is None, "a run of many episodes keeps all of them"
    assert episodes[3].level.to_text() == Episodes(4, 5_000_000, difficulty=1)[3].level.to_text()


def test_without_a_seed_levels_are_none_of_those_for_tests_and_a_file_is_played_from_its_first(tmp_path):
    assert Episodes(1, None).seed in PLAY_SEEDS and set(PLAY_SEEDS) < set(VALIDATION_SEEDS)
    levels = [generate_level(1, seed) for seed in VALIDATION_SEEDS[:3]]
    write_levels(tmp_path / "levels.txt", levels)
    filed = Episodes(None, None, level_file=tmp_path / "levels.txt")
    assert [episode.level.to_text() for episode in filed] == [level.to_text() for level in levels]
    first = Episodes(1, None, level_file=tmp_path / "levels.txt", seeds=VALIDATION_SEEDS)
    assert first.seed in VALIDATION_SEEDS and first[0].level.to_text() == levels[0].to_text()


def test_a_copy_for_another_process_has_the_same_episodes():
    episodes = Episodes(8, 5_000_000, difficulty=2)
    played = episodes[5]
    copy = pickle.loads(pickle.dumps(episodes))
    assert len(copy) == 8 and copy[5].seed == played.seed
    assert copy[5].level.to_text() == played.level.to_text()
