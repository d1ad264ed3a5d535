"""Build the interface package `mujoban_msgs` from msg/*.msg without CMake or ament.

Used by setup.py in the build environment, where NumPy and the ROS wheels are installed. It calls the ROS
interface generators through their Python interface and compiles what they write into one extension module.
Type hashes equal those of a CMake build, so both builds talk to each other.
"""

from __future__ import annotations

import contextlib
import io
import os
import shutil
from pathlib import Path
from typing import Final

import numpy as np
import rosidl_generator_py
from rosidl_adapter.msg import convert_msg_to_idl
from rosidl_generator_c.cli import GenerateC
from rosidl_generator_py.cli import GeneratePython
from rosidl_generator_type_description.cli import HashTypeDescription
from rosidl_pycommon import convert_camel_case_to_lower_case_underscore
from rosidl_typesupport_fastrtps_c.cli import GenerateFastRTPSCTypesupport
from rosidl_typesupport_introspection_c.cli import GenerateIntrospectionCTypesupport
from setuptools import Extension

PACKAGE: Final = "mujoban_msgs"
DEPENDENCIES: Final = ("builtin_interfaces", "geometry_msgs", "std_msgs")
TYPE_SUPPORT: Final = "rosidl_typesupport_c"

PREFIX: Final = Path(rosidl_generator_py.__file__).resolve().parents[4]
"""Root of the environment: the generators' package lies in PREFIX/lib/pythonX.Y/site-packages."""

HEADER_PACKAGES: Final = (
    *DEPENDENCIES,
    "rcutils",
    "rmw",
    "rosidl_dynamic_typesupport",
    "rosidl_runtime_c",
    "rosidl_runtime_cpp",
    "rosidl_typesupport_c",
    "rosidl_typesupport_fastrtps_c",
    "rosidl_typesupport_fastrtps_cpp",
    "rosidl_typesupport_interface",
    "rosidl_typesupport_introspection_c",
)
LIBRARY_KINDS: Final = (
    "generator_c",
    "generator_py",
    "typesupport_c",
    "typesupport_fastrtps_c",
    "typesupport_introspection_c",
)
LIBRARIES: Final = (
    *(f"{package}__rosidl_{kind}" for package in DEPENDENCIES for kind in LIBRARY_KINDS),
    "rosidl_typesupport_c",
    "rosidl_typesupport_introspection_c",
    "rosidl_typesupport_fastrtps_c",
    "rosidl_typesupport_fastrtps_cpp",
    "rosidl_runtime_c",
    "rcutils",
    "rmw",
    "fastcdr",
)

# Stands in for the dispatch that rosidl_typesupport_c generates, which opens lib<package>__<type support>.so by
# name: here every type support is linked into the extension module, so that no library search path is involved.
_DISPATCH: Final = """\
#include <string.h>
#include "rosidl_runtime_c/message_type_support_struct.h"
#include "rosidl_typesupport_c/identifier.h"
#include "rosidl_typesupport_interface/macros.h"
#include "{package}/msg/detail/{file}__functions.h"
#define SYMBOL(type_support) ROSIDL_TYPESUPPORT_INTERFACE__MESSAGE_SYMBOL_NAME(type_support, {package}, msg, {message})
typedef const rosidl_message_type_support_t * handle_t;
handle_t SYMBOL(rosidl_typesupport_fastrtps_c)(void);
handle_t SYMBOL(rosidl_typesupport_introspection_c)(void);
static handle_t find(handle_t self, const char * identifier) {{
  if (!strcmp(identifier, self->typesupport_identifier)) return self;
  if (!strcmp(identifier, "rosidl_typesupport_fastrtps_c")) return SYMBOL(rosidl_typesupport_fastrtps_c)();
  if (!strcmp(identifier, "rosidl_typesupport_introspection_c")) return SYMBOL(rosidl_typesupport_introspection_c)();
  return NULL;
}}
static rosidl_message_type_support_t handle = {{
  0, 0, find, {package}__msg__{message}__get_type_hash, {package}__msg__{message}__get_type_description,
  {package}__msg__{message}__get_type_description_sources}};
handle_t SYMBOL(rosidl_typesupport_c)(void) {{
  handle.typesupport_identifier = rosidl_typesupport_c__typesupport_identifier;
  return &handle;
}}
"""


