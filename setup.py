"""Builds the compiled part of the distribution: the ROS interface package `mujoban_msgs`."""

import shutil
import sys
import sysconfig
from pathlib import Path

from setuptools import find_packages, setup

HERE = Path(__file__).resolve().parent
PACKAGES = ("mujoban_*", "bringup*", "benchmarks*")

sys.path.insert(0, str(HERE / "mujoban_msgs_py"))
from interface_build import PACKAGE, ament_files, extension  # noqa: E402  # pyright: ignore[reportMissingImports]

if not (shutil.which("gcc") or shutil.which("cc")):
    sys.exit("setup.py: error: no C compiler to build the ROS messages with: apt-get install gcc g++")
if not (Path(sysconfig.get_path("include")) / "Python.h").exists():
    sys.exit("setup.py: error: no Python headers to build the ROS messages with: apt-get install python3-dev")

MESSAGES, GENERATED = HERE / "mujoban_msgs_py", HERE / "build" / "rosidl"
# A frontend asks for requirements and metadata first, for which nothing has to be generated.
building = not {"egg_info", "dist_info"} & set(sys.argv)

setup(
    # A root of "." makes an editable install one path entry, so that it finds packages added later as well.
    package_dir={"": "."},
    ext_modules=[extension(MESSAGES, GENERATED, HERE)] if building else [],
    data_files=ament_files(MESSAGES, GENERATED) if building else [],
    packages=sorted({*find_packages(include=PACKAGES), *((PACKAGE, f"{PACKAGE}.msg") if building else ())}),
)
