"""The server of the live view: Rerun's own program, in a process that ends with the node that feeds it.

Rerun's SDK would serve from within, but on every interface of the machine; its program takes an address.
Run as ``python -m bringup.live_server``, with the arguments of that program.
"""

from __future__ import annotations

import ipaddress
import json
import os
import signal
import socket
import sys
import time
from pathlib import Path
from typing import Final, NoReturn
from urllib.parse import quote

import rerun_cli

from bringup.options import LOOPBACK, address_family, check_own_address
from mujoban_core import children
from mujoban_msgs_py.runtime.shared_memory import RunFolder

_MEMORY: Final = "256MiB"
"""What the server keeps for a browser that opens the page later."""
_START_LIMIT: Final = 60.0
"""Seconds that the server has to start."""
_PORTS: Final = 50
"""Ports that are tried for one that is free."""


class LiveServer:
    """Serves a page with the viewer, and the stream that it shows.

    Attributes:
        stream: Address to which a `rerun.RecordingStream` connects.
        page: Address for the browser.
        folder: What the server's settings lie in; the next run removes that of one that was killed.
    """

    def __init__(self, address: str, grpc_port: int, web_port: int) -> None:
        """Start the server.

        Args:
            address: IP address of the interface to listen on; 0.0.0.0 or :: for all.
            grpc_port: Port of the stream, or the next free one.
            web_port: Port of the page, or the next free one.

        Raises:
            ValueError: If the address is none of this machine.
            OSError: If no port is free, or the server does not start.
        """
        grpc_port, web_port = free_port(grpc_port, address), free_port(web_port, address)
        unspecified = ipaddress.ip_address(address).is_unspecified
        self.stream = f"rerun+http://{_host(LOOPBACK if unspecified else address)}:{grpc_port}/proxy"
        seen = socket.gethostname() if unspecified else _host(address)
        self.page = f"http://{seen}:{web_port}/?url={quote(f'rerun+http://{seen}:{grpc_port}/proxy', safe=':/')}"
        self.folder = RunFolder()
        command = (
            sys.executable, "-m", "bringup.live_server", "--serve-web", "--bind", address, "--port", str(grpc_port),
            "--web-viewer-port", str(web_port), "--server-memory-limit", _MEMORY,
        )  # fmt: skip
        self._process = children.start(command, _private(self.folder.path))
        try:
            for port in (grpc_port, web_port):
                self._await(LOOPBACK if unspecified else address, port)
        except BaseException:
            self.close()
            raise

    def _await(self, address: str, port: int) -> None:
        """Wait until the server takes connections: a stream that comes too early gives up for good."""
        deadline = time.monotonic() + _START_LIMIT
        while self._process.poll() is None and time.monotonic() < deadline:
            try:
                socket.create_connection((address, port), timeout=1.0).close()
                return
            except OSError:
                time.sleep(0.05)
        raise OSError(f"the live view's server does not answer on {address}, port {port}")

    def close(self) -> None:
        """Stop serving."""
        children.stop([self._process])
        self.folder.remove()


def _host(address: str) -> str:
    return f"[{address}]" if ":" in address else address


def _private(folder: Path) -> dict[str, str]:
    """Return the environment in which the server reports nothing of its use to anybody, and logs only errors."""
    file = folder / "rerun" / "analytics.json"
    file.parent.mkdir()
    settings = {"analytics_enabled": False, "analytics_id": "none", "metadata": {}}
    file.write_text(json.dumps({**settings, "config_file_path": str(file), "data_dir_path": str(folder)}))
    return {"XDG_CONFIG_HOME": str(folder), "RUST_LOG": "error"}


def free_port(first: int, address: str = LOOPBACK) -> int:
    """Return the first port from `first` on that nobody listens on at an IP address of this machine.

    Raises:
        ValueError: If the address is none of this machine.
        OSError: If there is none near.
    """
    try:
        check_own_address(address)
    except OSError as error:
        raise ValueError(f"address {address}: {error.strerror}; expected one of this machine") from error
    for port in range(first, first + _PORTS):
        with socket.socket(address_family(address)) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((address, port))
            except OSError:
                continue
            return port
    raise OSError(f"the ports from {first} to {first + _PORTS - 1} are all taken")


def main() -> NoReturn:
    """Become the server."""
    children.end_with_parent()
    # A parent that heeds signals itself has blocked them, and a program inherits that.
    signal.pthread_sigmask(signal.SIG_SETMASK, [])
    program = str(Path(rerun_cli.__file__).parent / "rerun")
    os.execv(program, [program, *sys.argv[1:]])


if __name__ == "__main__":
    main()
