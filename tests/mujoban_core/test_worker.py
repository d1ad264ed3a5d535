"""The thread to which an OpenGL context belongs."""

import subprocess
import sys
import threading
from concurrent.futures import thread as pools

import pytest

from mujoban_core.worker import Worker


def test_jobs_run_in_one_other_thread_in_their_order():
    worker, ran = Worker("test"), []
    futures = [worker.submit(lambda k=k: ran.append((k, threading.current_thread().name))) for k in range(5)]
    assert worker.submit(threading.get_ident).result() != threading.get_ident()
    assert all(future.done() for future in futures)
    assert ran == [(k, "test") for k in range(5)]
    worker.end()
    worker.join()


def test_the_error_of_a_job_reaches_the_caller_and_the_next_job_runs():
    worker = Worker("test")
    with pytest.raises(ZeroDivisionError):
        worker.submit(lambda: 1 // 0).result()
    assert worker.submit(lambda: 7).result() == 7
    worker.end()
    worker.join()


def test_a_finalizer_can_end_a_worker_while_a_pool_is_being_used():
    worker = Worker("test")
    done = threading.Event()
    # A pool holds this lock in submit(); a finalizer may run just then, in the same thread.
    with pools._global_shutdown_lock:
        worker.submit(done.set)
        worker.end()
    assert done.wait(10)
    worker.join()


def test_what_was_submitted_is_finished_before_the_interpreter_ends():
    code = (
        "import time; from mujoban_core.worker import Worker; w = Worker('w');"
        " w.submit(lambda: (time.sleep(0.3), print('finished', flush=True)))"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "finished\n"


@pytest.mark.parametrize("end", ["", "from mujoban_core.signals import leave; leave(0)"])
def test_workers_end_before_the_libraries_that_they_use(end):
    code = (
        "import atexit, time; from mujoban_core.worker import Worker; w = Worker('w');"
        " w.submit(lambda: (atexit.register(print, 'library'), time.sleep(0.3), print('finished', flush=True)));"
        f" time.sleep(0.1); {end}"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert ended.stdout.split() == ["finished", "library"], ended.stderr


def test_a_program_that_leaves_does_not_wait_for_what_has_not_begun():
    code = (
        "import time; from mujoban_core.signals import leave; from mujoban_core.worker import Worker; w = Worker('w');"
        " [w.submit(lambda k=k: (time.sleep(0.3), print(k, flush=True))) for k in range(99)]; time.sleep(0.1); leave(0)"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=20)
    assert ended.stdout == "0\n", ended.stderr
