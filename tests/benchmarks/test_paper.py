"""Tables and figures of the paper: rebuilt from JSON, marked when stale, missing sources named with their command."""

import json
import subprocess
from dataclasses import replace

import pytest

from benchmarks.paper import __main__ as results
from benchmarks.paper import baselines, bodies, curves, figures, film, parts, runs, tables
from bringup import train_all
from bringup.command import Choice, Stack
from bringup.results import EpisodeResult, Failure, report
from mujoban_baselines.train import COMMANDS, PROG
from mujoban_core.files import digest
from mujoban_core.plugins import ROLES, SCOUT, load_module, shipped_weights
from mujoban_core.program import read_options
from mujoban_core.reports import count_uses, noted_uses, write_report
from mujoban_planner import curves as planner_curves

ORACLES = Stack({role: Choice(role, "oracle") for role in ROLES})
EASY = runs.Run("easy", "easy", difficulty=1, oracle=tuple(ROLES))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(runs, "JSON", tmp_path / "json")
    monkeypatch.setattr(parts, "PARTS", tmp_path / "parts")
    (tmp_path / "json").mkdir()
    return tmp_path


def write(run, solved, of, weights):
    episodes = [EpisodeResult(i, i < solved, 14.0 if i < solved else 3.0, 100, 9, 0, 0, None) for i in range(of)]
    write_report(report(episodes, weights), run.file)


def test_without_sources_the_page_names_the_commands_that_make_them(folder, capsys):
    assert results.rebuild(folder) == folder / "README.md"
    page = (folder / "README.md").read_text()
    assert "Rows are of the *reference* world" in page
    assert "python -m benchmarks.paper.runs --only film_strip" in page
    assert "python -m benchmarks.paper.curves --controller RUN" in page
    assert page.count("not measured |") == 98, (
        "two rows of Table 1, three of Table 2 and six beside, six of Figure 2, sixteen of Figure 5, thirteen agents "
        "at five difficulties"
    )
    assert "no source yet" in capsys.readouterr().err


def test_the_page_in_the_repository_is_what_its_sources_say(monkeypatch):
    monkeypatch.setattr(film, "draw", lambda episode, file: None)  # Pictures may differ.
    assert results.is_current(runs.RESULTS), "run: make results"


def test_a_page_that_was_edited_or_is_missing_is_noticed(folder, capsys):
    check = ["--out", str(folder), "--check"]
    assert results.main(check) == 1 and results.main(check[:2]) == 0 and results.main(check) == 0
    (folder / "README.md").write_text((folder / "README.md").read_text().replace("78.7 %", "8.7 %"))
    assert results.main(check) == 1
    assert f"{folder / 'README.md'} is not up to date" in capsys.readouterr().out
    assert "8.7 %" in (folder / "README.md").read_text()


def test_the_page_has_our_numbers_beside_the_papers_and_marks_other_weights(folder):
    shipped = {role: digest(shipped_weights(role)) for role in ROLES}
    write(runs.CONFIGURATIONS[0], 3, 4, shipped)
    write(runs.POLICY_ALONE[0], 2, 4, shipped)
    write(runs.CONFIGURATIONS[2], 4, 4, {**shipped, "controller": "0" * 64})
    assert results.rebuild(folder) == folder / "README.md"
    page = (folder / "README.md").read_text()
    assert "| default | `default` | none | 4 | 75.0 % | 30.1 to 95.4 % | 78.7 % | 11.25 (2.75) | 11.42 |" in page
    assert f"| controller only{tables.STALE} | `controller` |" in page and (folder / "figure2.png").stat().st_size
    assert runs.is_current(runs.CONFIGURATIONS[0], 4) and not runs.is_current(runs.CONFIGURATIONS[0], 512)
    assert not runs.is_current(runs.CONFIGURATIONS[2], 4)


def test_a_table_of_failures_says_what_each_of_its_causes_means(folder):
    lost = [EpisodeResult(i, False, 3.0, 100, 9, 0, 0, failure) for i, failure in enumerate(Failure)]
    write_report(report(lost, {}), runs.CONFIGURATIONS[0].file)
    table = tables.failures(runs.CONFIGURATIONS)
    assert all(f"*{failure}*, {failure.meaning}" in table for failure in Failure)
    write(runs.CONFIGURATIONS[0], 4, 4, {})
    assert "Causes" not in tables.failures(runs.CONFIGURATIONS)


