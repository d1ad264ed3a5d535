"""How benchmarks are called: options as in all programs, a report on standard output."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any, NoReturn, TypeVar

from mujoban_core.program import read_options, run_command

OptionsT = TypeVar("OptionsT")


def run_benchmark(
    prog: str,
    options: type[OptionsT],
    measure: Callable[[OptionsT], Mapping[str, Any] | str],
    description: str | None = None,
) -> NoReturn:
    """Read the options, measure, print the report as JSON, or as it is if it is a text, and end the process."""

    def command() -> int:
        report = measure(read_options(options, None, prog, description))
        print(report if isinstance(report, str) else json.dumps(report, indent=2))
        return 0

    run_command(prog, command)
