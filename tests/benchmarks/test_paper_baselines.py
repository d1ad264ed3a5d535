"""Table 1: what each of its agents is trained by, what that cost, and how it is shown."""

import json

import pytest
from paper_pages import write

from benchmarks.paper import __main__ as results
from benchmarks.paper import baselines, parts, runs, tables
from bringup import train_all
from mujoban_baselines.train import COMMANDS, PROG
from mujoban_core.files import digest
from mujoban_core.grid import DIFFICULTIES
from mujoban_core.plugins import PRIVILEGED, ROLES, load_module, shipped_weights
from mujoban_core.program import read_options
from mujoban_core.stats import paired_difference, wilson_interval


def test_table_1_has_a_row_for_each_agent_with_what_it_cost(folder, tmp_path, monkeypatch):
    lines = [
        {"step": 1000 * i, "cpu_seconds": 360.0 * i, "seconds": 180.0 * i, "solved/1": i / 10, "return/1": float(i),
         "solved/1_n": 1 + i % 2, "return/1_n": 1, "solved/5": None}
        for i in range(1, 11)
    ]  # fmt: skip
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert baselines.main([f"mpo_easy={tmp_path / 'run'}"]) == 0
    row = next(row for row in baselines.BASELINES if row.name == "mpo_easy")
    cost = {"step": 10_000, "cpu_seconds": 3600, "seconds": 1800}
    assert baselines.points_of(row)[-1] == {
        **cost, "solved": {"1": 1.0}, "return": {"1": 10.0}, "episodes": {"1": 1},
    }  # fmt: skip
    monkeypatch.setattr(baselines, "ROOT", tmp_path)  # whoever has trained the agent has other weights there
    monkeypatch.setattr(baselines, "_MOST", 5)  # lines 9 and 10 are of 2 episodes and of 1
    assert baselines.read_curve(tmp_path / "run")[-1]["solved"] == {"1": 0.9333}
    write(row.run(1), 3, 4, {"agent": "a" * 64})
    page = results.rebuild(folder).read_text()
    rates = "75.0 % (30.1 to 95.4)" + 4 * " | not measured"
    cells = "o_cam, o_pr, o_pos | easy | 0.01 M | 1.0 | 0.5 | 5 days, 256 actors | 4"
    assert f"| MPO, asym. | `mpo_easy` | {cells} | {rates} |" in page
    assert (folder / "baselines.png").stat().st_size and "--agent" in row.run(1).options()
    with pytest.raises(ValueError, match="nobody=x: expected NAME=RUN with a name among modular, mpo_hard"):
        baselines.main(["nobody=x"])
    row.curve.write_text("{}\n")
    with pytest.raises(runs.ResultError, match=r"rerun python -m benchmarks\.paper\.baselines mpo_easy"):
        results.rebuild(folder)


def test_a_point_of_a_drawn_curve_is_of_many_episodes():
    counts = ((100, 12, 1.0), (200, 8, 0.5), (300, 30, 0.1), (400, 19, 0.0))
    points = [{"step": step, "solved": {"1": rate}, "episodes": {"1": n}} for step, n, rate in counts]
    points.insert(1, {"step": 150, "solved": {}, "episodes": {}})  # none of difficulty 1 ended
    assert baselines.joined(points, "solved", 1) == [(200, pytest.approx(0.8)), (300, pytest.approx(0.1))]
    assert baselines.joined(points, "solved", 2) == []


def test_a_curve_counts_no_episodes_but_of_whole_spans_of_the_longest_one(tmp_path):
    """Two robots, 90 ticks at the most: one solves in 30 ticks what it plays, the other never any of it."""
    task = {"levels": "easy", "episode_seconds": 4.5, "robots": 2, "body": "ball", "world": "reference"}
    (tmp_path / "config.json").write_text(json.dumps({"task": task}))
    lines = []
    for tick in range(30, 481, 30):  # a line each time that an episode ends, a step after that
        outcomes = [1.0] + [0.0] * (tick % 90 == 0)
        said = {f"{kind}/1": scale * sum(outcomes) / len(outcomes) for kind, scale in (("solved", 1), ("return", 11))}
        counts = {f"{kind}/1_n": len(outcomes) for kind in ("solved", "return")}
        lines.append({"step": 2 * tick + 2, "cpu_seconds": tick, "seconds": tick, **said, **counts})
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    points = baselines.read_curve(tmp_path)
    assert [(point["step"], point["episodes"].get("1", 0)) for point in points] == [
        (182, 0), (362, 4), (542, 4), (722, 4), (902, 4), (962, 0)
    ]  # fmt: skip
    assert all(point["solved"] == {"1": 0.75} and point["return"] == {"1": 8.25} for point in points[1:-1])
    assert points[-1]["cpu_seconds"] == 480, "what it cost is of the whole run"


