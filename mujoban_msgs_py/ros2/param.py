"""`ros2 param list|get|set`."""

from __future__ import annotations

import argparse
import sys
from array import array
from typing import Any, Final

import yaml
from rcl_interfaces.msg import ParameterType
from rclpy.parameter import Parameter, get_parameter_value, parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient

from mujoban_msgs_py.ros2.node import find_node, node_names
from mujoban_msgs_py.ros2.session import CommandError, Session, add_discovery_options, full_name

ANSWER_LIMIT: Final = 5.0
"""Seconds within which a node has to answer."""

_LABELS: Final = {
    ParameterType.PARAMETER_BOOL: "Boolean value is:",
    ParameterType.PARAMETER_INTEGER: "Integer value is:",
    ParameterType.PARAMETER_DOUBLE: "Double value is:",
    ParameterType.PARAMETER_STRING: "String value is:",
    ParameterType.PARAMETER_BYTE_ARRAY: "Byte values are:",
    ParameterType.PARAMETER_BOOL_ARRAY: "Boolean values are:",
    ParameterType.PARAMETER_INTEGER_ARRAY: "Integer values are:",
    ParameterType.PARAMETER_DOUBLE_ARRAY: "Double values are:",
    ParameterType.PARAMETER_STRING_ARRAY: "String values are:",
}


def add_verbs(commands: Any) -> None:
    """Add the family to the parser."""
    family = commands.add_parser("param", help="Various param related sub-commands")
    verbs = family.add_subparsers(title="Commands", metavar="verb", required=True)
    parser = verbs.add_parser("get", help="Get parameter")
    parser.add_argument("node_name", help="Name of the ROS node")
    parser.add_argument("parameter_name", help="Name of the parameter")
    parser.add_argument("--hide-type", action="store_true", help="Hide the type information")
    add_discovery_options(parser)
    parser.set_defaults(run=get)
    parser = verbs.add_parser("list", help="Output a list of available parameters")
    parser.add_argument("node_name", nargs="?", help="Name of the ROS node")
    parser.add_argument("--include-hidden-nodes", action="store_true", help="Consider hidden nodes as well")
    add_discovery_options(parser)
    parser.set_defaults(run=list_parameters)
    parser = verbs.add_parser("set", help="Set parameter")
    parser.add_argument("node_name", help="Name of the ROS node")
    parser.add_argument("parameter_name", help="Name of the parameter")
    parser.add_argument("value", help="Value of the parameter")
    add_discovery_options(parser)
    parser.set_defaults(run=set_parameter)


def list_parameters(options: argparse.Namespace) -> int:
    """Print the parameters of one node or of all."""
    with Session(options) as session:
        if options.node_name:
            find_node(session, options.node_name)
            for name in _names(session, full_name(options.node_name)):
                print(f"  {name}")
            return 0
        for node in session.settle(lambda: node_names(session, hidden=options.include_hidden_nodes)):
            try:
                names = _names(session, node)
            except CommandError as error:
                print(error, file=sys.stderr)
                continue
            print(f"{node}:")
            for name in names:
                print(f"  {name}")
    return 0


def get(options: argparse.Namespace) -> int:
    """Print the value of a parameter."""
    with Session(options) as session:
        node = _require(session, options)
        answer = _answer(session, node, _client(session, node).get_parameters([options.parameter_name]))
        (value,) = answer.values
        if value.type == ParameterType.PARAMETER_NOT_SET:
            print("Parameter not set.")
            return 0
        shown = parameter_value_to_python(value)
        shown = shown.tolist() if isinstance(shown, array) else shown
        print(shown if options.hide_type else f"{_LABELS[value.type]} {shown}")
    return 0


def set_parameter(options: argparse.Namespace) -> int:
    """Set a parameter to a value given as YAML."""
    try:
        value = get_parameter_value(options.value)
    except yaml.YAMLError as error:
        raise CommandError(f"'{options.value}' is not YAML: {error}") from None
    with Session(options) as session:
        node = _require(session, options)
        parameter = Parameter(options.parameter_name, value=parameter_value_to_python(value))
        answer = _answer(session, node, _client(session, node).set_parameters([parameter]))
        (result,) = answer.results
        if not result.successful:
            raise CommandError(f"Setting parameter failed: {result.reason}")
        print("Set parameter successful" + (f": {result.reason}" if result.reason else ""))
    return 0


def _require(session: Session, options: argparse.Namespace) -> str:
    """Return the node's full name once it has been discovered and declares the parameter."""
    find_node(session, options.node_name)
    node = full_name(options.node_name)
    if options.parameter_name not in _names(session, node):
        raise CommandError(f"node {node} has no parameter '{options.parameter_name}'")
    return node


def _client(session: Session, node: str) -> AsyncParameterClient:
    client = AsyncParameterClient(session.node, node)
    if not session.until(client.services_are_ready, ANSWER_LIMIT):
        raise CommandError(f"node {node} has no parameter services")
    return client


def _answer(session: Session, node: str, future: Any) -> Any:
    if not session.until(future.done, ANSWER_LIMIT):
        raise CommandError(f"node {node} did not answer within {ANSWER_LIMIT:g} seconds")
    return future.result()


def _names(session: Session, node: str) -> list[str]:
    answer = _answer(session, node, _client(session, node).list_parameters())
    return sorted(answer.result.names)
