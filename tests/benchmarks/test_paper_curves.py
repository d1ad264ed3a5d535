"""Learning curves and the figures of rates: what they are drawn from, and what they name."""

import json

import pytest
from paper_pages import write

from benchmarks.paper import curves, figures, runs
from mujoban_core.files import digest
from mujoban_core.plugins import ROLES, shipped_weights
from mujoban_planner import curves as planner_curves


def test_a_long_curve_is_thinned_to_means_that_weigh_instructions_alike(tmp_path):
    lines = [
        {"step": step, "instruction/move": float(step % 2), "instruction/move_n": 1 + 2 * (step % 2)}
        for step in range(120)
    ]
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    points = curves.read_curve("controller", [tmp_path])
    assert len(points) == 60 and {p["value"] for p in points} == {0.75}


def test_curves_join_runs_and_average_rates_by_their_counts(tmp_path):
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        lines = [
            {"step": step, "instruction/move": 1.0, "instruction/move_n": 1, "instruction/push": 0.5,
             "instruction/push_n": 3} for step in (10, 20)
        ]  # fmt: skip
        (tmp_path / name / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    points = curves.read_curve("controller", [tmp_path / "first", tmp_path / "second"])
    assert [(p["step"], p["value"]) for p in points] == [(10, 0.625), (20, 0.625), (30, 0.625), (40, 0.625)]
    curves.write(curves.Options(controller=(tmp_path / "first", tmp_path / "second"), variant="mpo", out=tmp_path))
    curves.write(curves.Options(controller=(tmp_path / "first",) * 2, variant="mpo", append=True, out=tmp_path))
    written = [json.loads(line)["step"] for line in (tmp_path / "curve_controller_mpo.jsonl").read_text().splitlines()]
    assert written == [10, 20, 30, 40, 50, 60, 70, 80]
    with pytest.raises(runs.ResultError, match="fewer than 3 points of evaluation/success_rate/5"):
        curves.read_curve("planner", [tmp_path / "first"])
    with pytest.raises(runs.ResultError, match=r"missing: no metrics\.jsonl, expected the run directory"):
        curves.read_curve("planner", [tmp_path / "missing"])


@pytest.fixture
def drawn(monkeypatch):
    monkeypatch.setattr(figures.plt, "close", lambda figure: None)
    yield lambda: [axes for axes in figures.plt.gcf().axes if axes.has_data()]
    monkeypatch.undo()
    figures.plt.close("all")


def words(axes):
    return [text.get_text() for text in axes.get_legend().get_texts()]


def test_figures_name_their_axes_their_bars_and_each_curve_in_words(folder, drawn):
    write(runs.CONFIGURATIONS[0], 3, 4, {role: digest(shipped_weights(role)) for role in ROLES})
    write(runs.POLICY_ALONE[0], 2, 4, {role: digest(shipped_weights(role)) for role in ROLES})
    assert figures.difficulty(runs.DIFFICULTY, runs.AHEAD, folder / "figure2.png")
    (axes,) = drawn()
    assert axes.get_legend().get_title().get_text() == "bars: 95 % intervals (Wilson)"
    _, alone, default = words(axes)
    assert alone.endswith("the planner's policy alone") and default.endswith(",\nthe default, with the search ahead")
    beside = ("planner", "planner_mpo", "estimator", "estimator_mpo")
    for name in ("controller", "controller_mpo", "controller_other_way", *beside):
        points = [{"step": 1000 * i, "value": i / 3, "what": "instructions completed"} for i in range(4)]
        (runs.JSON / f"curve_{name}.jsonl").write_text("".join(json.dumps(point) + "\n" for point in points))
    figures.curves(folder / "figure4.png")
    axes, *others = drawn()
    assert [words(other)[0] for other in others] == ["what ships", "what ships"]
    for name in beside:
        (runs.JSON / f"curve_{name}.jsonl").unlink()
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("million ticks played", "instructions completed")
    assert words(axes) == ["camera policy", "MPO alone, from nothing", "other way"]
    assert axes.yaxis.get_major_formatter()(0.5, 0) == "50 %"
    losses = [{"step": 1000 * i, "value": 2.0**-i, "what": "loss of beta"} for i in range(4)]
    (runs.JSON / "curve_termination.jsonl").write_text("".join(json.dumps(point) + "\n" for point in losses))
    figures.curves(folder / "figure4.png")
    _, axes = drawn()
    assert axes.get_xlabel() == "million recorded ticks" and axes.get_yscale() == "log"
    assert axes.get_ylabel() == "loss of beta\n[nats a tick, less is better]"
    (runs.JSON / "curve_controller_mpo.jsonl").write_text('{"step": 0, "value": 1.5, "what": "loss"}\n')
    with pytest.raises(runs.ResultError, match=r"curve_controller\.jsonl: expected curves of one measure"):
        figures.curves(folder / "figure4.png")
    (runs.JSON / "curve_controller.jsonl").write_text('{"step": 0, "value": 0.5}\n')
    with pytest.raises(runs.ResultError, match="expected lines with step, value and what"):
        figures.curves(folder / "figure4.png")


def test_curves_in_the_repository_say_what_they_are_of():
    for source in sorted(runs.JSON.glob("curve_*.jsonl")):
        assert len({json.loads(line)["what"] for line in source.read_text().splitlines()}) == 1, source


def test_the_planners_curves_have_the_names_that_are_given(tmp_path, drawn):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        lines = [{"step": 10**i, "cpu_seconds": 60.0 * i, "evaluation/success_rate/5": i / 4} for i in range(3, 5)]
        (tmp_path / name / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    arguments = [str(tmp_path / "a"), str(tmp_path / "b"), "--out", str(tmp_path / "curve.png")]
    assert planner_curves.main([*arguments, "--names", "residual network", "MPO alone"]) == 0
    samples, minutes = drawn()
    assert words(samples) == ["residual network", "MPO alone"]
    assert "samples" in samples.get_xlabel() and minutes.get_xlabel() == "CPU minutes of training"
    with pytest.raises(ValueError, match="--names: 1 names, expected one for each of the 2 runs"):
        planner_curves.main([*arguments, "--names", "residual network"])
