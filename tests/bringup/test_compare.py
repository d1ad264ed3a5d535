"""Two reports of the same levels, compared level by level."""

import json
import re

import pytest

from bringup import compare


class FakeLevel(str):
    """A level that is told apart by its text."""

    def to_text(self):
        return str(self)


def report(path, solved, first=0, weights=None, **played):
    episodes = [{"seed": first + i, "solved": bool(s)} for i, s in enumerate(solved)]
    said = {"episodes": episodes, "played": {"difficulty": 3, "seed": first, **played}, "weights": weights}
    path.write_text(json.dumps({name: value for name, value in said.items() if value is not None}))
    return str(path)


def said(capsys, *reports):
    assert compare.main(reports) == 0
    return capsys.readouterr().out.splitlines()


def test_levels_that_only_one_solved_tell_two_reports_apart(tmp_path, capsys):
    ours = report(tmp_path / "a.json", [1, 1, 0, 0, 1, 1])
    theirs = report(tmp_path / "b.json", [1, 1, 1, 1, 0])
    common, alone, difference = said(capsys, ours, theirs)
    assert common == "5 levels in common: the first solved 60.0 %, the second 80.0 %"
    assert alone == "the first alone solved 1 (seeds 4), the second alone 2 (seeds 2, 3)"
    expected = r"the second less the first: \+20\.0 points \(95 % interval -.* to \+.*\); sign test p = 1"
    assert re.fullmatch(expected, difference)


def test_copies_of_a_level_are_one_draw(tmp_path, capsys, monkeypatch):
    interval = r"95 % interval ([-+.\d]+) to ([-+.\d]+)\)(.*)"
    solved = [0, 0, 1, 0, 0, 0] * 2, [1, 1, 1, 0, 0, 0] * 2
    reports = [report(tmp_path / f"{i}.json", outcomes) for i, outcomes in enumerate(solved)]
    low, high, told = re.search(interval, said(capsys, *reports)[-1]).groups()
    monkeypatch.setattr(compare, "generate_level", lambda difficulty, seed: FakeLevel(str(seed // 2)))
    wider_low, wider_high, copies = re.search(interval, said(capsys, *reports)[-1]).groups()
    assert float(wider_low) < float(low) < float(high) < float(wider_high)
    assert "sign test" in told
    assert copies == "; copies of a level are one draw, 6 are distinct"


def test_what_was_played_otherwise_is_named(tmp_path, capsys):
    ours = report(tmp_path / "a.json", [1, 0], look_ahead=400)
    theirs = report(tmp_path / "b.json", [1, 0], first=1, look_ahead=0)
    assert said(capsys, ours, theirs)[-1] == "played otherwise: look_ahead 400 and 0"


def test_who_is_told_the_ground_truth_is_named(tmp_path, capsys):
    learned = report(tmp_path / "a.json", [1, 0], weights={"planner": "1" * 64})
    cheating = report(tmp_path / "b.json", [1, 1], weights={"planner": "mine:Cheat (privileged)"})
    *_, last = said(capsys, learned, cheating)
    assert last == "the second is privileged, told the ground truth: planner: mine:Cheat"
    assert "ground truth" not in "".join(said(capsys, learned, learned))


def test_reports_of_other_levels_are_refused(tmp_path):
    ours = report(tmp_path / "a.json", [1, 0])
    for other in ({"difficulty": 4}, {"first": 100}, {"level_file_sha256": "0123"}):
        with pytest.raises(ValueError, match="no level in common"):
            compare.main([ours, report(tmp_path / "b.json", [1, 0], **other)])


NO_SOLVED = '{"episodes": [{"seed": 1}], "played": {}}'
NO_GAME = '{"episodes": [{"seed": 1, "solved": true}]}'


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"episodes": [3]}', NO_SOLVED, NO_GAME])
def test_what_is_no_report_is_named(tmp_path, content):
    (other := tmp_path / "other.json").write_text(content)
    with pytest.raises(ValueError, match=r"other\.json: no report with its episodes"):
        compare.main([report(tmp_path / "a.json", [1]), str(other)])
