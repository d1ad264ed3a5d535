"""Real time: said at once when it is not kept, at most once a window, and never of lockstep."""

from mujoban_msgs_py.runtime.pace import WINDOW, Pace
from mujoban_msgs_py.topics import TICK


def play(pace, start, rate, late=0.0):
    pace.start(start)
    for tick in range(round(rate * WINDOW)):
        pace.tick(late=tick < late * rate * WINDOW)
    return pace.complaint(start + WINDOW)


def test_a_slow_world_and_late_answers_are_complained_about_while_they_happen():
    pace = Pace(2.0, patience=0.2, hold=2)
    assert play(pace, 0.0, 40) is None and pace.kept
    assert "12.0 of 40.0 ticks/s" in play(pace, 10.0, 12) and not pace.kept
    assert "30 % of the answers late" in play(pace, 20.0, 40, late=0.3)
    assert pace.complaint(21.0) is None, "once a window"
    assert play(pace, 30.0, 40) is None and pace.kept


def test_lockstep_keeps_to_no_clock():
    assert play(Pace(0.0, patience=0.2, hold=2), 0.0, 1) is None


def test_the_clock_runs_while_answers_come_to_whatever_tick_and_waits_for_an_answer_once_they_do_not():
    pace = Pace(1.0, patience=0.2, hold=2)
    assert not pace.falls_silent(9.0, answered=False) and not pace.running, "it starts with an answer"
    assert not pace.falls_silent(10.0, answered=True) and pace.running
    pace.hear(TICK, 10.15)
    assert not pace.falls_silent(10.3, answered=False) and pace.running, "an answer to an earlier tick came"
    assert pace.falls_silent(10.4, answered=False) and not pace.running and not pace.kept
    assert not pace.falls_silent(10.5, answered=False), "said once"
    pace.hear(2 * TICK, 10.55)
    assert not pace.falls_silent(10.6, answered=False) and not pace.running, "it was to another tick"
    assert not pace.falls_silent(10.7, answered=True) and pace.running
    assert pace.complaint(10.8) is None, "the time without a clock counts as time that was not kept"


def test_how_long_answers_take_is_told_of_each_tick_once_also_of_those_that_come_late():
    pace = Pace(1.0, patience=0.2, hold=2)
    assert pace.answer_ms(99) == 0.0
    for tick, offered, heard in ((1, 0.0, 0.01), (1, 0.0, 0.9), (2, 0.05, 0.08), (3, 0.1, None), (4, 0.15, 0.26)):
        if heard != 0.9:  # a repeated answer to the first
            pace.offer(tick * TICK, offered)
        if heard is not None:
            pace.hear(tick * TICK, heard)
    assert [round(pace.answer_ms(percentile)) for percentile in (0, 50, 100)] == [10, 30, 110]


def test_the_clock_goes_ahead_of_the_answers_by_as_many_ticks_as_a_torque_is_held():
    pace = Pace(1.0, patience=0.2, hold=2)
    pace.hear(10 * TICK, 0.0)
    pace.hear(9 * TICK, 0.1)
    assert [pace.outruns(tick * TICK) for tick in (10, 11, 12, 13)] == [False, False, False, True]
