"""Calls of services that nobody should make, of every service that the nodes of a run offer."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import ListParameters, SetParameters, SetParametersAtomically
from rclpy.client import Client
from rclpy.node import Node
from rclpy.task import Future

from benchmarks.malformed import spoil
from mujoban_msgs_py.ros2.session import import_type

_STRINGS: Final = ("", "\x00", "x" * 10_000, "/dev/zero", "/", "cuda", "meta", "nan", "../../../etc/passwd", "ü\n" * 99)
_NUMBERS: Final = (0.0, -1.0, 0.5, 1e308, -1e308, 5e-324, float("nan"), float("inf"), -float("inf"))
_INTEGERS: Final = (0, 1, -1, 2**31, 2**63 - 1, -(2**63))
_KINDS: Final = (*range(ParameterType.PARAMETER_NOT_SET, ParameterType.PARAMETER_STRING_ARRAY + 1), 77, 255)
_PENDING: Final = 100
"""Calls of a service without an answer after which the oldest are forgotten."""


def spoiled_request(kind: type[Any], names: list[str], rng: np.random.Generator) -> Any:
    """Return a request of a service, made of names of parameters, that its type allows and its server may not."""
    request = kind.Request()
    if kind in (SetParameters, SetParametersAtomically):
        request.parameters = [_parameter(names, rng) for _ in range(rng.integers(4))]
    elif hasattr(request, "names"):
        request.names = [_name(names, rng) for _ in range(rng.integers(4))]
    elif kind is ListParameters:
        request.prefixes = [_name(names, rng) for _ in range(rng.integers(3))]
    if request.get_fields_and_field_types() and rng.random() < 0.5:
        spoil(request, rng)
    return request


def _one(values: Sequence[Any], rng: np.random.Generator) -> Any:
    return values[int(rng.integers(len(values)))]


def _name(names: list[str], rng: np.random.Generator) -> str:
    return _one(_one((names, _STRINGS) if names else (_STRINGS,), rng), rng)


def _parameter(names: list[str], rng: np.random.Generator) -> Parameter:
    def some(values: Sequence[Any]) -> list[Any]:
        return [_one(values, rng) for _ in range(rng.integers(4))]

    value = ParameterValue(
        type=_one(_KINDS, rng), bool_value=_one((True, False), rng), double_value=_one(_NUMBERS, rng),
        integer_value=_one(_INTEGERS, rng), string_value=_one(_STRINGS, rng),
        bool_array_value=some((True, False)), integer_array_value=some(_INTEGERS),
        double_array_value=some(_NUMBERS), string_array_value=some(_STRINGS),
    )  # fmt: skip
    return Parameter(name=_name(names, rng), value=value)


class Caller:
    """Calls, with spoiled requests, every service that other nodes offer.

    Attributes:
        sent: Calls made so far, by service.
        answered: Calls that were answered, by service.
    """

    def __init__(self, node: Node, rng: np.random.Generator) -> None:
        """Call on behalf of a node; `meet` comes first."""
        self._node, self._rng = node, rng
        self._kinds: dict[str, type[Any]] = {}
        self._clients: dict[str, Client] = {}
        self._parameters: dict[str, list[str]] = {}
        self._pending: dict[str, list[Future]] = {}
        self.sent: Counter[str] = Counter()
        self.answered: Counter[str] = Counter()

    @property
    def services(self) -> list[str]:
        """Those that were met."""
        return sorted(self._clients)

    def meet(self) -> None:
        """Look for services that were not known yet, and ask nodes for the names of their parameters."""
        own = {name for name, _ in self._node.get_service_names_and_types_by_node(self._node.get_name(), "/")}
        for name, kinds in self._node.get_service_names_and_types():
            if name not in own and name not in self._clients:
                self._kinds[name] = import_type(kinds[0], "srv")
                self._clients[name] = self._node.create_client(self._kinds[name], name)
                self._pending[name] = []
            if name in self._clients and self._kinds[name] is ListParameters:
                self._clients[name].call_async(ListParameters.Request()).add_done_callback(self._learn(name))

    def _learn(self, service: str) -> Any:
        def learn(future: Future) -> None:
            response = future.result()
            if response is not None:
                self._parameters[service.rpartition("/")[0]] = list(response.result.names)

        return learn

    def act(self, count: int = 1) -> list[Future]:
        """Call each service so many times; return the answers to come."""
        calls = []
        for name, kind in self._kinds.items():
            names = self._parameters.get(name.rpartition("/")[0], [])
            calls += [self.call(name, spoiled_request(kind, names, self._rng)) for _ in range(count)]
        return calls

    def call(self, name: str, request: Any = None) -> Future:
        """Call a service, by default with the request that its type makes of nothing."""
        client, pending = self._clients[name], self._pending[name]
        future = client.call_async(self._kinds[name].Request() if request is None else request)
        future.add_done_callback(lambda _: self.answered.update([name]))
        pending[:] = [f for f in pending if not f.done()]
        pending.append(future)
        while len(pending) > _PENDING:
            client.remove_pending_request(pending.pop(0))
        self.sent[name] += 1
        return future
