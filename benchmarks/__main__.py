"""All measurements in one run, as JSON: `make bench`, or `python -m benchmarks [NAME ...]`."""

from __future__ import annotations

import argparse
import importlib
import json
import os
import platform
import sys

DEFAULT = ("world", "rendering", "graph", "levels", "actors")
"""Benchmarks of speed; each has a `run` that returns a mapping."""


def main() -> int:
    """Run the benchmarks and print one JSON object."""
    parser = argparse.ArgumentParser(prog="benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", default=list(DEFAULT), metavar="NAME", help=f"some of {', '.join(DEFAULT)}")
    names = parser.parse_args().names
    unknown = sorted(set(names) - set(DEFAULT))
    if unknown:
        parser.error(f"unknown benchmark {unknown[0]!r}: expected some of {', '.join(DEFAULT)}")
    # The comparison with MuJoCo's own renderer needs a backend that works without a display.
    os.environ.setdefault("MUJOCO_GL", "egl")
    report = {
        "machine": {"cores": os.cpu_count(), "load": os.getloadavg()[0], "python": platform.python_version()},
        **{name: importlib.import_module(f"benchmarks.{name}").run() for name in names},
    }
    print(json.dumps(report, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
