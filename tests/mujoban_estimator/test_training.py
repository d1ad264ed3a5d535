"""The training of estimator and termination from bags: options, resuming, processes that read."""

import json
import multiprocessing
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from estimator_bags import SEED, copy_without, made_up_ticks

from bringup.command import Choice, Stack
from bringup.exploration import Disturbance
from bringup.record import Job, MixedEpisodes, record
from bringup.rollout_recorder import Recorder
from mujoban_core.bodies import BALL
from mujoban_core.plugins import ROLES
from mujoban_core.program import exit_status
from mujoban_estimator import bag_source, bag_stream, load, load_termination
from mujoban_estimator.bag_source import BagSource, Reading
from mujoban_estimator.bag_stream import TOPICS
from mujoban_estimator.estimator import EstimatorConfig
from mujoban_estimator.evaluate import evaluate
from mujoban_estimator.evaluate import main as judge
from mujoban_estimator.learner import EstimatorLearner, LearnerConfig, TrainConfig
from mujoban_estimator.termination import TerminationConfig
from mujoban_estimator.train import Options, main, make_trainer
from mujoban_msgs_py import topics
from mujoban_msgs_py.bags import BagError
from mujoban_msgs_py.bags.training import find_bags, open_training_bag
from mujoban_rl.engine import CARRIED
from mujoban_rl.run_directory import RunError, copy_light
from mujoban_rl.testing import check_refusal, check_resuming
from mujoban_rl.weights import WeightsError

SMALL = EstimatorConfig(channels=8, blocks=1), TerminationConfig(channels=8, blocks=1)


@pytest.mark.parametrize(
    ("option", "message"), [("--threads", "0 threads: expected"), ("--evaluate-every", "evaluate every 0 samples")]
)
def test_options_that_are_0_are_one_line(bags, tmp_path, capsys, option, message):
    command = ["--bags", str(bags), "--run", str(tmp_path / "run"), option, "0"]
    assert exit_status("train", lambda: main(command)) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and message in said


def test_disturbances_must_be_probabilities():
    with pytest.raises(ValueError, match="delay is 2"):
        Disturbance(delay=2)


def test_the_command_names_a_bad_bag_in_one_line(tmp_path, capsys):
    command = ["--bags", str(tmp_path), "--run", str(tmp_path / "run")]
    assert exit_status("train", lambda: main(command)) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "no bag in" in said


@pytest.mark.parametrize("part", ["estimator", "termination"])
def test_a_body_that_there_is_not_is_named_with_those_that_there_are(part, capsys):
    command = ["--bags", "none", f"--learner.{part}.body", "cat"]
    assert exit_status("train", lambda: main(command)) == 2
    assert f"learner.{part}: unknown body 'cat': expected one of ant, ball" in capsys.readouterr().err


def test_bags_of_another_body_are_named_before_anything_is_learned_or_evaluated(bags, tmp_path):
    ant = EstimatorConfig(body="ant"), TerminationConfig(body="ant")
    options = Options((bags,), tmp_path, config=TrainConfig(LearnerConfig(*ant)))
    told = r"bags.*: recorded with the body ball, expected ant"
    with pytest.raises(BagError, match=rf"{told} \(--learner\.estimator\.body\)"):
        make_trainer(options)
    learner = EstimatorLearner(options.config)
    with pytest.raises(BagError, match=rf"{told} \(the body of the weights\)"):
        evaluate(learner.estimator, learner.termination, find_bags([bags]))


def test_a_device_that_is_not_there_is_named(bags, tmp_path):
    with pytest.raises(WeightsError, match="device 'tpu': expected cpu or cuda"):
        make_trainer(Options((bags,), tmp_path, device="tpu"))


def test_weights_are_in_the_folder_of_the_run_unless_it_is_said_where(bags, make, tmp_path, capsys):
    make(tmp_path).save()
    config = TrainConfig(LearnerConfig(*SMALL), streams=1, length=4, steps=1)
    options = Options((bags,), tmp_path / "other", out=tmp_path / "out", config=config, workers=0)
    make_trainer(options).run()
    assert f"other: complete after 4 samples: weights in {tmp_path / 'out'}\n" in capsys.readouterr().err
    assert load(tmp_path / "weights" / "estimator.safetensors").config.channels == 8


