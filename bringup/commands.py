"""The installed commands, such as `mujoban-run`; each imports its program once a Ctrl-C ends it without a traceback."""

from __future__ import annotations

import sys
from importlib import import_module
from typing import NoReturn

from mujoban_core.early import end_at_once


def play() -> NoReturn:
    """`mujoban-run`: play through the graph."""
    _run("bringup.run_stack")


def evaluate() -> NoReturn:
    """`mujoban-evaluate`: success rates."""
    _run("bringup.evaluate")


def record() -> NoReturn:
    """`mujoban-record`: bags to learn from."""
    _run("bringup.record")


def train() -> NoReturn:
    """`mujoban-train`: the trainers."""
    _run("bringup.train")


def _run(program: str) -> NoReturn:
    end_at_once()
    sys.exit(import_module(program).run())
