"""Signals: noted where work must end in order, raised elsewhere; processes that end with their parent."""

import os
import select
import signal
import subprocess
import sys
import threading
import time

import pytest

from mujoban_core.program import exit_status
from mujoban_core.signals import STOP_SIGNALS, Interrupted, StopSignal, interruptible, interruption


@pytest.fixture(autouse=True)
def _hangups_are_heard():
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)  # nohup ignores them, and so then do we
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("number", STOP_SIGNALS)
def test_a_signal_asks_the_work_to_end_and_names_the_exit_status(number):
    before = signal.getsignal(number)
    with StopSignal() as stop:
        os.kill(os.getpid(), number)
        assert stop.requested
        with pytest.raises(Interrupted) as raised:
            stop.check()
    assert raised.value.status == 128 + number and signal.getsignal(number) is before


def test_a_second_ctrl_c_cuts_the_work_short_but_not_what_puts_it_away(monkeypatch):
    monkeypatch.setattr("mujoban_core.signals.AGAIN", 0.0)
    with StopSignal():
        os.kill(os.getpid(), signal.SIGINT)
        with pytest.raises(Interrupted):
            os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)


def test_a_ctrl_c_that_is_delivered_twice_counts_once():
    with StopSignal() as stop:
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)
        assert stop.requested


def test_before_there_is_anything_to_put_away_a_signal_interrupts_once():
    with StopSignal(deferred=False), pytest.raises(Interrupted):
        os.kill(os.getpid(), signal.SIGTERM)
    with StopSignal(deferred=False) as stop:
        stop.deferred = True
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.requested


def test_work_that_waits_outside_of_python_is_woken():
    woken = threading.Event()
    with StopSignal() as stop, stop.waking(woken.set):
        signal.raise_signal(signal.SIGTERM)
        assert woken.wait(10) and stop.number == signal.SIGTERM


def test_whoever_waits_for_the_work_is_told_once_that_a_signal_was_heard():
    told, heard = [], threading.Event()
    with StopSignal(heard=lambda: (told.append(threading.current_thread()), heard.set())):
        for _ in range(2):
            signal.raise_signal(signal.SIGTERM)
        assert heard.wait(10) and len(told) == 1 and told[0] is not threading.main_thread()
    with StopSignal(heard=lambda: told.append(None)) as stop, pytest.raises(Interrupted), stop.immediate():
        signal.raise_signal(signal.SIGTERM)
    assert len(told) == 1


def test_outside_of_such_work_a_signal_interrupts():
    with interruptible(), pytest.raises(Interrupted) as raised:
        os.kill(os.getpid(), signal.SIGTERM)
    assert raised.value.number == signal.SIGTERM


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_an_interruption_that_is_lost_while_an_object_is_deleted_comes_again():
    class Asked:
        def __del__(self):
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(0.01)

    with interruptible(), pytest.raises(Interrupted):
        Asked()
        time.sleep(20)


def test_what_puts_an_interruption_away_is_not_cut_short():
    put_away = []
    with pytest.raises(Interrupted), interruptible():
        try:
            os.kill(os.getpid(), signal.SIGTERM)
        finally:
            time.sleep(1.0)
            put_away.append("the first")
    assert put_away
    time.sleep(0.5)  # nothing more comes, when nobody would handle it


def test_a_hang_up_that_is_ignored_stays_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with StopSignal() as stop:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not stop.requested
    finally:
        signal.signal(signal.SIGHUP, before)


CHILD = "import os; from mujoban_core.children import end_with_parent; end_with_parent(); os.write(1, b'up'); input()"
STARTED = f"""
import subprocess, sys, time
from mujoban_core import children
children.start([sys.executable, "-c", {CHILD!r}])
time.sleep(100)
"""
WORKER = """
import multiprocessing, os, time
from mujoban_core import children
def work():
    children.end_with_parent()
    os.write(1, b"up")
    time.sleep(100)
with children.sheltered():
    multiprocessing.get_context("fork").Process(target=work).start()
time.sleep(100)
"""


@pytest.mark.parametrize("program", [STARTED, WORKER])
def test_a_child_ends_when_its_parent_is_killed(program):
    reading, writing = os.pipe()
    parent = subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=writing)
    os.close(writing)
    assert os.read(reading, 2) == b"up"
    parent.kill()
    parent.wait()
    # The pipe ends when the last process that could write to it has ended.
    assert select.select([reading], [], [], 20)[0] and os.read(reading, 1) == b""
    os.close(reading)


def test_an_interrupted_import_is_an_interruption_and_another_failed_one_is_not():
    def hidden(cause):
        try:
            try:
                raise cause
            except BaseException as error:
                raise ImportError("initialization failed") from error
        except ImportError as failed:
            return interruption(failed)

    interrupted = Interrupted(signal.SIGTERM)
    assert hidden(interrupted) is interrupted
    assert hidden(RuntimeError("no such driver")) is None


def test_a_class_that_is_interrupted_while_it_is_made_is_an_interruption():
    class Name:
        def __set_name__(self, owner, name):
            raise Interrupted(signal.SIGINT)

    def imported():
        try:
            type("Late", (), {"name": Name()})
        except Exception as error:  # Python 3.11 wraps it in a RuntimeError
            raise ValueError(f"weights: {error}") from error
        return 0

    assert exit_status("program", imported) == 130


COMPILER = """
import os, signal, time
def compile():
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.01)
    done.append(True)
"""


@pytest.mark.parametrize("context", [interruptible, lambda: StopSignal(deferred=False)])
def test_a_signal_while_a_function_is_compiled_waits_until_that_is_done(context):
    done = []
    inside = {"__name__": "numba.core.dispatcher", "done": done}
    exec(COMPILER, inside)
    with pytest.raises(Interrupted), context():
        inside["compile"]()
        time.sleep(5.0)
    assert done == [True]


INTERRUPTED_CAST = """
import ctypes, signal, sys
from mujoban_core.program import exit_status
from mujoban_sokoban.generator import generate_level

def interrupt(frame, event, argument):
    if event == "call" and frame.f_code is ctypes.cast.__code__ and frame.f_locals["typ"] is ctypes.c_void_p:
        sys.setprofile(None)
        signal.raise_signal(signal.SIGINT)

def generate():
    sys.setprofile(interrupt)
    while True:
        generate_level(5, 0)

generate_level(5, 0)  # compile
sys.exit(exit_status("levels", generate))
"""


def test_a_signal_while_a_compiled_function_takes_its_random_generator_ends_a_program_in_order():
    ended = subprocess.run([sys.executable, "-c", INTERRUPTED_CAST], capture_output=True, timeout=60, check=False)
    assert (ended.returncode, ended.stderr.strip()) == (130, b"levels: interrupted")
