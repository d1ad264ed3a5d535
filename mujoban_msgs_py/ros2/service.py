"""`ros2 service list|type|call`."""

from __future__ import annotations

import argparse
from typing import Any

from builtin_interfaces.msg import Time
from rclpy.client import Client

from mujoban_msgs_py.ros2.messages import fill, parse_values
from mujoban_msgs_py.ros2.session import (
    CommandError,
    Session,
    add_discovery_options,
    check_rate,
    full_name,
    import_type,
    is_hidden,
)
from mujoban_msgs_py.ros2.verbs import Verbs
from mujoban_msgs_py.topics import type_name


def add_verbs(commands: Verbs) -> None:
    """Add the family to the parser."""
    family = commands.add_parser("service", help="Various service related sub-commands")
    verbs = family.add_subparsers(title="Commands", metavar="verb", required=True)
    parser = verbs.add_parser("call", help="Call a service")
    parser.add_argument("service_name", help="Name of the service to call (e.g. '/add_two_ints')")
    parser.add_argument("service_type", help="Type of the service (e.g. 'std_srvs/srv/Empty')")
    parser.add_argument("values", nargs="?", default="{}", help="Values to fill the request with in YAML format")
    parser.add_argument("-r", "--rate", type=float, metavar="N", help="Repeat the call at a specific rate in Hz")
    add_discovery_options(parser)
    parser.set_defaults(run=call)
    parser = verbs.add_parser("list", help="Output a list of available services")
    parser.add_argument("-t", "--show-types", action="store_true", help="Additionally show the service type")
    parser.add_argument("-c", "--count-services", action="store_true", help="Only display the number of services")
    parser.add_argument("--include-hidden-services", action="store_true", help="Consider hidden services as well")
    add_discovery_options(parser)
    parser.set_defaults(run=list_services)
    parser = verbs.add_parser("type", help="Output a service's type")
    parser.add_argument("service_name", help="Name of the ROS service to get type (e.g. '/talker/list_parameters')")
    add_discovery_options(parser)
    parser.set_defaults(run=show_type)


def list_services(options: argparse.Namespace) -> int:
    """Print the services."""
    with Session(options) as session:
        found = sorted(session.settle(session.node.get_service_names_and_types))
        found = [(n, types) for n, types in found if options.include_hidden_services or not is_hidden(n)]
        if options.count_services:
            print(len(found))
        else:
            for name, types in found:
                print(f"{name} [{', '.join(types)}]" if options.show_types else name)
    return 0


def show_type(options: argparse.Namespace) -> int:
    """Print a service's type; without such a service, nothing and status 1, as the genuine command."""
    name = full_name(options.service_name)
    with Session(options) as session:
        session.until(lambda: bool(_types(session, name)), session.limit)
        kinds = _types(session, name)
        print(*kinds, sep="\n", end="\n" if kinds else "")
        return 0 if kinds else 1


def _types(session: Session, name: str) -> list[str]:
    return dict(session.node.get_service_names_and_types()).get(name, [])


def _await(session: Session, client: Client, kind: str) -> None:
    """Wait for a service of a type.

    Raises:
        CommandError: At once if it is of another type, or if there is none within the time for discovery.
    """
    name = client.srv_name

    def others() -> set[str]:
        return {*_types(session, name)} - {kind}

    complaint = f"the service {name} did not become available"
    session.wait_for(lambda: client.service_is_ready() or bool(others()), complaint)
    if not client.service_is_ready():
        raise CommandError(f"the service {name} is of type {', '.join(sorted(others()))}, not {kind}")


def call(options: argparse.Namespace) -> int:
    """Call a service and print the response."""
    if options.rate is not None:
        check_rate(options.rate)
    kind: Any = import_type(options.service_type, "srv")
    name = full_name(options.service_name)
    values = parse_values(options.values)
    fill(kind.Request(), values, Time())  # what does not fit is refused before anybody is waited for
    with Session(options) as session:
        client = session.node.create_client(kind, name)
        if not client.service_is_ready():
            print("waiting for service to become available...", flush=True)
            _await(session, client, type_name(kind))
        while True:
            request = kind.Request()
            fill(request, values, session.node.get_clock().now().to_msg())
            print(f"requester: making request: {request!r}\n", flush=True)
            future = client.call_async(request)
            session.until(future.done, None)
            print(f"response:\n{future.result()!r}\n", flush=True)
            if options.rate is None:
                return 0
            session.spin_for(1 / options.rate)
