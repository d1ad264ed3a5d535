"""Actors on a Ray cluster that runs on this machine, for real."""

import math
import os
import signal

import pytest
import torch
from toy_actors import Centre, LastFew, Walkers

from mujoban_rl.actors import ActorError, ActorSource
from mujoban_rl.actors.cluster import RayPool
from mujoban_rl.actors.local import LocalPool
from mujoban_rl.engine import Budget, Cadence, Trainer
from mujoban_rl.run_directory import RunDirectory


def test_a_cluster_leaves_signals_to_those_who_handled_them(ray_cluster):
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_training_goes_on_when_an_actor_is_killed_and_equals_local_training_until_then(tmp_path, ray_cluster):
    runs = {}
    for name, pool in (("local", LocalPool(Walkers(), 2, "ordered")), ("ray", RayPool(Walkers(), 2, "ordered"))):
        source = ActorSource(pool, LastFew(), steps_per_update=4.0)
        cadence = Cadence(log_updates=5, publish_updates=3, save_seconds=math.inf)
        runs[name] = Trainer(RunDirectory(tmp_path / name, {}), Centre(), source, Budget(updates=40), cadence)
    run, learn, weights = runs["ray"], runs["ray"].learner.update, {}

    def update(*arguments):
        if run.progress.updates == 20:
            weights["ray"] = run.learner.net.weight.detach().clone()
            os.kill(next(pid for stream, pid in run.source.store.origins if stream == 1), signal.SIGKILL)
        return learn(*arguments)

    run.learner.update = update
    assert run.run()
    runs["local"].run(limit_updates=20)
    assert torch.equal(weights["ray"], runs["local"].learner.net.weight)
    streams = [stream for stream, _ in run.source.store.origins]
    assert run.source.pool.restarts == 1 and set(streams) == {0, 1, 2} and 1 not in streams[streams.index(2) :]
    assert run.progress.samples == 40 * 4 and run.source.worker_cpu_seconds() > 0.0


def test_an_error_of_an_actor_on_the_cluster_ends_the_run_with_its_message(ray_cluster):
    pool = RayPool(Walkers(fails_in=(0,)), 1)
    pool.publish({"weight": torch.zeros(1)}, 0)
    with pytest.raises(ActorError, match="ArithmeticError: stream 0 is broken"):
        pool.collect()
    pool.close()