def test_lines_further_apart_than_the_longest_episode_leave_the_end_out_too(tmp_path):
    task = {"levels": "easy", "episode_seconds": 4.5, "robots": 2, "body": "ball", "world": "reference"}
    (tmp_path / "config.json").write_text(json.dumps({"task": task}))
    one = {f"{kind}/1{suffix}": 1.0 for kind in ("solved", "return") for suffix in ("", "_n")}
    lines = [{"step": step, "cpu_seconds": step, "seconds": step, **one} for step in (180, 720, 900, 960)]
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    points = baselines.read_curve(tmp_path)
    assert [point["episodes"].get("1", 0) for point in points] == [0, 1, 1, 0]


def test_bars_of_a_curve_are_intervals_of_its_episodes():
    points = [{"step": 1, "solved": {"1": 0.75}, "episodes": {"1": 20}}]
    ((below, above),) = baselines.solved_margins(points, 1)
    low, high = wilson_interval(15, 20)
    assert (below, above) == pytest.approx((0.75 - low, high - 0.75))
    assert baselines.solved_margins(points, 2) == []


def test_the_modular_row_has_a_cost_and_no_curve(folder):
    cost = {"step": 1_000_000, "cpu_seconds": 7200, "seconds": 3600, "solved": {}, "return": {}, "episodes": {}}
    baselines.MODULAR.curve.write_text(json.dumps(cost) + "\n")
    page = results.rebuild(folder).read_text()
    assert "| 1.00 M | 2.0 | 1.0 |" in page and "The curves of agents: not measured yet" in page
    assert not (folder / "baselines.png").exists()


def test_the_fine_tuned_stack_has_a_row_and_its_failures_beside_what_it_came_from(folder):
    run = baselines.JOINT.run(5)
    options = run.options()
    for role in ("controller", "planner"):
        assert options[options.index(f"--{role}") + 1] == str(runs.ROOT / f"runs/baselines/joint/{role}.safetensors")
    began = {role: digest(shipped_weights(role)) for role in ROLES}
    after = {**began, "controller": "1" * 64, "planner": "2" * 64}
    note_a_joint_run(folder, began)
    write(runs.POLICY_ALONE[0], 3, 4, began)
    write(run, 2, 4, after)
    page = results.rebuild(folder).read_text()
    assert "| modular, fine-tuned as a whole | `joint` | o_cam, o_pr, o_pos |" in page
    assert "50.0 % (15.0 to 85.0)" in page
    failures = page.split("before fine-tuning as a whole and after")[1].split("##")[0]
    assert "| default, the planner's policy alone |" in failures and "| modular, fine-tuned as a whole |" in failures


def note_a_joint_run(folder, began):
    run = folder / "run"
    run.mkdir(exist_ok=True)
    (run / "metrics.jsonl").write_text('{"step": 9, "cpu_seconds": 1, "seconds": 1}\n')
    (run / "config.json").write_text(json.dumps({"origins": began}))
    assert baselines.main([f"joint={run}"]) == 0


