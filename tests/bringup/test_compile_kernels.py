"""`make setup` compiles all that a first run would otherwise wait for, deaf to Ctrl-C meanwhile."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

_SCRIPT = """
import gc
from pathlib import Path
from numba.core.dispatcher import Dispatcher
from bringup import compile_kernels, record
from bringup.command import Stack
from bringup.stack import PlayOptions, play
from mujoban_sokoban.episodes import Episodes
from mujoban_sokoban.generator import TRAIN_SEEDS, VALIDATION_SEEDS

def compiled():
    kernels = [x for x in gc.get_objects() if issubclass(type(x), Dispatcher)]
    return {(k.py_func.__qualname__, signature) for k in kernels for signature in k.signatures}

compile_kernels.main()
before = compiled()
play(Stack(), Episodes(1, VALIDATION_SEEDS.start, difficulty=5), PlayOptions(time_limit=100))
options = record.Options(out=Path("bags"), episodes=6, time_limit=60)
record.record(record._job(options, TRAIN_SEEDS.start, 0))
print(*compiled() - before, sep="\\n", end="")
"""


def test_a_run_and_a_recording_compile_nothing_more_after_setup(tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, "-c", _SCRIPT], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""
