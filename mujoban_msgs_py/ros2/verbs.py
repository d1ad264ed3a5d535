"""What the families of the `ros2` command add their verbs to."""

from __future__ import annotations

from argparse import ArgumentParser
from typing import Protocol


class Verbs(Protocol):
    """The commands of a parser, which argparse has no public type for."""

    def add_parser(self, name: str, *, help: str) -> ArgumentParser:
        """Add a command and return its parser."""
        ...
