"""Real time: said at once when it is not kept, at most once a window, and never of lockstep."""

from mujoban_msgs_py.runtime.pace import WINDOW, Pace


def play(pace, start, rate, late=0.0):
    pace.start(start)
    for tick in range(round(rate * WINDOW)):
        pace.tick(late=tick < late * rate * WINDOW)
    return pace.complaint(start + WINDOW)


def test_a_slow_world_and_late_answers_are_complained_about_while_they_happen():
    pace = Pace(2.0)
    assert play(pace, 0.0, 40) is None and pace.kept
    assert "12.0 of 40.0 ticks/s" in play(pace, 10.0, 12) and not pace.kept
    assert "30 % of the answers late" in play(pace, 20.0, 40, late=0.3)
    assert pace.complaint(21.0) is None, "once a window"
    assert play(pace, 30.0, 40) is None and pace.kept


def test_lockstep_keeps_to_no_clock():
    assert play(Pace(0.0), 0.0, 1) is None
