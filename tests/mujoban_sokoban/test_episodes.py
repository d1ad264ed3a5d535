"""Episodes of a run: made when they are asked for, and forgotten when nobody plays them any more."""

import gc
import pickle
import weakref

from mujoban_sokoban.episodes import Episodes


def test_an_episode_is_kept_while_somebody_plays_it_and_no_longer():
    episodes = Episodes(1_000_000, 5_000_000, difficulty=1)
    played = episodes[3]
    assert episodes[3] is played
    forgotten = weakref.ref(played)
    del played
    gc.collect()
    assert forgotten() is None, "a run of many episodes keeps all of them"
    assert episodes[3].level.to_text() == Episodes(4, 5_000_000, difficulty=1)[3].level.to_text()


def test_a_copy_for_another_process_has_the_same_episodes():
    episodes = Episodes(8, 5_000_000, difficulty=2)
    played = episodes[5]
    copy = pickle.loads(pickle.dumps(episodes))
    assert len(copy) == 8 and copy[5].seed == played.seed
    assert copy[5].level.to_text() == played.level.to_text()
