"""What a cluster with many actors needs."""

from typing import Any

import pytest

from benchmarks.plan import Options, plan, report
from mujoban_core.program import exit_status, read_options


def test_twice_as_many_actors_deliver_twice_as_much_and_fill_the_replay_in_half_the_time() -> None:
    few, many = plan(Options().measured, 500), plan(Options().measured, 1000)
    assert many["frames_per_second"] == 2 * few["frames_per_second"]
    assert many["replay_seconds"] == few["replay_seconds"] / 2
    assert (few["machines"], many["machines"]) == (8, 16)


@pytest.mark.parametrize(
    ("option", "value", "said"),
    [
        ("--actors", "0", "--actors 0, expected a whole number from 1 on"),
        ("--frames-per-second", "0", "frames_per_second is 0.0: expected a number above 0"),
        ("--frames-per-sequence", "0", "frames_per_sequence is 0: expected at least 1"),
        ("--machine-cores", "-1", "machine_cores is -1: expected at least 1"),
        ("--updates-per-version", "nan", "updates_per_version is nan: expected a number above 0"),
    ],
)
def test_no_plan_is_made_of_what_is_no_amount(option: str, value: str, said: str, capsys: Any) -> None:
    assert exit_status("plan", lambda: bool(report(read_options(Options, [option, value], "plan")))) == 2
    assert said in capsys.readouterr().err
