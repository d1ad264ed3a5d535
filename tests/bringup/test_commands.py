"""The commands: what they write, and one line on stderr with exit status 2 for bad input."""

import io
import json
import os
import re
import signal
import subprocess
import sys
import time
import tomllib
from importlib import import_module
from pathlib import Path

import imageio.v2 as imageio
import pytest
from commands import ALL_ORACLES, BUT_PLANNER, UNSOLVABLE, run

from bringup import evaluate, record, run_stack, train
from bringup.command import recorded_seeds
from mujoban_controller import teacher_weights
from mujoban_core.files import digest
from mujoban_core.plugins import shipped_weights
from mujoban_msgs_py import topics
from mujoban_msgs_py.bags import open_bag
from mujoban_msgs_py.bags.training import episode_ticks, open_training_bag
from mujoban_msgs_py.topics import GRAPH_TOPICS
from mujoban_sim import rendering
from mujoban_sokoban.generator import PLAY_SEEDS, TRAIN_SEEDS
from mujoban_sokoban.levels import Level, write_levels


def test_run_stack_plays_records_films_and_reports(tmp_path, capfd):
    report, bag, video = tmp_path / "out.json", tmp_path / "bag", tmp_path / "film.mp4"
    status = run(
        run_stack, "--difficulty", 1, "--episodes", 2, "--headless", *ALL_ORACLES,
        "--json", report, "--record", bag, "--video", video,
    )  # fmt: skip
    assert status == 0
    content = json.loads(report.read_text())
    assert content["success_rate"] == 1.0 and [e["seed"] for e in content["episodes"]] == [*TRAIN_SEEDS[:2]]
    assert {"success_interval", "mean_return", "weights", "ticks_per_second"} <= content.keys()
    assert "solved 2 of 2" in capfd.readouterr().out
    recorded = list(episode_ticks(open_training_bag(bag, [topics.TRUE_EPISODE]), [topics.TRUE_EPISODE]))
    assert len(recorded) == sum(e["steps"] + 1 for e in content["episodes"]), "every tick may be learned from"
    film = imageio.get_reader(video).get_meta_data()
    assert film["codec"] == "h264" and film["pix_fmt"].startswith("yuv420p") and film["size"] == (768, 384)
    assert film["duration"] >= 0.05 * sum(e["steps"] for e in content["episodes"])


def test_run_stack_shows_instruction_estimate_and_truth_on_a_level_that_is_none_for_tests(tmp_path, capfd):
    report = tmp_path / "report.json"
    assert run(run_stack, "--difficulty", 1, *ALL_ORACLES, "--json", report) == 0
    out = capfd.readouterr().out
    assert "instruction" in out and "estimate" in out and "ground truth" in out and "solved 1 of 1" in out
    content = json.loads(report.read_text())
    assert content["played"]["seed"] == PLAY_SEEDS.start and "test_uses" not in content


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--difficulty", "9"], "--difficulty 9, expected one of 1, 2, 3, 4, 5"),
        (["--episodes", "0"], "--episodes 0, expected a whole number from 1 on"),
        (["--heedless"], "unrecognized options: --heedless, expected --headless"),
        (["--json"], "--json has no value, expected one"),
        (["--realtime", "1", "2"], "--realtime 1 2, expected a number above 0, at most 1000"),
        (["--realtime", "1e9"], "--realtime 1e9, expected a number above 0, at most 1000"),
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "ascii"])
def test_a_wrong_option_is_one_line_that_tells_what_is_expected(capfd, monkeypatch, options, said, encoding):
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(io.BytesIO(), encoding=encoding))
    assert run(run_stack, *options) == 2
    assert capfd.readouterr().err == f"command: error: {said}\n"


@pytest.mark.parametrize(
    ("module", "needed"),
    [("controller", ["--run", "runs/x"]), ("planner", ["imitation"]), ("estimator", ["--bags", "bags/x"])],
)
def test_one_command_trains_each_module_and_names_what_it_does_not_know(capfd, module, needed):
    assert run(train, module, *needed, "--bogus") == 2
    err = capfd.readouterr().err
    assert err.startswith("command: error: unrecognized options: --bogus") and err.count("\n") == 1
    assert run(train, module, "--help") == 0
    assert f"usage: train.py {module}" in capfd.readouterr().out


