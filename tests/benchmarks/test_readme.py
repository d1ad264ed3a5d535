"""The README's command blocks run as they are written, and what runs them notices when one does not."""

import re

import pytest

from benchmarks import readme
from benchmarks.paper import runs, tables
from benchmarks.readme import Command, Options, Source
from benchmarks.running import ROOT

PAGE = """
Words, then commands:

    one --option \\
        value    # paced by the clock; in a second terminal:
    ros2 topic list
    two

```mermaid
    no command
```
```python
# my_file.py
import os

    # no command either
```
"""


def test_a_page_is_read_as_files_and_commands_in_their_order():
    one, two, source = readme.read_page(PAGE)
    assert isinstance(one, Command) and one.beside == ("ros2 topic list",) and two == Command("two")
    assert one.line.split("#")[0].split() == ["one", "--option", "value"]
    assert isinstance(source, Source) and source.name == "my_file.py" and "import os" in source.text
    with pytest.raises(ValueError, match="expected a first line that names the file"):
        readme.read_page("```python\nimport os\n```\n")


def test_no_line_of_the_readmes_blocks_is_left_out():
    text = (ROOT / "README.md").read_text()
    parts = readme.read_page(text)
    lines = [line for c in parts if isinstance(c, Command) for line in (c.line, *c.beside)]
    outside = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    assert lines == [line.strip() for line in outside.splitlines() if line.startswith("    ")]
    assert [part.name for part in parts if isinstance(part, Source)] == ["my_planner.py"]


@pytest.mark.parametrize(
    ("title", "row"),
    [
        ("all four modules learned", "default"),
        ("the same, as nodes of the ROS graph", "graph"),
        ("with ground truth for what is sensed", "planner_controller"),
        ("with a perfect plan as well: the controller alone", "controller"),
    ],
)
def test_the_readmes_table_says_what_was_measured_and_with_which_weights(title, row):
    (run,) = (run for run in runs.ALL if run.name == row)
    report = runs.load(run)
    assert report is not None
    stale = tables.STALE if runs.is_stale(report, run) else ""
    assert f"| {title}{stale} | {100 * report['success_rate']:.1f} % |" in (ROOT / "README.md").read_text()


@pytest.mark.parametrize(
    ("line", "limit", "stopped", "faults"),
    [
        ("echo fine", 9.0, False, ()),
        ("echo; false", 9.0, False, ("status 1", "says nothing")),
        ("python -c 1/0", 9.0, False, ("status 1", "a traceback")),
        ("echo --json out.json", 9.0, False, ("out.json is missing",)),
        ("echo on and on; exec sleep 60", 0.05, True, ()),
    ],
)
def test_what_a_command_does_not_do_as_promised_is_told(tmp_path, line, limit, stopped, faults):
    (tmp_path / ".venv" / "bin").mkdir(parents=True)
    (tmp_path / ".venv" / "bin" / "activate").touch()
    (outcome,) = readme.play(Command(line), tmp_path, Options(limit=limit))
    assert (outcome.stopped, outcome.faults) == (stopped, faults)


@pytest.mark.parametrize("command", ["evaluate.py --planner my_planner", "run_stack.py --planner my_planner"])
def test_a_module_that_the_readme_writes_plays_as_the_readme_says(command):
    report = readme.run(Options(only=(command,), limit=8.0))
    assert report["in_order"] == 1 and len(report["commands"]) == 1, report["commands"]
