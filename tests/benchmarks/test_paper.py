"""The page of the paper: rebuilt from JSON, marked when stale, missing sources named with their command."""

import json

import pytest
from paper_pages import ORACLES, write

from benchmarks.paper import __main__ as results
from benchmarks.paper import baselines, bodies, film, runs, tables
from bringup.results import EpisodeResult, Failure, report
from mujoban_core.files import digest
from mujoban_core.plugins import ROLES, shipped_weights
from mujoban_core.reports import write_report


def test_without_sources_the_page_names_the_commands_that_make_them(folder, capsys):
    assert results.rebuild(folder) == folder / "README.md"
    page = (folder / "README.md").read_text()
    assert "Rows are of the *reference* world" in page
    assert "python -m benchmarks.paper.runs --only film_strip" in page
    assert "python -m benchmarks.paper.curves --controller RUN" in page
    assert page.count("not measured |") == 102 + 5 * (len(baselines.BASELINES) - 12), (
        "two rows of Table 1, three of Table 2 and six beside, ten of Figure 2, sixteen of Figure 5, thirteen agents "
        "at five difficulties, and those of your own"
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
    write(runs.CONFIGURATIONS[1], 4, 4, {"planner": "mine:Cheat (privileged)", "estimator": "oracle"})
    table = tables.failures(runs.CONFIGURATIONS)
    assert "| default | none | 1 |" in table and "| planner + controller only | planner, estimator | " in table
    assert all(f"*{failure}*, {failure.meaning}" in table for failure in Failure)
    write(runs.CONFIGURATIONS[0], 4, 4, {})
    assert "Causes" not in tables.failures(runs.CONFIGURATIONS)


def test_levels_that_end_otherwise_through_the_graph_are_named(folder):
    assert tables.differences(runs.CONFIGURATIONS[0], runs.GRAPH) == ""
    write(runs.CONFIGURATIONS[0], 3, 4, {})
    write(runs.GRAPH, 1, 4, {})
    told = tables.differences(runs.CONFIGURATIONS[0], runs.GRAPH)
    lost = "1 (time limit), 2 (time limit)"
    assert f"Of 4 levels, solved by `default` alone: {lost}; by `graph` alone: none (seeds, and what" in told
    assert "batches of other sizes" in told
    write(runs.GRAPH, 1, 4, {"planner": "0" * 16})
    assert tables.differences(runs.CONFIGURATIONS[0], runs.GRAPH).endswith("with other weights: planner.\n")


def test_a_damaged_source_is_named_with_the_command_that_mends_it(folder):
    runs.CONFIGURATIONS[0].file.write_text("{}")
    with pytest.raises(runs.ResultError, match=r"default\.json.*python -m benchmarks\.paper\.runs --only default"):
        results.rebuild(folder)


def test_the_film_strip_plays_the_recorded_episode_again(folder, monkeypatch):
    kept = film.Film("strip", ORACLES, difficulty=1, seed=1000)
    assert film.load(kept) is None
    film.record(kept)
    episode = film.load(kept)
    assert [(use["seeds"], use["weights"]) for use in episode["test_uses"]] == [([1000, 1007], episode["weights"])]
    assert episode["body"] == "ball" and episode["world"]
    film.draw(episode, folder / "strip.png")
    assert (folder / "strip.png").stat().st_size > 10_000
    with monkeypatch.context() as context:
        context.setitem(film.FILMS, "ant", kept)
        context.setattr(film, "draw", lambda episode, file: None)
        told = f"Privileged, told the ground truth: {', '.join(ROLES)}."
        assert told in results.rebuild(folder).read_text()
    episode["torque"] = episode["torque"][: len(episode["torque"]) // 2]
    with pytest.raises(runs.ResultError, match="the world has changed"):
        film.draw(episode, folder / "strip.png")


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
    assert f"| {camera[2].title} | none | 3 |" in causes and Failure.CONTROLLER_TIME_OUT.meaning in causes
    assert "| ant, by ground truth (privileged), difficulty 5 | `ant_5` |" in page and "| 73.7 % |" in page
    assert f"| ant, by ground truth (privileged), difficulty 4{tables.STALE} | `ant_4` |" in page
    assert "| ant, by its camera, difficulty 5 | `ant_camera_5` |" in page
    assert f"| ant, by its camera, difficulty 4{tables.STALE} | `ant_camera_4` |" in page
    assert (folder / "figure5.png").stat().st_size
    assert [o for o in ant[4].options() if o in ("--body", "ant")] == ["--body", "ant"]
