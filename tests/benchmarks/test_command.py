"""What each measurement promises whoever calls it."""

from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "benchmarks"
MAIN = 'if __name__ == "__main__":'


@pytest.mark.parametrize(
    "program", sorted(path.relative_to(FOLDER) for path in FOLDER.rglob("*.py") if MAIN in path.read_text()), ids=str
)
def test_a_measurement_reads_options_before_it_begins(program):
    body = (FOLDER / program).read_text().partition(MAIN)[2].split()
    assert " ".join(body).startswith(("run_benchmark(", "run_command(PROG, main)"))
