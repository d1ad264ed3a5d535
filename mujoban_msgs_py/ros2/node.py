"""`ros2 node list|info`."""

from __future__ import annotations

import argparse
from collections.abc import Iterable

from mujoban_msgs_py.ros2.session import CommandError, Session, add_discovery_options, full_name, is_hidden
from mujoban_msgs_py.ros2.verbs import Verbs


def add_verbs(commands: Verbs) -> None:
    """Add the family to the parser."""
    family = commands.add_parser("node", help="Various node related sub-commands")
    verbs = family.add_subparsers(title="Commands", metavar="verb", required=True)
    parser = verbs.add_parser("info", help="Output information about a node")
    parser.add_argument("node_name", help="Fully qualified node name to request information")
    parser.add_argument("--include-hidden", action="store_true", help="Display hidden topics and services as well")
    add_discovery_options(parser)
    parser.set_defaults(run=show_info)
    parser = verbs.add_parser("list", help="Output a list of available nodes")
    parser.add_argument("-a", "--all", action="store_true", help="Display all nodes even hidden ones")
    parser.add_argument("-c", "--count-nodes", action="store_true", help="Only display the number of nodes")
    add_discovery_options(parser)
    parser.set_defaults(run=list_nodes)


def node_names(session: Session, *, hidden: bool = False) -> list[str]:
    """Return the full names of the nodes discovered so far."""
    pairs = session.node.get_node_names_and_namespaces()
    names = sorted(f"{namespace.rstrip('/')}/{name}" for name, namespace in pairs)
    return [name for name in names if hidden or not is_hidden(name)]


def find_node(session: Session, name: str) -> tuple[str, str]:
    """Return (name, namespace) of a node once it has been discovered.

    Raises:
        CommandError: If there is no such node.
    """
    full = full_name(name)
    session.wait_for(lambda: full in node_names(session, hidden=True), f"unable to find node '{name}'")
    namespace, _, base = full.rpartition("/")
    return base, namespace or "/"


def list_nodes(options: argparse.Namespace) -> int:
    """Print the nodes."""
    with Session(options) as session:
        names = session.settle(lambda: node_names(session, hidden=options.all))
        if options.count_nodes:
            print(len(names))
        else:
            for name in names:
                print(name)
    return 0


def show_info(options: argparse.Namespace) -> int:
    """Print what a node publishes, subscribes to, serves and calls."""
    with Session(options) as session:
        name, namespace = find_node(session, options.node_name)
        node = session.node
        questions = {
            "Subscribers": node.get_subscriber_names_and_types_by_node,
            "Publishers": node.get_publisher_names_and_types_by_node,
            "Service Servers": node.get_service_names_and_types_by_node,
            "Service Clients": node.get_client_names_and_types_by_node,
        }
        try:
            answers = session.settle(lambda: {title: ask(name, namespace) for title, ask in questions.items()})
        except RuntimeError as error:
            raise CommandError(f"node '{options.node_name}' has gone: {error}") from None
        print(full_name(options.node_name))
        for title, answer in answers.items():
            _print_section(title, answer, options.include_hidden)
        for title in ("Action Servers", "Action Clients"):
            # Mujoban has no actions; the genuine command always names these sections.
            _print_section(title, [], options.include_hidden)
    return 0


def _print_section(title: str, entries: Iterable[tuple[str, list[str]]], hidden: bool) -> None:
    print(f"  {title}:")
    for name, types in sorted(entries):
        if hidden or not is_hidden(name):
            print(f"    {name}: {', '.join(types)}")
    print()
