import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Annotated

import numpy as np
import pytest
import torch
import toy_actors
import tyro
from toy_actors import ROWS, TICKS, Centre, LastFew, Walkers

from mujoban_rl.actors import ActorError, ActorOptions, ActorSource
from mujoban_rl.actors.local import LocalPool, ThreadPool
from mujoban_rl.actors.pool import ActorDied
from mujoban_rl.actors.processes import ProcessPool
from mujoban_rl.engine import CARRIED, Budget, Cadence, State, Trainer
from mujoban_rl.run_directory import RunDirectory, copy_light

STEPS = TICKS * ROWS


def played(pool, count=8):
    """Return what a learner sees that publishes new weights after every other sequence."""
    seen = []
    for i in range(count):
        if i % 2 == 0:
            pool.publish({"weight": torch.tensor([0.1 * i])}, i)
        seen.append(pool.collect())
    pool.close()
    return seen


def assert_same(some, others):
    for a, b in zip(some, others, strict=True):
        assert (a.version, a.actor, a.steps) == (b.version, b.actor, b.steps)
        np.testing.assert_array_equal(a.arrays["place"], b.arrays["place"])
        assert a.arrays["origin"][0] == b.arrays["origin"][0]


def trainer(path, pool, updates=40, **options):
    source = ActorSource(pool, LastFew(), steps_per_update=options.pop("steps_per_update", 4.0), **options)
    cadence = Cadence(log_updates=5, publish_updates=3, save_seconds=math.inf)
    return Trainer(RunDirectory(path, {}), Centre(), source, Budget(updates=updates), cadence)


