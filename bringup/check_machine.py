"""Says in one line what this machine lacks to run Mujoban; needs nothing but the standard library."""

from __future__ import annotations

import ctypes
import ctypes.util
import importlib.util
import os
import platform
import shutil
import sys
import sysconfig
from pathlib import Path


def missing() -> list[tuple[str, str]]:
    """Return what is missing and the Debian package that brings it."""
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    found: list[tuple[str, str]] = []
    if not shutil.which("gcc"):
        found.append(("the C compiler gcc", "gcc"))
    if not shutil.which("g++"):
        found.append(("the C++ compiler g++", "g++"))
    if not (Path(sysconfig.get_path("include")) / "Python.h").is_file():
        found.append((f"the headers of Python {version}", f"python{version}-dev"))
    if not (importlib.util.find_spec("venv") and importlib.util.find_spec("ensurepip")):
        found.append(("the Python module venv", f"python{version}-venv"))
    if not _loads("libEGL.so.1"):
        found.append(("the library libEGL.so.1", "libegl1"))
    if not (_loads("libEGL_mesa.so.0") or _has_other_egl_driver()):
        found.append(("an EGL driver", "libegl-mesa0"))
    return found


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def _has_other_egl_driver() -> bool:
    """Return whether a driver other than Mesa's is installed, as on machines with a GPU."""
    folders = ("/usr/share/glvnd/egl_vendor.d", "/etc/glvnd/egl_vendor.d")
    return any(name != "50_mesa.json" for folder in folders if os.path.isdir(folder) for name in os.listdir(folder))


def main() -> int:
    """Return 0, or 2 after one line on stderr."""
    if {"-h", "--help"} & {*sys.argv[1:]}:
        print(f"usage: {Path(sys.argv[0]).name}\n\n{__doc__}\nExit status: 0 if it lacks nothing, else 2.")
        return 0
    if sys.version_info < (3, 11):  # noqa: UP036 - that is what is checked
        print(f"error: Python {platform.python_version()} is too old: 3.11 or newer is needed", file=sys.stderr)
        return 2
    if sys.platform != "linux" or platform.machine() != "x86_64":
        print(f"error: {platform.system()} on {platform.machine()}: Linux on x86_64 is needed", file=sys.stderr)
        return 2
    lacks = missing()
    if lacks:
        what = ", ".join(what for what, _ in lacks)
        packages = " ".join(package for _, package in lacks)
        print(f"error: this machine lacks {what}: apt-get install {packages}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