def test_what_is_recorded_can_be_learned_from_and_learning_goes_on_where_it_stopped(tmp_path):
    stack = Stack({role: Choice(role, "oracle") for role in ROLES})
    job = Job(tmp_path / "bags", "", MixedEpisodes(2, SEED, [1]), stack, Disturbance(), 2, 24, 0)
    ticks = record(job)
    bags = [open_training_bag(path, TOPICS) for path in find_bags([job.out])]
    assert ticks == sum(bag.topics["/torque"].count for bag in bags)
    config = TrainConfig(LearnerConfig(window_frames=8), streams=1, length=8, steps=2)
    options = Options((job.out,), tmp_path / "run", (job.out,), out=tmp_path / "weights", config=config)
    make_trainer(options).run()
    again = make_trainer(options)
    assert again.complete and again.metrics["ticks"] == 48
    estimator = load(tmp_path / "weights" / "estimator.safetensors")
    assert estimator.config == config.learner.estimator
    assert load_termination(tmp_path / "weights" / "termination.safetensors").limit == 120


@pytest.fixture
def make(bags):
    config = TrainConfig(LearnerConfig(*SMALL, window_frames=8), streams=2, length=4, steps=20, warm_up=0.0)

    def make(path, workers=0, bags=bags):
        return make_trainer(Options((bags,), path, config=config, workers=workers))

    return make


@pytest.mark.parametrize("workers", [0, 1, 2])
def test_a_run_that_is_terminated_and_resumed_equals_one_that_never_stopped(make, tmp_path, workers):
    # The bag ends, and is read again, within these updates.
    check_resuming(lambda path: make(path, workers), tmp_path, stop_at=4, updates=8)


def test_a_batch_with_nan_leaves_both_modules_their_memory_and_the_optimiser_untouched(make, tmp_path):
    def poisoned(batch):
        return batch._replace(proprio=batch.proprio * np.nan, pose=batch.pose * np.nan)

    check_refusal(make(tmp_path), poisoned)


def test_a_run_knows_moved_bags_again_and_refuses_others_also_of_the_same_names(bags, make, tmp_path):
    (first,) = find_bags([bags])
    make(tmp_path / "run").run(limit_updates=1)
    moved = tmp_path / "moved" / first.name
    shutil.copytree(first, moved)
    other = tmp_path / "other" / first.name
    copy_without(open_training_bag(first, TOPICS), other, lambda _, stamp: stamp == 6 * topics.TICK)
    with pytest.raises(RunError, match=r"run: other bags than the run's \(digest \w{64} there, \w{64} now\)"):
        make(tmp_path / "run", bags=tmp_path / "other")
    # One that was carried elsewhere without its bags begins others anew, and so does one of before these were noted.
    copy_light(tmp_path / "run", tmp_path / "light", CARRIED)
    make(tmp_path / "light", bags=tmp_path / "other").run(limit_updates=2)
    for checkpoint in (tmp_path / "run").glob("checkpoint-*.json"):
        content = json.loads(checkpoint.read_text())
        del content["extra"]["record"]
        checkpoint.write_text(json.dumps(content))
    begins = {}
    for name in ("moved", "other"):
        source = make(tmp_path / "run", bags=tmp_path / name).source
        begins[name] = source.next_batch().first.all()
        source.close()
    assert begins == {"moved": False, "other": True}
    resumed = make(tmp_path / "run", bags=tmp_path / "other")
    resumed.run(limit_updates=2)
    assert resumed.progress.updates == 2


@pytest.mark.parametrize("workers", [0, 1, 2])
def test_what_is_wrong_with_a_bag_is_told_alike_whoever_reads_it(bags, make, tmp_path, workers, monkeypatch):
    def refused(*_, **__):
        raise BagError("part0: damaged, expected a whole bag")
        yield

    monkeypatch.setattr(bag_source, "stretches", refused)
    monkeypatch.setattr(bag_stream, "stretches", refused)
    source = BagSource(Reading(find_bags([bags]), "ball", 1, 4, 0), workers)
    with pytest.raises(BagError, match=r"^part0: damaged, expected a whole bag$"):
        source.next_batch()
    source.close()


def test_damaged_parts_of_validation_bags_are_left_out_too_where_that_is_asked_for(bags, tmp_path):
    damaged = tmp_path / "bags" / "damaged"
    shutil.copytree(find_bags([bags])[0], damaged)
    (file,) = damaged.glob("*.mcap")
    content = bytearray(file.read_bytes())
    content[2_000] ^= 0xFF  # in the first of two chunks, some 3,700 bytes from the start
    file.write_bytes(content)
    config = TrainConfig(LearnerConfig(*SMALL, window_frames=8), streams=1, length=4, steps=1)
    options = Options((bags,), tmp_path / "run", (damaged,), config=config, workers=0)
    with pytest.raises(BagError, match="damaged"):
        make_trainer(options)
    make_trainer(replace(options, run=tmp_path / "skipping", skip_damaged=True)).run()


