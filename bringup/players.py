"""Who plays in a graph, by what its nodes say of themselves on /diagnostics."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

from diagnostic_msgs.msg import DiagnosticArray

from mujoban_core.plugins import AGENT, PRIVILEGED, ROLES
from mujoban_msgs_py.runtime.diagnostics import MODULE, WEIGHTS

_PLAYING: Final = (*ROLES, AGENT)


def players(message: DiagnosticArray, before: Mapping[str, str]) -> dict[str, str]:
    """Return role -> what plays it, as reports have them: what a message says, and else what was said `before`.

    An agent takes the place of all four modules, and they its: who looks on may see one run after the other.
    """
    found = dict[str, str]()
    for status in message.status:
        said = {value.key: value.value for value in status.values}
        role = status.name.rpartition("/")[2]
        if role in _PLAYING and MODULE in said:
            found[role] = played(said[MODULE], said.get(WEIGHTS, ""))
    kept = before if not found or (AGENT in found) == (AGENT in before) else {}
    merged = {**kept, **found}
    return {role: merged[role] for role in _PLAYING if role in merged}


def played(module: str, weights: str) -> str:
    """Return what plays a role by what its node says of module and weights, so that `is_privileged` tells it."""
    name, mark, _ = module.partition(PRIVILEGED)
    return " ".join(filter(None, (name, Path(weights).name))) + mark
