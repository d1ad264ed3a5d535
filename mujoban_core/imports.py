"""Importing what the environment would keep from being imported."""

from __future__ import annotations

import importlib
import os


def import_without(variable: str, module: str) -> None:
    """Import a module as if a variable of the environment, which is set, were not."""
    value = os.environ.pop(variable)
    try:
        importlib.import_module(module)
    finally:
        os.environ[variable] = value