def test_levels_that_end_otherwise_through_the_graph_are_named(folder):
    assert tables.differences(runs.CONFIGURATIONS[0], runs.GRAPH) == ""
    write(runs.CONFIGURATIONS[0], 3, 4, {})
    write(runs.GRAPH, 1, 4, {})
    told = tables.differences(runs.CONFIGURATIONS[0], runs.GRAPH)
    assert "Of 4 levels, solved by `default` alone: 1, 2; by `graph` alone: none (seeds)." in told


def test_a_damaged_source_is_named_with_the_command_that_mends_it(folder):
    runs.CONFIGURATIONS[0].file.write_text("{}")
    with pytest.raises(runs.ResultError, match=r"default\.json.*python -m benchmarks\.paper\.runs --only default"):
        results.rebuild(folder)


def test_the_film_strip_plays_the_recorded_episode_again(folder):
    kept = film.Film("strip", ORACLES, difficulty=1, seed=1000)
    assert film.load(kept) is None
    film.record(kept)
    episode = film.load(kept)
    assert [(use["seeds"], use["weights"]) for use in episode["test_uses"]] == [([1000, 1007], episode["weights"])]
    assert episode["body"] == "ball" and episode["world"]
    film.draw(episode, folder / "strip.png")
    assert (folder / "strip.png").stat().st_size > 10_000
    episode["torque"] = episode["torque"][: len(episode["torque"]) // 2]
    with pytest.raises(runs.ResultError, match="the world has changed"):
        film.draw(episode, folder / "strip.png")


@pytest.mark.timeout(300)
def test_an_evaluation_goes_on_where_it_was_ended_and_gives_what_one_run_gives(folder, monkeypatch, capfd):
    options = runs.Options(episodes=3, part=2)
    # The weights are "oracle": nothing that could be stale.
    parts.evaluate(EASY, options)
    whole = runs.load(EASY)
    assert [episode["seed"] - runs.SEED for episode in whole["episodes"]] == [0, 1, 2] and whole["success_rate"] == 1.0
    game = whole["played"]
    assert (game["difficulty"], game["seed"], game["look_ahead"]) == (1, runs.SEED, 0)
    assert game["world"] == whole["world"]
    used = [use["seeds"] for use in whole["test_uses"]]
    assert used == [[runs.SEED, runs.SEED + 1], [runs.SEED + 2] * 2] and count_uses(whole["test_uses"]) == 1
    assert "easy: 3 of 3 levels, solved 3 (100.0 %)" in capfd.readouterr().out
    EASY.file.unlink()
    monkeypatch.setattr(parts.Part, "start", lambda part: pytest.fail(f"{part} has been measured already"))
    parts.evaluate(EASY, options)
    assert runs.load(EASY) == whole
    second = parts.Part(EASY, 2, 1)
    content = second.load()
    write_report({**content, "played": {**content["played"], "look_ahead": 400}}, second.file)
    with pytest.raises(ValueError, match="easy: its parts were played differently; --again measures them anew"):
        parts.evaluate(EASY, options)
    # A part that an earlier version measured says less, and then so does the whole.
    write_report({key: value for key, value in content.items() if key != "played"}, second.file)
    parts.evaluate(EASY, options)
    joined = runs.load(EASY)
    assert "played" not in joined and joined["body"] == "ball" and joined["episodes"] == whole["episodes"]
    assert joined["test_uses"] == whole["test_uses"], "nothing was measured, nothing is counted"


def test_what_is_measured_again_stays_noted(folder, monkeypatch):
    monkeypatch.setattr(parts, "_POLL", 0.0)

    def start(part):
        measured = {"when": f"measured {len(noted_uses(part.file))} times before"}
        use = {"commit": "c", "weights": {}, "seeds": [part.first] * 2, "played": {"seed": part.first}}
        write(EASY, 1, 1, {"planner": "oracle"})
        content = json.loads(EASY.file.read_text())
        EASY.file.unlink()
        part.file.parent.mkdir(parents=True, exist_ok=True)
        write_report({**content, "test_uses": [use | measured]}, part.file)
        return subprocess.Popen(["true"])

    monkeypatch.setattr(parts.Part, "start", start)
    for again, expected in ((False, 1), (False, 1), (True, 2)):
        parts.evaluate(EASY, runs.Options(episodes=2, part=1, again=again))
        uses = runs.load(EASY)["test_uses"]
        assert len(uses) == 2 * expected and count_uses(uses) == expected


def test_the_page_says_once_how_often_test_levels_were_used(folder):
    def note(file, *seeds):
        uses = [{"commit": "c", "weights": {}, "seeds": [s, s + 3], "played": None} for s in seeds]
        file.write_text(json.dumps({**json.loads(file.read_text()), "test_uses": uses}))

    rows = [runs.CONFIGURATIONS[0], runs.CONFIGURATIONS[1], baselines.BASELINES[1].run(1), runs.GRAPH]
    for run in rows:
        write(run, 3, 4, {})
    note(rows[0].file, 0, 4)
    note(rows[1].file, 0, 2)
    note(rows[2].file, 0)
    (page,) = [line for line in results.rebuild(folder).read_text().splitlines() if "test levels were used" in line]
    assert "used 4 times: 4 evaluations for 4 rows of its tables, 0 recordings for 0 film strips. 1 of them" in page


def test_a_part_that_was_interrupted_is_measured_anew(folder):
    part = parts.Part(EASY, 0, 2)
    part.file.parent.mkdir(parents=True)
    for played, whole in ((2, True), (1, False)):
        write(EASY, 1, played, {"planner": "oracle"})
        part.file.write_text(EASY.file.read_text())
        assert (part.load() is not None) == whole


def test_a_long_curve_is_thinned_to_means_that_weigh_instructions_alike(tmp_path):
    lines = [
        {"step": step, "instruction/move": float(step % 2), "instruction/move_n": 1 + 2 * (step % 2)}
        for step in range(400)
    ]
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    points = curves.read_curve("controller", [tmp_path])
    assert len(points) == 200 and {p["value"] for p in points} == {0.75}


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
    assert baselines.points_of(row)[-1] == {**cost, "solved": {"1": 1.0}, "return": {"1": 10.0}}
    monkeypatch.setattr(baselines, "ROOT", tmp_path)  # whoever has trained the agent has other weights there
    monkeypatch.setattr(baselines, "_MOST", 5)  # lines 9 and 10 are of 2 episodes and of 1
    assert baselines.read_curve(tmp_path / "run")[-1]["solved"] == {"1": 0.9333}
    write(row.run(1), 3, 4, {"agent": "a" * 64})
    page = results.rebuild(folder).read_text()
    rates = "75.0 % (30.1 to 95.4)" + 4 * " | not measured"
    assert f"| MPO, asym. | o_cam, o_pr, o_pos | easy | 0.01 M | 1.0 | 0.5 | 5 days, 256 actors | 4 | {rates} |" in page
    assert (folder / "baselines.png").stat().st_size and "--agent" in row.run(1).options()
    with pytest.raises(ValueError, match="nobody=x: expected NAME=RUN with a name among modular, mpo_hard"):
        baselines.main(["nobody=x"])
    row.curve.write_text("{}\n")
    with pytest.raises(runs.ResultError, match=r"rerun python -m benchmarks\.paper\.baselines mpo_easy"):
        results.rebuild(folder)


def test_the_modular_row_has_a_cost_and_no_curve(folder):
    cost = {"step": 1_000_000, "cpu_seconds": 7200, "seconds": 3600, "solved": {}, "return": {}}
    baselines.MODULAR.curve.write_text(json.dumps(cost) + "\n")
    page = results.rebuild(folder).read_text()
    assert "| 1.00 M | 2.0 | 1.0 |" in page and "The curves of agents: not measured yet" in page
    assert not (folder / "baselines.png").exists()


def test_an_agent_that_was_trained_anew_is_measured_anew(folder, monkeypatch, capsys):
    weights = folder / "agent.safetensors"
    run = runs.Run("mine", "mine", 1, agent=weights)
    monkeypatch.setattr(runs, "ALL", (run,))
    weights.write_bytes(b"first")
    write(run, 3, 4, {"agent": f"{digest(weights)} (privileged)"})
    part = parts.Part(run, 0, 4)
    part.file.parent.mkdir(parents=True)
    write_report(runs.load(run), part.file)
    assert runs.is_current(run, 4) and part.load() is not None and tables.STALE not in tables.configurations([run])
    weights.write_bytes(b"second")
    assert not runs.is_current(run, 4) and part.load() is None and tables.STALE in tables.configurations([run])
    weights.unlink()
    assert runs.is_current(run, 4), "where the weights are not, nothing is known against them"
    assert runs.main(["--only", "mine"]) == 0 and "no weights at" in capsys.readouterr().out


def test_the_learned_scout_is_measured_by_weights_of_ones_own(folder, monkeypatch, capsys):
    file = folder / "explorer.safetensors"
    (row,) = (run for run in runs.ALL if run.name == "look_around_learned")
    assert row.own == {SCOUT: runs.ROOT / "runs/explorer/explorer.safetensors"}
    learned = replace(row, modules=((SCOUT, file),))
    monkeypatch.setattr(runs, "ALL", (learned,))
    command = "python -m mujoban_planner.train explorer --run runs/explorer"
    assert runs.main(["--only", learned.name]) == 0
    assert f"{learned.name}: no weights at {file} yet: {command}" in capsys.readouterr().out
    assert f"`{command}`" in results.rebuild(folder).read_text()
    measured = []
    monkeypatch.setattr(parts, "evaluate", lambda run, options: measured.append(run.options()))
    file.write_bytes(b"weights")
    assert runs.main(["--only", learned.name]) == 0 and measured[0][-2:] == ["--scout", str(file)]


def test_the_fine_tuned_stack_has_a_row_and_its_failures_beside_what_it_came_from(folder):
    run = baselines.JOINT.run(5)
    options = run.options()
    for role in ("controller", "planner"):
        assert options[options.index(f"--{role}") + 1] == str(runs.ROOT / f"runs/baselines/joint/{role}.safetensors")
    write(runs.POLICY_ALONE[0], 3, 4, {})
    write(run, 2, 4, {})
    page = results.rebuild(folder).read_text()
    assert "| modular, fine-tuned as a whole | o_cam, o_pr, o_pos |" in page and "50.0 % (15.0 to 85.0)" in page
    failures = page.split("before fine-tuning as a whole and after")[1].split("##")[0]
    assert "| default, the planner's policy alone |" in failures and "| modular, fine-tuned as a whole |" in failures


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
            options = read_options(COMMANDS, arguments, PROG)
            assert program == PROG and isinstance(options, COMMANDS[arguments[0]])
            assert options.config.seed == row.seed and options.run.name.startswith(row.name)
            steps, cpu_seconds = steps + options.config.steps, cpu_seconds + options.config.cpu_seconds
        whole = pytest.approx((baselines.steps(), 7200.0), abs=1.0)
        assert row is baselines.MODULAR or row.agent or (steps, cpu_seconds) == whole


def test_table_1_has_a_floor_that_is_measured_without_a_training(folder, monkeypatch):
    measured = []
    monkeypatch.setattr(parts, "evaluate", lambda run, options: measured.append(run))
    assert runs.main(["--only", "untrained_1", "random_1"]) == 0
    agents = [load_module("agent", run.options()[run.options().index("--agent") + 1]) for run in measured]
    assert [run.name for run in measured] == ["random_1", "untrained_1"] and len(agents) == 2
    write(measured[1], 1, 4, {"agent": "mujoban_baselines.agents:untrained"})
    page = results.rebuild(folder).read_text()
    cells = "o_cam, o_pr, o_pos | nothing | - | - | - | not there | 4 | 25.0 % (4.6 to 69.9) | not measured"
    assert f"| MPO untrained: its noise, pink, held for 4 ticks | {cells}" in page
    with pytest.raises(ValueError, match="random=x: expected NAME=RUN"):
        baselines.main(["random=x"])


def test_agents_get_the_steps_that_the_modular_row_took(folder):
    assert "--steps 1250000" in baselines.JOINT.commands[0]
    taken = {"step": 1_300_000, "cpu_seconds": 7000, "seconds": 3500, "solved": {}, "return": {}}
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


def test_another_seed_of_a_row_is_shown_where_it_was_measured(folder):
    assert "seed 1 |" not in results.rebuild(folder).read_text()
    again = next(row for row in baselines.AGAIN if row.name == "mpo_easy_seed1")
    again.curve.write_text(json.dumps({"step": 5, "cpu_seconds": 1, "seconds": 1, "solved": {}, "return": {}}))
    write(again.run(1), 3, 4, {})
    page = results.rebuild(folder).read_text()
    assert "| MPO, asym., seed 1 | o_cam, o_pr, o_pos | easy |" in page and "75.0 % (30.1 to 95.4)" in page


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
    assert f"| modular | o_cam, o_pr, o_pos | all difficulties, bottom-up ([how](../weights.md)) | {cells} |" in page


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
    assert figures.difficulty(runs.POLICY_ALONE[:1], folder / "figure2.png", runs.CONFIGURATIONS[0])
    (axes,) = drawn()
    assert axes.get_legend().get_title().get_text() == "bars: 95 % intervals (Wilson)"
    _, alone, default = words(axes)
    assert alone.endswith("the planner's policy alone") and default == "the default, with the search ahead"
    beside = ("planner", "planner_mpo", "estimator", "estimator_mpo")
    for name in ("controller", "controller_mpo", "controller_other_way", *beside):
        points = [{"step": 1000 * i, "value": i / 3, "what": "instructions completed"} for i in range(4)]
        (runs.JSON / f"curve_{name}.jsonl").write_text("".join(json.dumps(point) + "\n" for point in points))
    figures.curves(folder / "figure4.png")
    axes, *others = drawn()
    assert [words(other)[0] for other in others] == ["expert iteration", "supervised"]
    for name in beside:
        (runs.JSON / f"curve_{name}.jsonl").unlink()
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("million ticks played", "instructions completed")
    assert words(axes) == ["distillation", "MPO alone, from nothing", "other way"]
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


def test_figure_5_has_both_bodies_and_marks_a_controller_that_is_another_now(folder):
    shipped = {role: digest(shipped_weights(role, "ant")) for role in ROLES}
    ant, camera = bodies.BODIES["ant"], bodies.BODIES["ant_camera"]
    write(ant[4], 3, 4, {**shipped, "controller": f"{digest(ant[4].own['controller'])} (privileged)"})
    write(ant[3], 4, 4, {**shipped, "controller": f"{'0' * 64} (privileged)"})
    write(camera[4], 4, 4, shipped)
    write(camera[3], 4, 4, {role: digest(shipped_weights(role)) for role in ROLES})  # the ball's
    lost = [EpisodeResult(i, False, 3.0, 100, 9, 0, 0, Failure.CONTROLLER_TIME_OUT) for i in range(3)]
    write_report(report(lost, shipped), camera[2].file)
    assert results.rebuild(folder) == folder / "README.md"
    page = (folder / "README.md").read_text()
    causes = page.split("## Figure 5")[1].split("Why episodes fail:")[1]
    assert f"| {camera[2].title} | 3 |" in causes and Failure.CONTROLLER_TIME_OUT.meaning in causes
    assert "| ant, by ground truth (privileged), difficulty 5 | `ant_5` |" in page and "| 73.7 % |" in page
    assert f"| ant, by ground truth (privileged), difficulty 4{tables.STALE} | `ant_4` |" in page
    assert "| ant, by its camera, difficulty 5 | `ant_camera_5` |" in page
    assert f"| ant, by its camera, difficulty 4{tables.STALE} | `ant_camera_4` |" in page
    assert (folder / "figure5.png").stat().st_size
    assert [o for o in ant[4].options() if o in ("--body", "ant")] == ["--body", "ant"]
