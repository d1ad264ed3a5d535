"""Find the module that plays a role: the learned one, its oracle, or a class of the user's own.

Packages offer modules through entry points of the group `mujoban.modules`, named `ROLE.NAME`, so that nothing here
knows a package downstream. `learned` and `oracle` are such names; a distribution of the user's own may add others,
which every program then accepts: `--planner NAME`. An entry point leads to a module's class, whose instances are made
without arguments, or to a function `(weights, device) -> Module`. `ROLE.weights` leads to the weights that ship.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Final, TypeVar

from mujoban_core.agent import Agent
from mujoban_core.interfaces import Controller, Estimator, Module, Planner, Termination
from mujoban_core.look_around import Scout

LEARNED: Final = "learned"
ORACLE: Final = "oracle"

PRIVILEGED: Final = " (privileged)"
"""Ends the name of what receives the ground truth, other than an oracle."""
TOLD: Final = "privileged, told the ground truth"
"""What reports and views say of the roles that `privileged_roles` returns."""

GROUP: Final = "mujoban.modules"
"""The entry points' group."""

ROLES: Final[dict[str, type[Module]]] = {
    "estimator": Estimator,
    "termination": Termination,
    "planner": Planner,
    "controller": Controller,
}
"""The four places in sense-plan-act and the interface of each."""

AGENT: Final = "agent"
"""The role of what plays alone, in the place of all four."""

SCOUT: Final = "scout"
"""The role of what says where to look before pushing; a part of the planner's wrapper, not a module."""
SCRIPTED: Final = "scripted"
"""The scout that goes by a rule."""

_SHIPPED: Final = "weights"
_UNSHIPPED: Final = (AGENT, SCOUT)
"""Roles of which no learned one ships."""
Made = TypeVar("Made")


class PluginError(ValueError):
    """A module cannot be found or does not fit its role."""


def load_module(role: str, source: str = LEARNED, weights: Path | None = None, device: str = "cpu") -> Module:
    """Return the module for a role.

    Args:
        role: One of `ROLES`, or `AGENT`.
        source: Name of an entry point of the role ("learned", "oracle"), or `package.module:Class`, whose instances
            are made without arguments.
        weights: Weights of the learned module instead of those that ship; None for one that takes none.
        device: Device of the learned module.

    Raises:
        PluginError: If the role or the class is unknown, cannot be made without arguments, or takes no weights and is
            given some, or an instance is not of the role's interface.
        ValueError: If weights are missing or damaged.
    """
    return _make(role, _interface(role), source, weights, device)


def trained_body(module: Module | Scout) -> str | None:
    """Return the name of the body that a learned module was trained for, or None if it does not say so."""
    config = getattr(module, "config", {})
    return config.get("body") if isinstance(config, dict) else getattr(config, "body", None)


def check_body(role: str, module: Module | Scout, body: str) -> None:
    """Raise a `ValueError` if a learned module was trained for another body than the one that is played."""
    trained = trained_body(module)
    if trained not in (None, body):
        other = f"the {SCRIPTED} one" if role == SCOUT else "an oracle"
        raise ValueError(f"the {role} was trained for the body {trained}: expected weights for {body}, or {other}")


def load_scout(source: str, weights: Path | None = None, device: str = "cpu", body: str | None = None) -> Scout:
    """Return what says where to look before pushing.

    Args:
        source: "scripted", "learned", the name of another entry point `scout.NAME`, or `package.module:Class`.
        weights: Weights of the learned one; none ship.
        device: Device of the learned one.
        body: The body that is played, if it is known.

    Raises:
        PluginError: If it is unknown, or no `Scout`.
        ValueError: If weights are missing, damaged or of another body.
    """
    if source == LEARNED and weights is None:
        weights = shipped_weights(SCOUT)
    scout = _make(SCOUT, Scout, source, weights, device)
    if body is not None:
        check_body(SCOUT, scout, body)
    return scout


def _make(role: str, interface: type[Made], source: str, weights: Path | None, device: str) -> Made:
    make = _resolve(source) if ":" in source else _load(role, source)
    if not callable(make):
        raise PluginError(f"{source} is a {type(make).__name__}: expected a class or a function that makes a {role}")
    plain = ":" in source or isinstance(make, type)
    if plain and weights is not None:
        raise PluginError(f"the {role} {source} takes no weights, expected none; got {weights}")
    module = _without_arguments(role, source, make) if plain else make(weights, device)
    if not isinstance(module, interface):
        expected = f"{interface.__module__}.{interface.__name__}"
        raise PluginError(f"{source} is a {type(module).__name__}, expected as {role} a {expected}")
    return module


