"""Find the module that plays a role: the learned one, its oracle, or a class of the user's own.

Modules are named by strings, so that this table can stand upstream of the packages that it names.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from mujoban_sim.interfaces import Controller, Estimator, Module, Planner, Termination

LEARNED: Final = "learned"
ORACLE: Final = "oracle"


class PluginError(ValueError):
    """A module cannot be found or does not fit its role."""


@dataclass(frozen=True)
class Role:
    """One of the four places in sense-plan-act."""

    interface: type[Module]
    learned: str
    """`package:function` which loads the shipped or given weights: `(path, device) -> Module`."""
    shipped: str
    """`package:PATH` of the weights that ship."""
    oracle: str
    """`package:Class` of the privileged stand-in."""


ROLES: Final[dict[str, Role]] = {
    "estimator": Role(
        Estimator, "mujoban_estimator:load", "mujoban_estimator:SHIPPED", "mujoban_sim.oracles:OracleEstimator"
    ),
    "termination": Role(
        Termination,
        "mujoban_estimator:load_termination",
        "mujoban_estimator:SHIPPED_TERMINATION",
        "mujoban_sim.oracles:OracleTermination",
    ),
    "planner": Role(Planner, "mujoban_planner:load", "mujoban_planner:SHIPPED", "mujoban_sim.oracles:OraclePlanner"),
    "controller": Role(
        Controller, "mujoban_controller:load", "mujoban_controller:SHIPPED", "mujoban_sim.oracles:OracleController"
    ),
}


def load_module(role: str, source: str = LEARNED, weights: Path | None = None, device: str = "cpu") -> Module:
    """Return the module for a role.

    Args:
        role: One of `ROLES`.
        source: "learned", "oracle" or `package.module:Class`, whose instances are made without arguments.
        weights: Weights of the learned module instead of those that ship.
        device: Device of the learned module.

    Raises:
        PluginError: If the role or the class is unknown, or an instance is not of the role's interface.
        ValueError: If weights are missing or damaged.
    """
    if role not in ROLES:
        raise PluginError(f"unknown module {role!r}: expected one of {', '.join(ROLES)}")
    entry = ROLES[role]
    if source == LEARNED:
        module = _resolve(entry.learned)(weights, device)
    else:
        module = _resolve(entry.oracle if source == ORACLE else source)()
    if not isinstance(module, entry.interface):
        expected = f"mujoban_sim.interfaces.{entry.interface.__name__}"
        raise PluginError(f"{source} is a {type(module).__name__}: the {role} must be a {expected}")
    return module


def shipped_weights(role: str) -> Path:
    """Return where the weights of the learned module for a role are."""
    return Path(_resolve(ROLES[role].shipped))


def _resolve(name: str) -> Any:
    module, colon, attribute = name.partition(":")
    if not (module and colon and attribute):
        raise PluginError(f"{name!r} names no class: expected package.module:Class")
    try:
        return getattr(importlib.import_module(module), attribute)
    except ModuleNotFoundError as error:
        raise PluginError(f"{name!r}: {error}") from error
    except AttributeError as error:
        raise PluginError(f"{name!r}: {module} has no {attribute}") from error