def wait_for(condition, seconds=20.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


def test_a_store_with_too_little_for_a_batch_is_filled_before_the_first_update():
    class Patient(LastFew):
        def sample(self):
            return super().sample() if len(self.kept) == 3 else None

    source = ActorSource(LocalPool(Walkers(), 2), Patient(), steps_per_update=4.0)
    source.publish({"weight": torch.zeros(1)}, 0)
    assert source.next_batch() is not None
    assert source.samples == 3 * STEPS > 4.0


@pytest.mark.parametrize("make", [ThreadPool, ProcessPool])
def test_the_same_streams_play_the_same_in_every_pool(make):
    local = played(LocalPool(Walkers(), 2, "ordered"))
    assert [e.version for e in local] == [0, 0, 0, 0, 2, 2, 4, 4]
    assert_same(local, played(make(Walkers(), 2, "ordered")))


def test_by_turns_all_actors_play_with_the_newest_weights():
    assert [e.version for e in played(LocalPool(Walkers(), 2))] == [0, 0, 2, 2, 4, 4, 6, 6]


@pytest.mark.parametrize(
    ("make", "count", "schedule", "stops"),
    [
        (LocalPool, 3, "turns", (11, 17)),
        (LocalPool, 3, "ordered", (11, 17)),
        (ThreadPool, 3, "ordered", (1, 11)),  # after the first stop not every actor has been heard of
        (ProcessPool, 2, "ordered", (11,)),
    ],
)
def test_a_run_with_actors_resumes_to_the_bit_in_the_middle_of_a_round(tmp_path, make, count, schedule, stops):
    whole = trainer(tmp_path / "whole", LocalPool(Walkers(), count, schedule))
    assert whole.run()
    for stop in stops:
        assert not trainer(tmp_path / "parts", make(Walkers(), count, schedule)).run(limit_updates=stop)
    last = trainer(tmp_path / "parts", make(Walkers(), count, schedule))
    assert last.progress.updates == stops[-1] and last.run()
    assert torch.equal(whole.learner.net.weight, last.learner.net.weight)
    assert whole.progress.samples == last.progress.samples


def test_an_actor_that_does_not_say_where_it_is_plays_no_stream_twice(tmp_path, monkeypatch):
    monkeypatch.setattr(toy_actors.Walker, "state", lambda _: State())
    played = []
    for updates in (10, 40):
        run = trainer(tmp_path, LocalPool(Walkers(), 1, "ordered"))
        run.run(limit_updates=updates)
        played.append({stream for stream, _ in run.source.store.origins})
    assert played == [{0}, {1}]


def test_steps_per_update_stay_as_they_were_asked_for(tmp_path):
    run = trainer(tmp_path, LocalPool(Walkers(), 2), updates=30, steps_per_update=12.0, first_steps=100)
    run.run()
    assert run.progress.samples == math.ceil((100 + 30 * 12) / STEPS) * STEPS


def test_staleness_frames_and_what_happened_are_logged(tmp_path):
    trainer(tmp_path, LocalPool(Walkers(), 2, "ordered")).run()
    lines = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert len(lines) == 8
    assert all(line["actors/frames_per_second"] > 0 and line["return"] is not None for line in lines)
    # With 8 steps a sequence, 4 an update and two actors, an order is 4 updates old; publishing adds up to 2.
    assert 3 <= lines[-1]["actors/staleness"] <= lines[-1]["actors/staleness_max"] <= 6
    assert all("never" not in line for line in lines)


def test_a_killed_process_is_replaced_and_costs_its_unfinished_sequence_alone(tmp_path):
    run = trainer(tmp_path, ProcessPool(Walkers(), 2))
    store, learn = run.source.store, run.learner.update

    def update(*arguments):
        if run.progress.updates == 10:
            os.kill(next(pid for stream, pid in store.origins if stream == 1), signal.SIGKILL)
        return learn(*arguments)

    run.learner.update = update
    assert run.run()
    streams = [stream for stream, _ in store.origins]
    assert run.source.pool.restarts == 1 and set(streams) == {0, 1, 2} and 1 not in streams[streams.index(2) :]
    assert run.progress.samples == 40 * 4 and run.source.worker_cpu_seconds() > 0.0


class Mortal(LocalPool):
    """Its actors die whenever they play."""

    def _receive(self, actor):
        raise ActorDied("of nothing")


def test_an_actor_that_dies_again_and_again_ends_the_run():
    with pytest.raises(ActorError, match="actor 0 died 6 times in a row: of nothing"):
        played(Mortal(Walkers(), 2))


def test_a_resumed_run_in_parallel_plays_no_stream_twice(tmp_path):
    first = trainer(tmp_path, ThreadPool(Walkers(), 1))
    first.run(limit_updates=10)
    second = trainer(tmp_path, LocalPool(Walkers(), 2))
    assert second.progress.updates == 10 and second.run()
    assert [{stream for stream, _ in run.source.store.origins} for run in (first, second)] == [{0}, {1, 2}]


@pytest.mark.parametrize("pool", [LocalPool, ThreadPool])
def test_a_run_from_a_light_copy_plays_no_stream_twice(tmp_path, pool):
    first = trainer(tmp_path / "here", pool(Walkers(), 2))
    first.run(limit_updates=10)
    copy_light(tmp_path / "here", tmp_path / "there", CARRIED)
    second = trainer(tmp_path / "there", pool(Walkers(), 2))
    assert second.run() and {stream for stream, _ in second.source.store.origins} == {2, 3}
    lines = map(json.loads, (tmp_path / "there" / "metrics.jsonl").read_text().splitlines())
    stale = [line["actors/staleness"] for line in lines if line.get("actors/staleness") is not None]
    assert stale and min(stale) >= 0


def test_a_signal_to_the_whole_group_leaves_the_learner_what_its_actors_play(tmp_path):
    pool = ProcessPool(Walkers(), 1)
    pool.publish({"weight": torch.zeros(1)}, 0)
    os.kill(int(pool.collect().arrays["origin"][1]), signal.SIGTERM)
    assert [int(pool.collect().arrays["origin"][0]) for _ in range(3)] == [0] * 3 and not pool.restarts
    pool.close()


def test_an_error_of_an_actor_ends_the_run_with_its_message():
    pool = ProcessPool(Walkers(fails_in=(0,)), 1)
    with pytest.raises(ActorError, match="ArithmeticError: stream 0 is broken"):
        played(pool)
    pool.close()


def test_processes_end_with_a_learner_that_is_killed(tmp_path):
    script = tmp_path / "learner.py"
    script.write_text(
        f"import sys; sys.path.append({str(Path(toy_actors.__file__).parent)!r})\n"
        "import time\nimport torch\nfrom toy_actors import Walkers\n"
        "from mujoban_rl.actors.processes import ProcessPool\n"
        "if __name__ == '__main__':\n"
        "    pool = ProcessPool(Walkers(), 1)\n"
        "    pool.publish({'weight': torch.zeros(1)}, 0)\n"
        "    print(pool.collect().arrays['origin'][1], flush=True)\n"
        "    time.sleep(100)\n"
    )
    with subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True) as learner:
        actor = int(learner.stdout.readline())
        learner.kill()
    wait_for(lambda: not Path(f"/proc/{actor}").exists())


def test_options_choose_the_pool_and_name_what_is_wrong():
    def options(*arguments):
        return tyro.cli(Annotated[ActorOptions, tyro.conf.arg(name="")], args=arguments)

    assert isinstance(options().pool(Walkers()), LocalPool)
    pool = options("--actors", "processes", "--num-actors", "3").pool(Walkers())
    assert isinstance(pool, ProcessPool) and (pool.count, pool.schedule) == (3, "ordered")
    assert options("--actors", "ray", "--actor-resources", "actor", "1").actor_resources == {"actor": 1.0}
    with pytest.raises(ValueError, match="--num-actors 0 --actor-threads 1: expected at least 1"):
        ActorOptions(num_actors=0)
    with pytest.raises(ValueError, match="--address auto: only --actors ray has one, not local"):
        ActorOptions(address="auto")