def test_failures_of_the_fine_tuned_stack_are_compared_with_what_it_came_from_alone(folder):
    def told(before, tuned):
        write(runs.POLICY_ALONE[0], 3, 4, before)
        write(baselines.JOINT.run(5), 2, 4, tuned)
        return tables.fine_tuned()

    then = {role: str(i) * 64 for i, role in enumerate(ROLES)}
    after = {**then, "controller": "8" * 64, "planner": "9" * 64}
    assert told(then, after) == "", "nobody has noted what it began with"
    note_a_joint_run(folder, then)
    compared = told(then, after)
    assert f"| default, the planner's policy alone{tables.STALE} |" in compared, "other weights ship by now"
    low, high = (f"{100 * bound:+.1f}" for bound in paired_difference(1, 0, 4)[1:])
    gained = f"-25.0 points of success (95 % interval {low} to {high}); solved before alone: 1, after alone: 0."
    assert f"\n\nFine-tuned less before, on the same 4 levels: {gained}\n" in compared
    others = "did not play with the weights with which the fine-tuning began, by the digests of"
    for role in ROLES:
        said = told({**then, role: "7" * 64}, after)
        assert said.endswith(f"{others} {role}.\n") and said.count("\n") == 1, f"another {role} before"
    said = told(then, {**after, "estimator": "7" * 64})
    assert said.endswith(f"{others} estimator.\n") and said.count("\n") == 1, "another estimator after"
    baselines.JOINT.run(5).file.unlink()
    assert tables.fine_tuned() == ""


def test_every_row_is_trained_by_a_command_that_exists_with_the_same_budget(folder):
    page = results.rebuild(folder).read_text().splitlines()
    for row in (*baselines.BASELINES, *baselines.AGAIN):
        steps = cpu_seconds = 0.0
        for command in row.commands:
            assert f"    {command}" in page
            _, _, program, *arguments = command.split()
            if row is baselines.MODULAR:
                assert program == train_all.PROG and read_options(train_all.Options, arguments, PROG).hours == 1.0
                continue
            if row.program != PROG:  # somebody's own, which knows what options it has
                continue
            options = read_options(COMMANDS, arguments, PROG)
            assert program == PROG and isinstance(options, COMMANDS[arguments[0]])
            assert options.config.seed == row.seed and options.run.name.startswith(row.name)
            steps, cpu_seconds = steps + options.config.steps, cpu_seconds + options.config.cpu_seconds
        whole = pytest.approx((baselines.steps(), 7200.0), abs=1.0)
        assert row.program != PROG or (steps, cpu_seconds) == whole


def test_table_1_has_a_floor_that_is_measured_without_a_training(folder, monkeypatch):
    measured = []
    monkeypatch.setattr(parts, "evaluate", lambda run, options: measured.append(run))
    assert runs.main(["--only", "untrained_1", "random_1"]) == 0
    agents = [load_module("agent", run.options()[run.options().index("--agent") + 1]) for run in measured]
    assert [run.name for run in measured] == ["random_1", "untrained_1"] and len(agents) == 2
    write(measured[1], 1, 4, {"agent": "mujoban_baselines.agents:untrained"})
    page = results.rebuild(folder).read_text()
    cells = "o_cam, o_pr, o_pos | nothing | - | - | - | not there | 4 | 25.0 % (4.6 to 69.9) | not measured"
    assert f"| MPO untrained: its noise, pink, held for 4 ticks | `untrained` | {cells}" in page
    with pytest.raises(ValueError, match="random=x: expected NAME=RUN"):
        baselines.main(["random=x"])


def test_agents_get_the_steps_that_the_modular_row_took(folder):
    assert "--steps 1250000" in baselines.JOINT.commands[0]
    taken = {"step": 1_300_000, "cpu_seconds": 7000, "seconds": 3500, "solved": {}, "return": {}, "episodes": {}}
    baselines.MODULAR.curve.write_text(json.dumps(taken))
    assert "--steps 1300000" in baselines.JOINT.commands[0]


def test_what_a_cloning_before_took_counts(folder, tmp_path):
    for name, step in (("run_start", 300), ("run", 1000)):
        (tmp_path / name).mkdir()
        line = {"step": step, "cpu_seconds": step / 10, "seconds": step / 20}
        (tmp_path / name / "metrics.jsonl").write_text(json.dumps(line) + "\n")
    assert baselines.main([f"mpo_cloned={tmp_path / 'run'}"]) == 0
    row = next(row for row in baselines.BASELINES if row.name == "mpo_cloned")
    point = baselines.points_of(row)[-1]
    assert (point["step"], point["cpu_seconds"], point["seconds"]) == (1300, 130, 65)
    (tmp_path / "run_start" / "metrics.jsonl").write_text("")
    with pytest.raises(runs.ResultError, match="run_start: its metrics are empty"):
        baselines.main([f"mpo_cloned={tmp_path / 'run'}"])
    (tmp_path / "run_start").rename(tmp_path / "elsewhere")
    with pytest.raises(runs.ResultError, match=r"run_start: no metrics\.jsonl, expected the run directory"):
        baselines.main([f"mpo_cloned={tmp_path / 'run'}"])


