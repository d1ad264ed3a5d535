"""The live view in a browser, and that nothing of it is loaded unless it is asked for."""

import json
import os
import re
import shutil
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from bringup.run_stack import Options
from mujoban_core.program import read_options
from mujoban_msgs_py.runtime.shared_memory import clear_shared_memory

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update", "--enable-unsafe-swiftshader",
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE localhost, EXCLUDE 127.0.0.1",
)  # fmt: skip
STARTED = """
new Promise(resolve => {
  const look = () => {
    const canvas = document.querySelector("canvas");
    const app = window._handle;
    if (app && canvas.className === "visible") {
      resolve({title: document.title, panicked: app.has_panicked(), canvas: canvas.width > 0});
    } else {
      setTimeout(look, 200);
    }
  };
  look();
})
"""
"""Waits until the viewer, which is WebAssembly, has started."""


class Page:
    """A page in a headless Chromium, driven through its debugging pipe (the DevTools protocol)."""

    def __init__(self, profile):
        commands, self._commands = os.pipe()
        self._answers, answers = os.pipe()
        # The shell puts the pipes where Chromium looks for them.
        shell = f'exec "$0" "$@" 3<&{commands} 4>&{answers}'
        flags = (*FLAGS, f"--user-data-dir={profile}", "--remote-debugging-pipe", "about:blank")
        self._process = subprocess.Popen(
            ["bash", "-c", shell, CHROMIUM, *flags], pass_fds=(commands, answers), stderr=subprocess.DEVNULL
        )
        os.close(commands)
        os.close(answers)
        self._read, self._number, self._session = b"", 0, {}
        target = self._call("Target.createTarget", url="about:blank")["targetId"]
        session = self._call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self._session = {"sessionId": session}
        self.requests = []
        self._call("Network.enable")

    def close(self):
        self._process.terminate()
        self._process.wait()
        os.close(self._commands)
        os.close(self._answers)

    def open(self, url, script):
        """Open an address and return what a script says of it."""
        self._call("Page.enable")
        self._call("Page.navigate", url=url)
        self._await(lambda message: message.get("method") == "Page.loadEventFired")
        answer = self._call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        return answer["result"]["value"]

    def await_request(self, part):
        """Wait until the page asks for an address with this part."""
        if not any(part in url for url in self.requests):
            self._await(lambda message: part in message.get("params", {}).get("request", {}).get("url", ""))

    def _call(self, method, **parameters):
        self._number += 1
        command = {"id": self._number, "method": method, "params": parameters, **self._session}
        os.write(self._commands, json.dumps(command).encode() + b"\0")
        return self._await(lambda message: message.get("id") == self._number)["result"]

    def _await(self, wanted):
        while True:
            while b"\0" not in self._read:
                received = os.read(self._answers, 1 << 16)
                assert received, "Chromium has ended"
                self._read += received
            one, _, self._read = self._read.partition(b"\0")
            message = json.loads(one)
            if message.get("method") == "Network.requestWillBeSent":
                self.requests.append(message["params"]["request"]["url"])
            if wanted(message):
                return message


@pytest.fixture
def page(tmp_path):
    if CHROMIUM is None:
        pytest.skip("no Chromium on this machine: apt-get install chromium")
    page = Page(tmp_path / "profile")
    yield page
    page.close()


@pytest.fixture
def live_view():
    """Start `python -m bringup.live` and return the address that it names."""
    pytest.importorskip("rerun")
    process = subprocess.Popen(
        [sys.executable, "-m", "bringup.live", "--ros-args", "-p", "web_port:=29090", "-p", "grpc_port:=29876"],
        stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    yield next(line for line in process.stderr if "live view on" in line).split("live view on ")[1].strip()
    process.terminate()
    process.communicate(timeout=30)


@pytest.mark.timeout(300)
def test_the_live_view_opens_in_chromium_and_asks_for_the_stream(page, live_view):
    assert page.open(live_view, STARTED) == {"title": "Rerun Viewer", "panicked": False, "canvas": True}
    stream = live_view.split("/?url=")[1].removeprefix("rerun%2B").removesuffix("/proxy")
    page.await_request(stream)


@pytest.mark.timeout(300)
def test_the_live_view_is_served_on_this_machine_alone_and_ends_with_a_parent_that_is_killed():
    pytest.importorskip("rerun")
    code = (
        "import time; from bringup.live_server import LiveServer; "
        "server = LiveServer('127.0.0.1', 29776, 29790); print(server.page, server.folder.path, flush=True); "
        "time.sleep(300)"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    page, folder = parent.stdout.readline().split()
    clear_shared_memory()
    assert list(Path(folder).iterdir())
    web_port, grpc_port = (int(port) for port in re.findall(r"127\.0\.0\.1:(\d+)/", page))
    elsewhere = "127.0.0.2"  # what listens on every interface listens there too
    assert [takes("127.0.0.1", port) for port in (web_port, grpc_port)] == [True, True]
    assert [takes(elsewhere, port) for port in (web_port, grpc_port)] == [False, False]
    parent.kill()
    parent.communicate()
    deadline = time.monotonic() + 60
    while takes("127.0.0.1", web_port):
        assert time.monotonic() < deadline, "the server lives on"
        time.sleep(0.05)
    clear_shared_memory()
    assert not Path(folder).exists()


def takes(address, port):
    """Tell whether somebody listens."""
    try:
        socket.create_connection((address, port), timeout=5).close()
    except ConnectionRefusedError:
        return False
    return True


@pytest.mark.parametrize(("given", "address"), [([], "127.0.0.1"), (["0.0.0.0"], "0.0.0.0")])
def test_the_view_is_served_where_it_is_asked_for(given, address):
    options = read_options(Options, ["--view", *given], "run_stack.py")
    assert options.view == address


def test_an_address_that_is_none_is_named():
    with pytest.raises(ValueError, match="--view everywhere, expected an IP address"):
        read_options(Options, ["--view", "everywhere"], "run_stack.py")


@pytest.mark.parametrize("address", ["192.0.2.1", "2001:db8::1"])  # kept for documentation
def test_an_address_of_another_machine_is_refused_before_anything_is_played(address):
    with pytest.raises(ValueError, match=rf"^--view {address}: .*, expected an address of this machine, or 0\.0\.0\.0"):
        read_options(Options, ["--view", address], "run_stack.py")


@pytest.mark.timeout(300)
def test_oracles_without_the_view_play_without_the_viewer_and_without_pytorch():
    code = (
        "import sys; from bringup import run_stack; "
        "run_stack.main(['--headless', '--difficulty', '1', '--time-limit', '3', "
        "'--oracle', 'estimator,termination,planner,controller']); "
        "sys.exit(any(name.startswith('rerun') or name in ('bringup.live', 'torch') for name in sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, timeout=280).returncode == 0
