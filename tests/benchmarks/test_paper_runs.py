"""The evaluations of rows: gone on with, measured anew where weights are others, their use of test levels noted."""

import json
import subprocess
from dataclasses import replace

import pytest
from paper_pages import EASY, write

from benchmarks.paper import __main__ as results
from benchmarks.paper import parts, runs, tables
from mujoban_core.files import digest
from mujoban_core.plugins import SCOUT
from mujoban_core.reports import count_uses, noted_uses, write_report


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


def test_a_part_that_was_interrupted_is_measured_anew(folder):
    part = parts.Part(EASY, 0, 2)
    part.file.parent.mkdir(parents=True)
    for played, whole in ((2, True), (1, False)):
        write(EASY, 1, played, {"planner": "oracle"})
        part.file.write_text(EASY.file.read_text())
        assert (part.load() is not None) == whole


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


def test_an_agent_that_loads_its_weights_by_itself_is_measured_anew_where_they_are_others(folder, monkeypatch):
    monkeypatch.setattr(parts, "_POLL", 0.0)
    weights, started = folder / "agent.safetensors", []
    run = runs.Run("mine", "mine", 1, further=("--agent", "mine:trained"), trained=weights)

    def start(part):
        started.append(part.first)
        write(run, 1, 1, {"agent": "mine:trained"})
        part.file.parent.mkdir(parents=True, exist_ok=True)
        run.file.replace(part.file)
        return subprocess.Popen(["true"])

    monkeypatch.setattr(parts.Part, "start", start)
    assert run.missing_weights() == weights
    for content in (b"first", b"second"):
        weights.write_bytes(content)
        started.clear()
        assert not runs.is_current(run, 2)
        for _ in range(2):
            parts.evaluate(run, runs.Options(episodes=2, part=1))
        assert started == [0, 1] and runs.is_current(run, 2), "once with these weights"
        assert runs.load(run)[runs.TRAINED] == digest(weights)


def test_a_part_is_noted_beside_which_another_failed(folder, monkeypatch):
    """Both end between two looks, the one that failed first; the other needs no second use of test levels."""
    monkeypatch.setattr(parts, "_POLL", 0.0)
    weights = folder / "agent.safetensors"
    weights.write_bytes(b"trained")
    run = runs.Run("mine", "mine", 1, further=("--agent", "mine:trained"), trained=weights)

    def start(part):
        write(run, 1, 1, {"agent": "mine:trained"})
        part.file.parent.mkdir(parents=True, exist_ok=True)
        run.file.replace(part.file)
        process = subprocess.Popen(["true" if part.first else "false"])
        process.wait()
        return process

    monkeypatch.setattr(parts.Part, "start", start)
    with pytest.raises(ValueError, match=r"ended with status 1; see .*4000000_1\.log"):
        parts.evaluate(run, runs.Options(episodes=2, part=1, processes=2))
    assert parts.Part(run, 1, 1).load() is not None


def test_the_learned_scout_is_measured_by_weights_that_do_not_ship(folder, monkeypatch, capsys):
    file = folder / "explorer.safetensors"
    (row,) = (run for run in runs.ALL if run.name == "look_around_learned")
    assert row.own == {SCOUT: runs.ROOT / "docs/research/explorer/explorer.safetensors"}
    assert row.missing_weights() is None, "they lie in the repository"
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