def test_a_run_that_was_refused_many_updates_is_no_row(folder, tmp_path):
    def note(**refused):
        for name, count in refused.items():
            line = {"step": 9, "cpu_seconds": 1, "seconds": 1, "updates": 2250.0, "refused_updates": count}
            (tmp_path / name).mkdir(exist_ok=True)
            (tmp_path / name / "metrics.jsonl").write_text(json.dumps(line) + "\n")
        baselines.main([f"mpo_cloned={tmp_path / 'run'}"])

    row = next(row for row in baselines.BASELINES if row.name == "mpo_cloned")
    note(run_start=0.0, run=22.0)
    row.curve.unlink()  # 1 % at the most: there it was
    for refused in ({"run_start": 0.0, "run": 1087.0}, {"run_start": 1087.0, "run": 0.0}):
        with pytest.raises(runs.ResultError, match=r"run(_start)?: 1,087 of 2,250 updates were refused"):
            note(**refused)
        assert not row.curve.exists()


def test_another_seed_of_a_row_is_shown_where_it_was_measured(folder):
    assert "seed 1 |" not in results.rebuild(folder).read_text()
    again = next(row for row in baselines.AGAIN if row.name == "mpo_easy_seed1")
    point = {"step": 5, "cpu_seconds": 1, "seconds": 1, "solved": {}, "return": {}, "episodes": {}}
    again.curve.write_text(json.dumps(point))
    write(again.run(1), 3, 4, {})
    page = results.rebuild(folder).read_text()
    assert "| MPO, asym., seed 1 | `mpo_easy_seed1` | o_cam, o_pr, o_pos | easy |" in page
    assert "75.0 % (30.1 to 95.4)" in page


def test_the_stack_of_the_same_hours_has_a_row_with_what_it_cost(folder, tmp_path):
    entry = {"command": ["-m", "x"], "done": True, "cpu_seconds": 3600.0, "spans": [[0.0, 1800.0]]}
    (tmp_path / "pipeline.json").write_text(json.dumps({"teacher": entry, "bags_first": {**entry, "cpu_seconds": 0.0}}))
    for name, file, text in (
        ("teacher", "metrics.jsonl", '{"step": 5}\n{"step": 1000000}\n'),
        ("logs", "bags_first.txt", "1 of 180 episodes recorded\n500000 ticks of 180 episodes in 32 bags\n"),
    ):
        (tmp_path / name).mkdir()
        (tmp_path / name / file).write_text(text)
    assert baselines.main([f"modular={tmp_path}"]) == 0
    run = baselines.MODULAR.run(5)
    options = run.options()
    for role in ROLES:
        weights = runs.ROOT / f"runs/baselines/modular/weights/{role}.safetensors"
        assert options[options.index(f"--{role}") + 1] == str(weights)
    write(run, 2, 4, {})
    page = results.rebuild(folder).read_text()
    cells = "1.50 M | 1.0 | 0.5 | 7 days, 200 to 1,000 actors a module | 4 |" + 4 * " not measured |"
    cells += " 50.0 % (15.0 to 85.0)"
    trained = "o_cam, o_pr, o_pos | all difficulties, bottom-up ([how](../weights.md))"
    assert f"| modular | `modular` | {trained} | {cells} |" in page


def test_rows_of_agents_that_are_told_the_truth_say_so_in_table_and_legend():
    for row in (*baselines.BASELINES, *baselines.AGAIN):
        for report in filter(None, (runs.load(row.run(d)) for d in DIFFICULTIES)):
            assert bool(report["privileged"]) == (PRIVILEGED in row.title) == (PRIVILEGED in row.label), row.name