def _without_arguments(role: str, source: str, make: Callable[[], object]) -> object:
    try:
        return make()
    except TypeError as error:
        raise PluginError(f"{source}: {error}, expected a {role} that is made without arguments") from error


def check_told(role: str, source: str, asks: bool, told: bool | None) -> None:
    """Raise a `PluginError` if what plays asks for the ground truth otherwise than a report says.

    A report is written of one instance, and another may play: made by a node, on another machine, or again after a
    crash. So whatever is about to play is held to what was said. That is the whole of the rule: an instance gets its
    inputs, and the ground truth where it was named. Plugins are code and run with the user's rights; one that looks
    through the interpreter (`gc`, frames), other processes or files, opens a node of its own, or makes the levels
    itself from seeds that it guesses is for whoever names it to find out (docs/security.md).

    Args:
        role: Of `ROLES`, or `AGENT`.
        source: What it was loaded from.
        asks: Whether the instance that is to play asks for the ground truth.
        told: Whether the report says so; None where it says so in any case.
    """
    if told is not None and asks != told:
        asking, other = ("asks", "did not") if asks else ("does not ask", "did")
        raise PluginError(
            f"the {role} {source} {asking} for the ground truth where another instance {other}: expected all to be "
            "alike, as reports name them"
        )


def is_privileged(identity: str) -> bool:
    """Tell from what a report calls a module whether it is told the ground truth."""
    return identity == ORACLE or identity.endswith(PRIVILEGED)


def privileged_roles(weights: Mapping[str, str]) -> list[str]:
    """Return which of the roles of a report's `weights` are told the ground truth: its entry `privileged`."""
    return [role for role, identity in weights.items() if is_privileged(identity)]


def shipped_weights(role: str, body: str | None = None) -> Path:
    """Return where the weights of the learned module for a role are.

    Those of a body lie beside: `controller_ant.safetensors` for the body "ant". Where there are none, those of the
    default body are meant, which may fit (a planner's do) or not (`check_body`).

    Raises:
        PluginError: If there is no such role, or none of it ship.
    """
    if role in _UNSHIPPED:
        raise PluginError(f"the {LEARNED} {role}: none of its weights ship, expected some (.safetensors)")
    _interface(role)
    path = Path(str(_load(role, _SHIPPED)))
    own = path.with_stem(f"{role}_{body}")
    return own if own.is_file() else path


def chosen_weights(role: str, source: str, weights: Path | None, body: str) -> Path | None:
    """Return which weights a module of a body loads: those given, or those that ship for the body alone, or None.

    None leaves those that ship for the default body, or a module that has no weights.
    """
    if weights is not None or source != LEARNED:
        return weights
    own = shipped_weights(role, body)
    return None if own == shipped_weights(role) else own


def _interface(role: str) -> type[Module]:
    interfaces: dict[str, type[Module]] = {**ROLES, AGENT: Agent}
    try:
        return interfaces[role]
    except KeyError:
        raise PluginError(f"unknown module {role!r}: expected one of {', '.join(interfaces)}") from None


@cache
def _offered() -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in entry_points(group=GROUP)}


def _load(role: str, name: str) -> object:
    """Return what the entry point `ROLE.NAME` leads to."""
    entry = _offered().get(f"{role}.{name}")
    if entry is None:
        names = sorted(n.partition(".")[2] for n in _offered() if n.startswith(f"{role}."))
        unnamed = (_SHIPPED, LEARNED) if role in _UNSHIPPED else (_SHIPPED,)
        known = ", ".join(n for n in names if n not in unnamed) or "none is installed: run make setup"
        expected = f"package.module:Class, weights (.safetensors) or one of {known}"
        raise PluginError(f"no {role} is named {name!r}: expected {expected}")
    try:
        return entry.load()
    except (ImportError, AttributeError) as error:
        raise PluginError(f"{role} {name!r} ({entry.value}): {error}") from error


def _resolve(name: str) -> object:
    module, colon, attribute = name.partition(":")
    if not (module and colon and attribute):
        raise PluginError(f"{name!r} names no class: expected package.module:Class")
    try:
        return getattr(importlib.import_module(module), attribute)
    except ImportError as error:
        raise PluginError(f"{name!r}: {error}, expected package.module:Class that Python finds") from error
    except AttributeError as error:
        raise PluginError(f"{name!r}: {module} has no {attribute}, expected a class in it") from error