def generate(source: Path, output: Path, python: Path) -> list[Path]:
    """Write the sources of `source`/msg/*.msg: C and C++ below `output`, the Python package as `python`/`PACKAGE`.

    Returns:
        The C and C++ files to compile.
    """
    # The generators look interfaces up in the ament index of this environment.
    os.environ["AMENT_PREFIX_PATH"] = str(PREFIX)
    source, output = source.resolve(), output.resolve()
    package, python_package = output / PACKAGE, python.resolve() / PACKAGE
    idl = output / "idl" / PACKAGE
    for folder in (output, python_package / "msg"):
        shutil.rmtree(folder, ignore_errors=True)  # A message that was removed must leave nothing behind.
    (idl / "msg").mkdir(parents=True)
    messages = sorted((source / "msg").glob("*.msg"))
    include = [PREFIX / "share" / dependency for dependency in DEPENDENCIES]
    with contextlib.redirect_stdout(io.StringIO()):
        for message in messages:
            convert_msg_to_idl(source, PACKAGE, message.relative_to(source), idl / "msg")
        tuples = [f"{idl}:msg/{message.stem}.idl" for message in messages]
        arguments = (PACKAGE, tuples, include)
        hashes = HashTypeDescription("hash").generate_type_hashes(PACKAGE, tuples, [*include, idl], output / "json")
        GenerateC("c").generate(*arguments, package, hashes)
        GenerateFastRTPSCTypesupport("fastrtps_c").generate(*arguments, package)
        GenerateIntrospectionCTypesupport("introspection_c").generate(*arguments, package)
        GeneratePython("py", typesupport_implementations=[TYPE_SUPPORT]).generate(*arguments, python_package)
    for message in messages:
        file = convert_camel_case_to_lower_case_underscore(message.stem)
        (package / f"{file}_dispatch.c").write_text(_DISPATCH.format(package=PACKAGE, message=message.stem, file=file))
    (python_package / "__init__.py").write_text('"""ROS messages of Mujoban, generated from mujoban_msgs_py/msg."""\n')
    generated = (*package.rglob("*"), *python_package.rglob("*"))
    return sorted(path for path in generated if path.suffix in {".c", ".cpp"})


def ament_files(source: Path, output: Path) -> list[tuple[str, list[str]]]:
    """Return what makes a prefix know the package: entries of the ament index, and the interfaces' definitions.

    They go below `share/` of the environment, where `ros2 interface show` and other tools look for them, also those of
    a genuine ROS 2 that has the environment on its AMENT_PREFIX_PATH.

    Args:
        source: Folder with package.xml and msg/.
        output: What `generate` has written to; the entries are added there.

    Returns:
        (folder, files) as setuptools takes data files, the files relative to the working directory.
    """
    messages = sorted(path.stem for path in (source / "msg").glob("*.msg"))
    interfaces = [f"msg/{name}.{kind}" for name in messages for kind in ("idl", "msg")]
    index = {
        "packages": "",
        "rosidl_interfaces": "\n".join(interfaces),
        "package_run_dependencies": ";".join((*DEPENDENCIES, "rosidl_default_runtime")),
    }
    files = []
    for kind, text in index.items():
        marker = output / "ament_index" / kind / PACKAGE
        marker.parent.mkdir(parents=True, exist_ok=True)
        marker.write_text(text)
        files.append((f"share/ament_index/resource_index/{kind}", [os.path.relpath(marker)]))
    definitions = (*(source / "msg").glob("*.msg"), *(output / "idl" / PACKAGE / "msg").glob("*.idl"))
    files.append((f"share/{PACKAGE}", [os.path.relpath(source / "package.xml")]))
    files.append((f"share/{PACKAGE}/msg", sorted(os.path.relpath(path) for path in definitions)))
    return files


def extension(source: Path, output: Path, python: Path) -> Extension:
    """Generate the sources and return the extension module that holds the type support of all messages."""
    sources = generate(source, output, python)
    return Extension(
        f"{PACKAGE}.{PACKAGE}_s__{TYPE_SUPPORT}",
        [os.path.relpath(path) for path in sources],
        include_dirs=[
            str(output),
            np.get_include(),
            str(PREFIX / "include"),
            *(str(PREFIX / "include" / package) for package in HEADER_PACKAGES),
        ],
        library_dirs=[str(PREFIX / "lib")],
        libraries=list(LIBRARIES),
        define_macros=[("ROS_PACKAGE_NAME", f'"{PACKAGE}"')],
    )
