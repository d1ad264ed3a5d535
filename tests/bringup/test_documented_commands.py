"""The commands of the README and the guides, as they stand there, read by the programs' own parsers."""

import importlib
import re
import shlex
from pathlib import Path

import pytest

import mujoban_core.program

ROOT = Path(__file__).parents[2]
GUIDES = sorted((ROOT / "docs").glob("*.md"))
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "docs" / "results" / "README.md", *GUIDES]
_SCRIPTS = {"mujoban-run": "run_stack", "mujoban-evaluate": "evaluate", "mujoban-record": "record"}


def commands(page: Path) -> list[str]:
    """Return the commands of a page, whole though over several lines: indented, fenced or alone in a table's cell."""
    text = page.read_text().replace("\\\n", " ")
    blocks = re.findall(r"^```(\w*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    fenced = "\n".join(block for language, block in blocks if language in ("", "sh", "bash"))
    command = r"(?:python|mujoban-(?:run|evaluate|record)|make) "
    indented = re.findall(rf"^ {{4,}}({command}.*)$", text, re.MULTILINE)
    cells = re.findall(rf"\| `({command}[^`]*)` \|", text)
    return indented + re.findall(rf"^({command}.*)$", fenced, re.MULTILINE) + cells


def program(words: list[str]) -> tuple[str, list[str]]:
    """Return a command's module and arguments."""
    if words[0] in _SCRIPTS:
        return f"bringup.{_SCRIPTS[words[0]]}", words[1:]
    if words[1] == "-m":
        return words[2], words[3:]
    return words[1].removesuffix(".py").replace("/", "."), words[2:]


class Read(Exception):
    """The options were understood."""


OTHERS = ("make", "python my_")
"""Starts of commands that are no programs of the repository; what readers save as `my_agent.py` has tests beside."""


@pytest.mark.parametrize("command", sorted({c for page in PAGES for c in commands(page) if not c.startswith(OTHERS)}))
def test_a_documented_command_exists_and_understands_its_options(command, monkeypatch):
    module, arguments = program(shlex.split(command, comments=True))
    assert importlib.util.find_spec(module) is not None
    if "--ros-args" in arguments:  # whose options are ROS's
        return
    read = mujoban_core.program.read_options
    found = importlib.import_module(module)
    if not hasattr(found, "read_options"):  # nodes and benchmarks
        assert not arguments
        return

    def read_and_stop(*arguments, **options):
        read(*arguments, **options)
        raise Read

    monkeypatch.setattr(found, "read_options", read_and_stop)
    with pytest.raises((Read, SystemExit)) as ended:
        found.main(arguments)
    assert ended.type is Read or "--help" in arguments


SMALL = {
    "bringup.record": "--episodes 2 --difficulty 1 --processes 1 --look-around 3 --look-ahead 0 --time-limit 40",
    "mujoban_estimator.train": "--steps 1 --streams 1 --length 8 --workers 0",
    "mujoban_planner.train imitation": "--samples 4 --batch-size 4",
    "mujoban_planner.train mpo": "--updates 1 --batch-size 4",
    "mujoban_controller.train --stage distil": "--steps 16 --evaluation-episodes 0 --task.batch 2 --distil.first 16 "
    "--distil.windows 2",
    "mujoban_controller.train --stage mpo": "--steps 64 --evaluation-episodes 0 --task.batch 2 --asymmetric.first 64 "
    "--asymmetric.windows 2 --asymmetric.critic-first 1 --asymmetric.critic-windows 2",
}
"""Budgets of a moment for each kind of command in the round of docs/bags.md."""


def test_the_round_through_bags_trains_every_module_as_it_is_printed(tmp_path, monkeypatch):
    monkeypatch.setattr("mujoban_planner.validation._EPISODES", {1: 4})
    monkeypatch.chdir(tmp_path)
    for package in ("mujoban_estimator", "mujoban_planner", "mujoban_controller"):
        (tmp_path / package / "weights").parent.mkdir()
        (tmp_path / package / "weights").symlink_to(ROOT / package / "weights")
    walked = []
    for command in commands(ROOT / "docs" / "bags.md"):
        module, arguments = program(shlex.split(command, comments=True))
        (kind,) = (kind for kind in SMALL if " ".join([module, *arguments]).startswith(kind))
        walked.append(kind)
        assert importlib.import_module(module).main([*arguments, *SMALL[kind].split()]) == 0, command
    assert set(walked) == set(SMALL) and walked[-1] == "bringup.record"
    assert len(list((tmp_path / "bags" / "round2").iterdir())) == 2


def test_commands_in_fences_in_steps_of_a_list_and_in_tables_are_read_too():
    found = {page.name: " ".join(commands(page)) for page in GUIDES}
    assert "--stage distil" in found["controller.md"] and "mujoban_estimator.evaluate" in found["estimator.md"]
    assert "--start" in found["adding_a_body.md"] and "mujoban_sim.node" in found["graph.md"]


def test_a_documented_target_of_make_exists():
    targets = re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    named = {shlex.split(c, comments=True)[1] for page in PAGES for c in commands(page) if c.startswith("make ")}
    assert {"run", "test"} <= named <= set(targets)