def test_nothing_is_chosen_by_test_levels_and_judging_on_them_is_noted(make, bags, tmp_path):
    episodes = MixedEpisodes(1, 1000, [1])
    with Recorder(tmp_path / "tests", BALL, episodes, [1]) as recorder:
        for tick in made_up_ticks(episodes, (5,)):
            recorder.write(tick)
    with pytest.raises(BagError, match="seed 1000, one for tests, by which nothing is chosen"):
        make_trainer(Options((bags,), tmp_path / "run", (tmp_path / "tests",)))
    make(tmp_path / "made").save()
    weights = tmp_path / "made" / "weights"
    command = [x for name in ("estimator", "termination") for x in (f"--{name}", str(weights / f"{name}.safetensors"))]
    report = tmp_path / "report.json"
    assert judge([*command, "--bags", str(tmp_path / "tests"), "--json", str(report)]) == 0
    content = json.loads(report.read_text())
    (use,) = content["test_uses"]
    assert use["seeds"] == [1000, 1000] and use["weights"] == content["weights"]
    assert judge([*command, "--bags", str(bags), "--json", str(report)]) == 0
    assert "test_uses" not in json.loads(report.read_text())


def test_a_run_that_began_with_weights_goes_on_with_the_same_named_ones_alone(make, bags, tmp_path):
    make(tmp_path / "made").save()
    config = TrainConfig(LearnerConfig(*SMALL, window_frames=8), streams=1, length=4, steps=20)
    options = Options((bags,), tmp_path / "run", start=tmp_path / "made" / "weights", config=config, workers=0)
    make_trainer(options).save()
    make_trainer(options)
    with pytest.raises(RunError, match=r"start: \{'estimator': '.*'\} there, None now"):
        make_trainer(replace(options, start=None))


def test_modules_that_training_makes_worse_are_exported_as_they_were(make, bags, tmp_path, monkeypatch):
    make(tmp_path / "made").save()
    given = tmp_path / "made" / "weights"
    rates = iter([0.9, float("nan"), 0.8])
    monkeypatch.setattr(
        "mujoban_estimator.learner.evaluate",
        lambda *args, **kw: {"boxes_all_right_if_seen": next(rates), "termination_precision": float("nan")},
    )
    config = TrainConfig(LearnerConfig(*SMALL, window_frames=8), streams=1, length=4, steps=2)
    options = Options((bags,), tmp_path / "run", (bags,), start=given, config=config, workers=0, evaluate_every=1)
    make_trainer(options).run()
    for name, module in (("estimator", load), ("termination", load_termination)):
        file = tmp_path / "run" / "weights" / f"{name}.safetensors"
        kept, first = module(file).state_dict(), module(given / file.name).state_dict()
        assert all(torch.equal(kept[key], first[key]) for key in first)
        record = json.loads(file.with_suffix(".json").read_text())
        assert record["evaluation"] == 0 and record["validation"] == {"boxes_all_right_if_seen": 0.9}


def test_modules_of_different_bodies_are_not_judged_together(bags):
    ball, ant = (
        EstimatorLearner(TrainConfig(LearnerConfig(EstimatorConfig(body=body), TerminationConfig(body=body))))
        for body in ("ball", "ant")
    )
    with pytest.raises(ValueError, match="an estimator of the body ball and a termination of ant: expected both"):
        evaluate(ball.estimator, ant.termination, find_bags([bags]))


def test_what_is_read_does_not_depend_on_how_many_processes_read(make, tmp_path):
    trainers = [make(tmp_path / str(workers), workers) for workers in (0, 1, 2)]
    for trainer in trainers:
        trainer.run(limit_updates=6)
    one, *others = ([p.numpy() for p in trainer.learner.estimator.state_dict().values()] for trainer in trainers)
    assert all(np.array_equal(a, b) for other in others for a, b in zip(one, other, strict=True))


def test_a_signal_to_the_reading_process_as_well_leaves_the_training_time_to_end_in_order(make, tmp_path):
    source = make(tmp_path, workers=1).source
    source.next_batch()
    (reader,) = multiprocessing.active_children()
    reader.terminate()
    for _ in range(4):  # more than are read ahead
        assert source.next_batch().valid.any()
    source.close()
    assert not multiprocessing.active_children()


def test_fewer_than_no_reading_processes_are_refused(make, tmp_path):
    with pytest.raises(ValueError, match="workers is -1: expected a number"):
        make(tmp_path, workers=-1)