@pytest.mark.parametrize(
    "trained",
    [
        ["controller"],
        ["estimator"],
        *(["planner", m] for m in ("imitation", "mpo")),
        *(["baselines", m] for m in ("monolithic-mpo", "structured-vtrace", "clone")),
    ],
    ids=" ".join,
)
def test_help_explains_by_more_than_a_letter_of_the_code(capfd, trained):
    assert run(train, *trained, "--help") == 0
    assert not re.findall(r"(--\S+) +\S+\s+[│ ]*[A-Za-z]\. ", out := capfd.readouterr().out)
    told = r"(?:rate|seed|body|world|num-actors|discount|threads|device|reward\.\S+)"
    assert not re.findall(rf"(--(?:\S+[.-])?{told}) +\S+\s+[│ ]*\(default", out)


def test_what_cannot_be_trained_is_one_line(capfd):
    assert run(train, "oracle") == 2
    assert capfd.readouterr().err == "command: error: module oracle, expected controller|planner|estimator|baselines\n"


def _installed() -> dict[str, str]:
    return tomllib.loads((Path(run_stack.__file__).parents[1] / "pyproject.toml").read_text())["project"]["scripts"]


@pytest.mark.parametrize("name", ["run", "evaluate", "record", "train"])
def test_the_installed_commands_are_the_programs(name, monkeypatch, capfd):
    module, function = _installed()[f"mujoban-{name}"].split(":")
    monkeypatch.setattr(sys, "argv", [f"mujoban-{name}", "--help"])
    monkeypatch.setattr("mujoban_core.program.leave", sys.exit)
    monkeypatch.setattr("bringup.commands.end_at_once", lambda: None)
    with pytest.raises(SystemExit) as left:
        getattr(import_module(module), function)()
    assert left.value.code == 0 and f"mujoban-{name}" in capfd.readouterr().out


@pytest.mark.parametrize(
    ("program", "imported"),
    [
        *((program, "tyro") for program in ("bringup.run_stack", "bringup.record", "mujoban_planner.train")),
        *((program, "rclpy") for program in ("mujoban_sim.node", "bringup.graph_recorder", "mujoban_planner.node")),
    ],
)
def test_a_ctrl_c_while_a_program_is_still_being_imported_leaves_no_traceback(program, imported, tmp_path):
    early = "import os, signal, time\nos.kill(os.getpid(), signal.SIGINT)\ntime.sleep(9)\n"
    (tmp_path / f"{imported}.py").write_text(early)
    done = subprocess.run(
        [sys.executable, "-m", program],
        cwd=Path(run_stack.__file__).parents[1],
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGINT, b"", b"")


def test_an_option_that_must_be_given_is_named(capfd):
    assert run(record, "--episodes", "3") == 2
    assert capfd.readouterr().err == "command: error: --out is missing, expected it with a value\n"


def test_a_missing_gpu_is_one_line(capfd):
    assert run(evaluate, "--device", "cuda:99") == 2
    err = capfd.readouterr().err
    assert "cuda:99" in err and "expected" in err and err.count("\n") == 1


def test_evaluate_gives_the_same_in_process_and_through_the_graph(tmp_path):
    reports = []
    for extra in ([], ["--graph"]):
        path = tmp_path / f"out{len(extra)}.json"
        assert run(evaluate, "--difficulty", 1, "--episodes", 2, *ALL_ORACLES, "--json", path, *extra) == 0
        assert "test_uses" not in json.loads(path.read_text())
        reports.append(json.loads(path.read_text()))
    assert reports[0]["episodes"] == reports[1]["episodes"]
    assert reports[1]["counts"].keys() <= {"simulator: repeated ticks"} and reports[1]["ticks_per_second"] > 0


