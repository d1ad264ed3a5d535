import pytest
from hypothesis import given
from hypothesis import strategies as st

from mujoban_msgs_py.synchroniser import Synchroniser


def test_hands_over_a_tick_once_its_last_item_arrives():
    join = Synchroniser(["a", "b"])
    assert join.add("a", 1, "a1") is None
    assert join.add("b", 1, "b1") == {"a": "a1", "b": "b1"}
    assert len(join) == 0 and not join.dropped


def test_never_joins_different_stamps():
    join = Synchroniser(["a", "b"])
    assert join.add("a", 1, "a1") is None
    assert join.add("b", 2, "b2") is None


def test_drops_and_counts_ticks_older_than_a_complete_one():
    join = Synchroniser(["a", "b"])
    join.add("a", 1, "a1")
    join.add("a", 2, "a2")
    assert join.add("b", 2, "b2") is not None
    assert join.dropped == {"a": 1}


def test_a_repeated_item_replaces_the_first():
    join = Synchroniser(["a", "b"])
    join.add("a", 1, "old")
    join.add("a", 1, "new")
    assert join.add("b", 1, "b") == {"a": "new", "b": "b"}
    assert not join.dropped


def test_goes_on_after_time_jumped_back():
    join = Synchroniser(["a", "b"], depth=2)
    for stamp in (100, 101):
        join.add("a", stamp, "before the jump")
    for stamp in (1, 2, 3):
        join.add("a", stamp, stamp)
        assert join.add("b", stamp, stamp) == {"a": stamp, "b": stamp}


@given(st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 20)), max_size=200), st.integers(1, 5))
def test_memory_is_bounded_and_every_item_is_handed_over_or_counted(items, depth):
    join = Synchroniser("abc", depth)
    handed, replaced = 0, 0
    held: set[tuple[str, int]] = set()
    for topic, stamp in items:
        before = sum(join.dropped.values())
        size = sum(len(v) for v in join._unfinished.values())
        complete = join.add(topic, stamp, None)
        handed += 3 if complete else 0
        now = sum(len(v) for v in join._unfinished.values())
        replaced += 1 - (now - size + (3 if complete else 0) + sum(join.dropped.values()) - before)
        assert len(join) <= depth
        held.add((topic, stamp))
    join.clear()
    assert handed + replaced + sum(join.dropped.values()) == len(items)


def test_refuses_an_unknown_topic_and_senseless_settings():
    with pytest.raises(KeyError, match="expected one of a, b"):
        Synchroniser(["a", "b"]).add("c", 1, None)
    with pytest.raises(ValueError, match="distinct"):
        Synchroniser(["a", "a"])
    with pytest.raises(ValueError, match="at least 1"):
        Synchroniser(["a"], depth=0)
