"""What the commands print, on a terminal of 60 columns and in a pipe."""

import io
import re

import numpy as np
import pytest
from rich.console import Console

from bringup.monitor import Watched
from bringup.pipeline import Pipeline, Stage
from bringup.progress import EpisodesBar, SolvedBar
from bringup.results import EpisodeResult, Failure
from bringup.training_display import Display
from bringup.view import live_view, summary
from mujoban_msgs_py import topics
from mujoban_msgs_py.conversions import EpisodeTruthReading, InstructionReading, TerminationReading
from mujoban_sokoban.levels import Level

SOLVED = EpisodeResult(3, True, 11.0, 50, 4, 0, 0, None)
LOST = EpisodeResult(1_000_000_007, False, -120.0, 2400, 128, 12, 34, Failure.CONTROLLER_TIME_OUT)
EPISODE = EpisodeTruthReading(
    3, LOST.seed, 5, level="", step=1234, reward=-0.1, episode_return=-12.0, solved=False, terminated=False,
    truncated=False, boxes_on_target=0,
)  # fmt: skip


def printed(what, width):
    console = Console(file=io.StringIO(), width=width)
    console.print(what)
    lines = console.file.getvalue().splitlines()
    assert max(map(len, lines)) <= width and not any("…" in line for line in lines)
    return lines


def drawn(console):
    """Return the last line that a terminal shows."""
    return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", console.file.getvalue()).rstrip().splitlines()[-1]


@pytest.mark.parametrize("width", [60, 80])
def test_the_table_of_episodes_shows_every_number_whole(width):
    lines = printed(summary([SOLVED, LOST]), width)
    assert any(line.split() == ["3", "solved", "+11", "50", "4", "0", "0"] for line in lines)
    (lost,) = [line.split() for line in lines if "1000000007" in line]
    assert lost[-5:] == ["-120", "2400", "128", "12", "34"]
    assert "controller" in lost or "controller" in "".join(lines)


@pytest.mark.parametrize("width", [60, 80])
def test_of_an_agent_without_modules_the_live_view_shows_torques_and_the_truth(width):
    state = Level.from_text("######\n#+$*.#\n#   $#\n######\n").abstract_state()
    values = {topics.TORQUE.name: np.array([0.25, -1.0], np.float32), topics.TRUE_ABSTRACT_STATE.name: state}
    text = " ".join(printed(live_view(EPISODE, Watched(values), [], {"agent": "random"}, width=width), width))
    assert "+0.25 -1.00" in text and "ground truth" in text
    assert "estimate" not in text and "instruction" not in text and "termination" not in text


@pytest.mark.parametrize("width", [60, 80])
def test_the_live_view_fits_the_width_with_both_maps_side_by_side(width):
    state = Level.from_text("######\n#+$*.#\n#   $#\n######\n").abstract_state()
    tick = Watched(
        {
            topics.INSTRUCTION.name: InstructionReading(sequence=17, direction=1),
            topics.TERMINATION.name: TerminationReading(1, 0.31, False, False),
            topics.ABSTRACT_STATE.name: state, topics.TRUE_ABSTRACT_STATE.name: state,
        }
    )  # fmt: skip
    roles = ("estimator", "termination", "planner", "controller")
    lines = printed(live_view(EPISODE, tick, [SOLVED], dict.fromkeys(roles, "oracle"), width=width), width)
    assert len(lines) < 24, "with the prompt it fits a terminal of 24 lines"
    assert any("estimate" in line and "ground truth" in line for line in lines)
    text = " ".join(" ".join(lines).replace("│", " ").split())
    for fact in ("number 17", "seed 1000000007", "step 1234", "solved 1 of 1", "p = 0.31", ", ".join(roles)):
        assert fact in text


def test_a_terminal_of_60_columns_shows_how_many_episodes_have_ended():
    console = Console(file=io.StringIO(), force_terminal=True, width=60, color_system=None)
    with SolvedBar(100_000, console) as bar:
        bar.show([SOLVED, LOST])
    line = drawn(console)
    assert re.fullmatch(r"ended, 50\.0 % solved [━╸ ]+ 2/100000 0:00:0\d", line) and len(line) <= 60


def test_a_pipe_gets_a_line_whenever_another_tenth_of_the_episodes_has_ended():
    console = Console(file=io.StringIO(), width=60)
    with SolvedBar(20, console) as bar:
        for ended in range(21):
            bar.show([SOLVED] * ended)
    lines = console.file.getvalue().splitlines()
    assert len(lines) == 10 and lines[0] == "2 of 20 episodes ended, 100.0 % solved"
    with EpisodesBar(25, console) as bar:
        for ended in (0, 24, 24, 25):
            bar.reach(ended, "recorded")
    assert console.file.getvalue().splitlines()[10:] == ["24 of 25 episodes recorded", "25 of 25 episodes recorded"]


def test_a_pipe_is_told_of_every_tenth_of_a_stage_and_rarely_once_its_time_is_over(tmp_path, monkeypatch):
    pipeline = Pipeline(tmp_path, [Stage("planner", (), (tmp_path / "made",), seconds=600.0)])
    monkeypatch.setattr(pipeline, "running", lambda: ["planner"])
    pipe = Console(file=io.StringIO(), width=60)
    with (display := Display(pipeline, pipe)).progress:
        for spent in range(0, 1500, 10):
            monkeypatch.setattr(pipeline, "elapsed", lambda name, spent=spent: float(spent))
            display.update(pipeline)
    told = [line.split(";")[0] for line in pipe.file.getvalue().splitlines()]
    assert told == [f"planner: {n} of about 10 min" for n in ("0 s", *(f"{m} min" for m in (*range(1, 11), 20)))]


def test_stages_are_told_as_they_begin_and_end_in_a_pipe_and_fit_60_columns_of_a_terminal(tmp_path):
    product = tmp_path / "made"
    stages = [
        Stage("controller_distil", ("-c", f"open({str(product)!r}, 'w')"), (product,), seconds=720.0),
        Stage("planner_views", (), (), needs=("controller_distil",)),
    ]
    pipeline = Pipeline(tmp_path, stages[:1])
    pipe = Console(file=io.StringIO(), width=60)
    display = Display(pipeline, pipe)
    with display.progress:
        pipeline.run(display.update)
        display.update(pipeline)
    begun, ended = pipe.file.getvalue().splitlines()
    assert re.fullmatch(r"controller_distil: 0 s of about 12 min; all is expected to end on \w{3} \d\d:\d\d", begun)
    assert re.fullmatch(r"controller_distil: done in \d+ s", ended)
    terminal = Console(file=io.StringIO(), force_terminal=True, width=60, color_system=None)
    with (display := Display(Pipeline(tmp_path, stages), terminal)).progress:
        display.update(pipeline)
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", terminal.file.getvalue())
    assert re.search(r"controller_distil [━╸ ]+ done in \d+ s", text) and "…" not in text
    assert re.search(r"all +[━╸ ]+ expected to end on \w{3} \d\d:\d\d", text)