def test_an_unsolvable_level_is_played_and_said_to_be(tmp_path, capfd):
    levels = tmp_path / "levels.txt"
    write_levels(levels, [Level.from_text(UNSOLVABLE)])
    assert run(evaluate, "--levels", levels, "--episodes", 1, *ALL_ORACLES, "--time-limit", 5) == 0
    captured = capfd.readouterr()
    assert "level 0" in captured.err and "unsolvable" in captured.err
    assert captured.out.startswith("solved 0 of 1 (0.0 %") and "dead end: 1 (seeds 5000000)" in captured.out


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--difficulty", "9"], "9"),
        (["--episodes", "0"], "0"),
        (["--seed", "-1", *ALL_ORACLES], "-1"),
        (["--oracle", "navigator"], "navigator"),
        (["--levels", "missing.txt", *ALL_ORACLES], "missing.txt"),
        (["--planner", "missing.safetensors", *BUT_PLANNER], "missing.safetensors"),
        (["--planner", "no.such.module:Planner", *BUT_PLANNER], "no.such"),
        (["--planner", "mujoban_sim.oracles:OracleController", *BUT_PLANNER], "Planner"),
        (["--realtime", "-2"], "-2"),
        (["--video", "film.avi", *ALL_ORACLES], "film.avi"),
        (["--record", "bag", "--seed", "1000", *ALL_ORACLES], "--seed 1000: its levels are not for training"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line_on_stderr_and_status_2(capfd, arguments, named):
    assert run(run_stack, "--headless", *arguments) == 2
    err = capfd.readouterr().err.strip()
    assert named in err and "expected" in err and "\n" not in err


@pytest.mark.parametrize("text", ["####\n#  #\n####\n", "#####\n#@@ #\n#$. #\n#####\n", "#####\n#@$$.\n#####\n"])
def test_a_malformed_level_file_is_refused(tmp_path, capfd, text):
    levels = tmp_path / "bad.txt"
    levels.write_text(text)
    assert run(run_stack, "--headless", "--levels", levels, *ALL_ORACLES) == 2
    err = capfd.readouterr().err.strip()
    assert "\n" not in err and err


def test_damaged_weights_are_refused(fresh_weights, tmp_path, capfd):
    good = fresh_weights.choices["controller"].weights
    damaged = tmp_path / "controller.safetensors"
    data = bytearray(good.read_bytes())
    data[-1] ^= 1
    damaged.write_bytes(data)
    damaged.with_suffix(".json").write_text(good.with_suffix(".json").read_text())
    status = run(
        run_stack, "--headless", "--controller", damaged, "--oracle", "estimator,termination,planner"
    )
    assert status == 2
    err = capfd.readouterr().err.strip()
    assert "damaged" in err and "\n" not in err


def test_without_opengl_the_commands_say_what_to_install(monkeypatch, capfd):
    def no_context(size):
        raise rendering.RenderingError("cannot open an OpenGL context: install the Debian packages libegl1 and others")

    monkeypatch.setattr(rendering, "open_context", no_context)
    assert run(run_stack, "--headless", "--difficulty", 1, *ALL_ORACLES) == 2
    assert "error: cannot open an OpenGL context: install the Debian packages libegl1" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("variable", "value", "said"),
    [
        ("MUJOCO_GL", "bogus", "MUJOCO_GL is 'bogus', expected one of egl, osmesa, glfw, or nothing"),
        ("ROS_LOG_DIR", "/proc/x", "ROS cannot write its log to /proc/x, expected a folder that can be written to"),
    ],
)
def test_what_is_wrong_with_the_environment_is_one_line(variable, value, said):
    command = [sys.executable, "bringup/run_stack.py", "--headless", "--difficulty", "1", *ALL_ORACLES]
    root = Path(run_stack.__file__).parents[1]
    ended = subprocess.run(command, cwd=root, env={**os.environ, variable: value}, capture_output=True, text=True)
    (line,) = [line for line in ended.stderr.splitlines() if "another graph runs" not in line]
    assert ended.returncode == 2 and line.startswith(f"run_stack.py: error: {said}")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_leaves_a_whole_bag(tmp_path, number):
    bag = tmp_path / "bag"
    command = [sys.executable, "bringup/run_stack.py", "--headless", "--episodes", "1000", *ALL_ORACLES]
    root = Path(run_stack.__file__).parents[1]
    process = subprocess.Popen([*command, "--record", str(bag)], cwd=root, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 60
    while not any(file.stat().st_size > 1e5 for file in bag.glob("*.mcap")) and time.monotonic() < deadline:
        time.sleep(0.1)
    process.send_signal(number)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 128 + number and err.strip().endswith("interrupted")
    assert {m.topic for m in open_bag(bag).messages()} <= set(GRAPH_TOPICS)


def test_an_interrupted_recording_leaves_whole_bags_of_all_its_processes(tmp_path):
    bags = tmp_path / "bags"
    arguments = ["--out", str(bags), "--processes", "2", "--batch", "2", "--difficulty", "1", *ALL_ORACLES]
    root = Path(run_stack.__file__).parents[1]
    process = subprocess.Popen(
        [sys.executable, "bringup/record.py", *arguments, "--episodes", "1000"], cwd=root, stderr=subprocess.PIPE
    )
    deadline = time.monotonic() + 60
    while len(list(bags.glob("part*_row*/*.mcap"))) < 4 and time.monotonic() < deadline:
        time.sleep(0.1)
    process.terminate()
    process.communicate(timeout=60)
    assert process.returncode == 143
    assert len([message for bag in bags.iterdir() for message in open_bag(bag).messages()]) > 0


def test_modules_are_loaded_without_pytorchs_compiler():
    load = "from mujoban_core.plugins import *; [load_module(role, LEARNED, None, 'cpu') for role in ROLES]"
    compiler = ["torch._dynamo", "sympy"]  # some seconds of imports
    code = f"import sys; {load}; print([name for name in {compiler} if name in sys.modules])"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert ended.stdout.strip() == "[]", ended.stderr


def test_another_body_plays_with_modules_that_fit_it(tmp_path, ant_teacher, capfd):
    report, few = tmp_path / "out.json", ["--difficulty", 1, "--episodes", 1, "--time-limit", 20, "--body", "ant"]
    oracles = ["--oracle", "estimator,termination,planner"]
    assert run(evaluate, *few, *oracles, "--controller", ant_teacher, "--json", report) == 0
    content = json.loads(report.read_text())
    assert content["body"] == "ant"
    assert f"controller: weights {content['weights']['controller'][:12]}\n" in capfd.readouterr().out
    assert run(evaluate, *few, "--json", report) == 0, "by default it plays with the weights that ship for it"
    told = {role: digest(shipped_weights(role, "ant")) for role in ("estimator", "termination", "controller")}
    assert json.loads(report.read_text())["weights"].items() >= told.items()
    unfit = ["--controller", teacher_weights("ball")]
    assert run(evaluate, *few, *oracles, *unfit) == 2
    error = capfd.readouterr().err
    assert "the controller was trained for the body ball: expected weights for ant" in error
    assert run(run_stack, "--headless", *few, *oracles, *unfit) == 2
    error = capfd.readouterr().err.splitlines()[-1]
    assert error.endswith("the controller was trained for the body ball: expected weights for ant, or an oracle")
    looking = [*few, *oracles, "--controller", ant_teacher, "--look-around", 5, "--json", report]
    assert run(run_stack, "--headless", *looking) == 0
    assert json.loads(report.read_text())["played"]["look_around"] == 5


def test_levels_that_are_not_for_training_are_recorded_only_when_that_is_asked_for(capsys):
    assert recorded_seeds(None, allow_test_seeds=False) == TRAIN_SEEDS
    assert recorded_seeds(5_000_000, allow_test_seeds=True).start == 5_000_000
    assert recorded_seeds(7, allow_test_seeds=True, noted=True).start == 7
    assert not capsys.readouterr().err
    assert recorded_seeds(7, allow_test_seeds=True).start == 7
    assert capsys.readouterr().err.startswith("test levels are recorded, from seed 7 on")
    assert recorded_seeds(10_000_000, allow_test_seeds=False).start == 10_000_000
    for seed in (7, 5_000_000, 9_999_999):
        with pytest.raises(ValueError, match=r"expected one from 10000000 on .* or --allow-test-seeds"):
            recorded_seeds(seed, allow_test_seeds=False)
