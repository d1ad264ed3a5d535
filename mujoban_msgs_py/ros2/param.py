"""`ros2 param list|get|set|describe|dump`."""

from __future__ import annotations

import argparse
import sys
from array import array
from typing import Any, Final

import yaml
from rcl_interfaces.msg import ParameterDescriptor, ParameterType
from rclpy.parameter import Parameter, get_parameter_value, parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient

from mujoban_msgs_py.ros2.node import find_node, node_names
from mujoban_msgs_py.ros2.session import CommandError, Session, add_discovery_options, full_name
from mujoban_msgs_py.ros2.verbs import Verbs

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


_TYPE_NAMES: Final = {
    ParameterType.PARAMETER_BOOL: "boolean",
    ParameterType.PARAMETER_INTEGER: "integer",
    ParameterType.PARAMETER_DOUBLE: "double",
    ParameterType.PARAMETER_STRING: "string",
    ParameterType.PARAMETER_BYTE_ARRAY: "byte array",
    ParameterType.PARAMETER_BOOL_ARRAY: "boolean array",
    ParameterType.PARAMETER_INTEGER_ARRAY: "integer array",
    ParameterType.PARAMETER_DOUBLE_ARRAY: "double array",
    ParameterType.PARAMETER_STRING_ARRAY: "string array",
}


def add_verbs(commands: Verbs) -> None:
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
    _add_looks(verbs)


def _add_looks(verbs: Verbs) -> None:
    parser = verbs.add_parser("describe", help="Show descriptive information about declared parameters")
    parser.add_argument("node_name", help="Name of the ROS node")
    parser.add_argument("parameter_names", nargs="+", help="Names of the parameters")
    add_discovery_options(parser)
    parser.set_defaults(run=describe)
    parser = verbs.add_parser("dump", help="Show all of the parameters of a node in a YAML file format")
    parser.add_argument("node_name", help="Name of the ROS node")
    add_discovery_options(parser)
    parser.set_defaults(run=dump)


def describe(options: argparse.Namespace) -> int:
    """Print type, description and constraints of parameters."""
    with Session(options) as session:
        find_node(session, options.node_name)
        node = full_name(options.node_name)
        answer = _answer(session, node, _client(session, node).describe_parameters(options.parameter_names))
        for descriptor in answer.descriptors:
            _print_descriptor(descriptor)
    return 0


def _print_descriptor(descriptor: ParameterDescriptor) -> None:
    print("Parameter name:", descriptor.name)
    print("  Type:", _TYPE_NAMES.get(descriptor.type, "not set"))
    if descriptor.description:
        print("  Description:", descriptor.description)
    print("  Constraints:")
    if descriptor.read_only:
        print("    Read only: true")
    for bounds in (*descriptor.floating_point_range, *descriptor.integer_range)[:1]:
        print("    Min value:", bounds.from_value)
        print("    Max value:", bounds.to_value)
        if bounds.step:
            print("    Step:", bounds.step)
    if descriptor.additional_constraints:
        print("    Additional constraints:", descriptor.additional_constraints)


def dump(options: argparse.Namespace) -> int:
    """Print the parameters of a node as a parameter file."""
    with Session(options) as session:
        find_node(session, options.node_name)
        node = full_name(options.node_name)
        names = _names(session, node)
        answer = _answer(session, node, _client(session, node).get_parameters(names))
        tree: dict[str, Any] = {}
        for name, value in zip(names, answer.values, strict=True):
            *groups, last = name.split(".")
            branch = tree
            for group in groups:
                branch = branch.setdefault(group, {})
            content = parameter_value_to_python(value)
            branch[last] = content.tolist() if isinstance(content, array) else content
        print(yaml.safe_dump({node: {"ros__parameters": tree}}, default_flow_style=False))
    return 0


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
        said = "Set parameter successful" if result.successful else "Setting parameter failed"
        # On stderr, and with status 0, as the genuine command has it.
        print(said + (f": {result.reason}" if result.reason else ""), file=None if result.successful else sys.stderr)
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
