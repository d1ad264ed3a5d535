import json
import math
import re
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import mujoban_planner
from bringup.command import Choice, Stack
from bringup.record import Job, MixedEpisodes, record
from mujoban_core.grid import AGENT, BOX, GRID_SIZE, TARGET, WALL
from mujoban_core.plugins import ROLES
from mujoban_core.program import exit_status
from mujoban_msgs_py.bags import BagError
from mujoban_msgs_py.bags.training import EpisodeTick
from mujoban_msgs_py.conversions import InstructionReading
from mujoban_planner import bag_transitions, train
from mujoban_planner.boards import abstract_states
from mujoban_planner.decision import count_visits, initial_means, initial_visits
from mujoban_planner.growth import start_from
from mujoban_planner.imitation import ImitationConfig, imitation, imitation_loss
from mujoban_planner.lessons import LessonMaker
from mujoban_planner.moves import LevelStream
from mujoban_planner.networks import RecurrentPlanner, ResidualPlanner, ThinkingPlanner
from mujoban_planner.reinforcement import MPOConfig, MPOLearner, reinforcement, reset_stay_logit
from mujoban_planner.samples import make_batch
from mujoban_planner.uncertainty import blur, hide_unseen
from mujoban_rl.actors import ActorOptions
from mujoban_rl.curves import read_curve
from mujoban_rl.engine import Cadence
from mujoban_rl.run_directory import RunError
from mujoban_rl.testing import check_refusal, check_resuming
from mujoban_rl.weights import WeightsError, save_weights
from mujoban_sokoban.generator import TRAIN_SEEDS, generate_batch

SMALL = {"channels": 8, "blocks": 1, "batch_size": 16}

pytestmark = pytest.mark.usefixtures("short_validation")


def _imitation(path, actors=None, **changes):
    small = {"buffer": 50_000, "levels": 16, "stock": 8, "errors": 1.0}
    return imitation(ImitationConfig(**SMALL | small | changes), path, Cadence(publish_updates=1), actors=actors)


def _imitate(path, samples):
    trainer = _imitation(path)
    trainer.run(limit_samples=samples)
    return trainer


def test_imitation_learns_resumes_and_writes_a_loadable_planner(tmp_path):
    trainer = _imitate(tmp_path, 96)
    assert trainer.progress.samples == 96
    again = _imitate(tmp_path, 128)
    assert again.progress.samples == 128 and again.progress.updates == 8
    planner = mujoban_planner.load(tmp_path / "planner.safetensors")
    assert planner.config == again.learner.network.config
    record = json.loads((tmp_path / "planner.json").read_text())
    assert record["samples"] == 128 and "success_rate/1" in record["metrics"]


@pytest.mark.parametrize(("actors", "schedule"), [("local", "turns"), ("processes", "ordered")])
def test_imitation_that_is_terminated_and_resumed_equals_one_that_never_stopped(tmp_path, actors, schedule):
    runs = []

    def make(path):
        # Lessons from another process are those that this one makes in the same order.
        where = ActorOptions(actors if path.name == "parts" else "local", schedule=schedule)
        runs.append(_imitation(path, where, stock=1, enough=200, levels=2))
        return runs[-1]

    check_resuming(make, tmp_path, stop_at=3, updates=5)
    source = [run for run in runs if run.directory.path.name == "parts"][-1].source
    assert all(n > 0 for n in source.statistics().values()), "its own play was not corrected"
    assert (source.worker_cpu_seconds() > 0.0) == (actors == "processes")


def test_imitation_refuses_a_batch_with_nan(tmp_path):
    check_refusal(_imitation(tmp_path), lambda batch: batch._replace(value=batch.value * math.nan))


def test_a_small_batch_can_be_learned_by_heart():
    torch.manual_seed(0)
    config = ImitationConfig(**{**SMALL, "channels": 16})  # with 8, every eighth draw of the weights gets stuck
    network = config.build()
    samples = LessonMaker(0, {3: 1.0}).demonstrations(2)
    samples = samples.take(samples.right != 0)
    batch = make_batch(samples, np.zeros(len(samples.agent), np.int64))
    adam = torch.optim.Adam(network.parameters(), 3e-3)
    for _ in range(150):
        loss, stats = imitation_loss(network, batch, config)
        adam.zero_grad()
        loss.backward()
        adam.step()
    assert stats["accuracy"] > 0.95 and stats["push_accuracy"] > 0.95


def test_uncertain_states_keep_boxes_targets_and_robot_recognisable():
    samples = LessonMaker(0, {5: 1.0}).demonstrations(8)
    batch = make_batch(samples, np.zeros(len(samples.agent), np.int64))
    soft = blur(batch.state, 1.0, torch.Generator().manual_seed(0))
    assert soft.min() >= 0.0 and soft.max() <= 1.0 and not torch.equal(soft, batch.state)
    for layer in (TARGET, BOX):
        assert (soft[..., layer][batch.state[..., layer] > 0] > 0.5).all()
    assert torch.equal(soft[..., AGENT].flatten(1).argmax(1), batch.state[..., AGENT].flatten(1).argmax(1))
    assert (soft[:, [0, -1], :, WALL] == 1).all()
    assert torch.equal(blur(batch.state, 0.0, torch.Generator()), batch.state)


def test_hidden_states_show_what_was_in_view_and_guess_the_rest():
    samples = LessonMaker(0, {5: 1.0}).demonstrations(8)
    truth = make_batch(samples, np.zeros(len(samples.agent), np.int64)).state
    hidden = hide_unseen(truth, 1.0, np.random.default_rng(0))
    assert torch.equal(hidden[..., AGENT], truth[..., AGENT])
    assert ((hidden >= 0) & (hidden <= 1)).all()
    right = (hidden - truth).abs() < 0.5
    assert right[truth[..., AGENT] > 0].all()
    assert (hidden[:, [0, -1], :, WALL] > 0.5).all()
    box, wall = truth[..., BOX] > 0, truth[..., WALL] > 0
    half = len(truth) // 2
    # All that can be seen was seen, which leaves the rock; or a few views, which miss some boxes.
    rock = hidden[:half, ..., WALL][wall[:half]]
    assert right[:half][~wall[:half]].all() and ((rock > 0.05) & (rock < 0.95)).float().mean() > 0.05
    missed = ~right[half:, ..., BOX][box[half:]]
    assert 0.1 < missed.float().mean() < 0.9
    some = hide_unseen(truth, 0.5, np.random.default_rng(0))
    assert torch.equal(some[: len(truth) - half], truth[: len(truth) - half])


def _mpo(path, start=None, **changes):
    small = {"environments": 8, "batch_size": 8, "warm_up_steps": 8, "replay_steps": 50, "play": 3, "n_step": 2}
    config = MPOConfig(**{"channels": 8, "blocks": 1, "failure_rate": 0.1, **small, **changes})
    return reinforcement(config, path, init=start)


def test_mpo_writes_a_loadable_planner(tmp_path):
    trainer = _mpo(tmp_path)
    trainer.run(limit_updates=4)
    assert trainer.progress.updates == 4 and trainer.progress.samples >= 8 * (8 + 4)
    assert mujoban_planner.load(tmp_path / "planner.safetensors").config["channels"] == 8


def test_mpo_that_is_terminated_and_resumed_equals_one_that_never_stopped(tmp_path):
    # The target network follows, and actors get new weights, on both sides of the stop.
    check_resuming(lambda path: _mpo(path, target_period=2), tmp_path, stop_at=5, updates=12)


def test_mpo_refuses_a_batch_with_nan(tmp_path):
    trainer = _mpo(tmp_path)
    check_refusal(trainer, lambda batch: batch._replace(reward=batch.reward * math.nan))
    assert trainer.learner.own_state().values == {"updates": 2}, "the refused batch counts as none of the three"


@pytest.mark.parametrize("propagation", [True, False])
def test_a_planner_by_mpo_alone_is_not_led_by_verdicts_that_nobody_taught_it(propagation):
    planner = MPOLearner(MPOConfig(channels=8, blocks=1, propagation=propagation)).network.eval()
    states = abstract_states(generate_batch(3, range(1000, 1016)))
    scores = []
    for caution in (0.0, 4.0):
        planner.caution = caution
        scores.append(planner.scores(states, count_visits(states, initial_visits(16)), initial_means(16))[0])
    assert np.allclose(*scores, atol=1e-5)


def test_mpo_goes_on_from_weights_with_the_network_that_its_options_name(tmp_path):
    _mpo(tmp_path / "first").save()
    first = tmp_path / "first" / "planner.safetensors"
    _mpo(tmp_path / "larger", first, channels=12, blocks=2).save()
    assert mujoban_planner.load(tmp_path / "larger" / "planner.safetensors").config["channels"] == 12
    with pytest.raises(WeightsError, match="expected a ResidualPlanner with at most the channels"):
        _mpo(tmp_path / "smaller", first, channels=4)


def test_mpo_after_imitation_gives_stay_a_chance():
    network = ImitationConfig(**SMALL).build()
    with torch.no_grad():
        network.heads.policy.bias[0] = -30.0
    reset_stay_logit(network)
    bias = network.heads.policy.bias
    assert abs(bias[0] - bias[1:].mean()) < 3.0


def test_training_levels_are_training_seeds_and_never_repeat():
    stream = LevelStream({1: 0.5, 5: 0.5}, seed=3)
    first = stream.next_seed
    assert first in TRAIN_SEEDS
    a, b = stream.draw(16), stream.draw(16)
    assert stream.next_seed == first + 32 and not torch.equal(a, b)


def _tick(step, reward, sequence=None, direction=1, *, solved=False, truncated=False, timed_out=False):
    """One tick of an episode; without an instruction it is the last one."""
    state = np.full((10, 10, 4), step, np.float32)
    episode = SimpleNamespace(step=step % 10, reward=reward, solved=solved, truncated=truncated)
    said = None if sequence is None else InstructionReading(sequence, direction)
    return EpisodeTick(episode, (episode, state, said, said and SimpleNamespace(timed_out=timed_out)))


def test_bags_give_completed_instructions_with_their_rewards():
    ticks = [
        _tick(0, 0.0, 1, 2),
        _tick(1, 0.0, 1, 2),
        _tick(2, 1.0, 2, 3),  # instruction 1 done, a box came onto a target
        _tick(3, 0.0, 3, 4, timed_out=True),  # instruction 2 failed: dropped
        _tick(4, 11.0, solved=True),
        _tick(10, 0.0, 1, 1),
        _tick(11, 0.0, truncated=True),
    ]
    rows = bag_transitions.transitions(ticks)
    assert [(int(s[0, 0, 0]), a, round(r, 2), int(n[0, 0, 0]), done) for s, a, r, n, done in rows] == [
        (0, 2, 0.99, 2, False),
        (3, 4, 10.99, 4, True),
    ]


def _record(path, seed):
    stack = Stack({role: Choice(role, "oracle") for role in ROLES})
    return record(Job(path, "", MixedEpisodes(1, seed, [1]), stack, None, 1, 400, 0))


def test_the_push_that_solves_a_recorded_level_is_a_transition(tmp_path):
    assert _record(tmp_path, TRAIN_SEEDS.start)
    found = bag_transitions.BagTransitions.read([tmp_path])
    assert found.terminated.tolist() == [False] * (len(found.reward) - 1) + [True]
    assert found.reward[-1] == pytest.approx(11 - 0.01) and (found.reward[:-1] < 2).all()


def test_mpo_refuses_bags_with_levels_that_are_kept_for_tests(tmp_path):
    _record(tmp_path, 5)
    with pytest.raises(BagError, match="seed 5, which is not for training"):
        bag_transitions.BagTransitions.read([tmp_path])


def test_bad_training_input_ends_with_one_line_and_status_2(tmp_path, capsys):
    _imitate(tmp_path, 32)
    capsys.readouterr()
    arguments = ["imitation", "--run", str(tmp_path), "--channels", "16"]
    assert exit_status("train", partial(train.main, arguments)) == 2
    error = capsys.readouterr().err.strip()
    assert "another configuration" in error and len(error.splitlines()) == 1


def _imitate_from(path, start=None, **changes):
    return _imitation(path, init=None if start is None else str(start), **changes)


@pytest.mark.parametrize("make", [_imitate_from, _mpo])
def test_a_run_is_complete_when_its_cpu_seconds_are_spent(make, tmp_path):
    trainer = make(tmp_path, cpu_seconds=1e-6)
    assert trainer.run() and trainer.progress.updates == 1


@pytest.mark.parametrize("make", [_imitate_from, _mpo])
@pytest.mark.parametrize("begun", [True, False])
def test_a_run_from_before_there_were_cpu_seconds_goes_on(make, begun, tmp_path):
    start = None
    if begun:
        network, start = ResidualPlanner(8, 1, judge=True), tmp_path / "start.safetensors"
        save_weights(start, network, network.config, {})
    make(tmp_path / "run", start).run(limit_updates=2)
    file = tmp_path / "run" / "config.json"
    stored = json.loads(file.read_text())
    del stored["cpu_seconds"]
    file.write_text(json.dumps(stored))
    assert make(tmp_path / "run", start).progress.updates == 2
    with pytest.raises(RunError, match=r"cpu_seconds: 1000000000.0 there, 5.0 now"):
        make(tmp_path / "run", start, cpu_seconds=5.0)


def test_evaluations_by_samples_begin_before_training(tmp_path):
    small = ["--channels", "8", "--blocks", "1", "--batch-size", "16", "--levels", "16", "--stock", "4"]
    often = ["--actors", "local", "--evaluate-samples", "32", "--samples", "80"]
    assert train.main(["imitation", "--run", str(tmp_path), *small, *often]) == 0
    assert [samples for samples, *_ in read_curve(tmp_path, "evaluation/success_rate/1")] == [0, 32, 64, 80]


@pytest.mark.parametrize("method", ["imitation", "expert-iteration", "ppo", "mpo", "mpo-pushes", "stages", "explorer"])
@pytest.mark.parametrize(
    ("option", "said"),
    [
        ("--cpu-seconds", r"(cpu_seconds is 0.0|budget of 0.0 cpu_seconds): expected a"),
        ("--evaluate-samples", "evaluate every 0.0 samples: expected a positive number"),
    ],
)
def test_every_method_has_a_budget_of_cpu_seconds_and_evaluations_by_samples(tmp_path, capsys, method, option, said):
    arguments = [method, "--run", str(tmp_path / "run"), option, "0"]
    assert exit_status("train", partial(train.main, arguments)) == 2
    error = capsys.readouterr().err.strip()
    assert re.search(said, error) and len(error.splitlines()) == 1
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("method", "option"), [("ppo", "updates"), ("expert-iteration", "updates"), ("imitation", "horizon_samples")]
)
def test_a_budget_of_nothing_is_refused_before_anything_begins(tmp_path, method, option):
    words = [method, "--run", str(tmp_path / "run"), f"--{option}", "nan"]
    with pytest.raises(ValueError, match=f"^budget of nan {option.removeprefix('horizon_')}: expected a positive"):
        train.main(words)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("method", "option", "value"),
    [
        ("mpo-pushes", "--reuse", "0"),
        ("mpo-pushes", "--n-step", "0"),
        ("mpo-pushes", "--environments", "0"),
        ("ppo", "--minibatch", "0"),
        ("ppo", "--discount", "1.5"),
        ("ppo", "--entropy", "inf"),
        ("ppo", "--channels", "0"),
        ("expert-iteration", "--trees", "0"),
        ("expert-iteration", "--questions", "-1"),
        ("expert-iteration", "--easy", "nan"),
        ("expert-iteration", "--evaluations", "0"),
        ("imitation", "--levels", "0"),
        ("imitation", "--batch-size", "0"),
        ("imitation", "--blocks", "0"),
        ("imitation", "--corrections", "1.5"),
        ("imitation", "--learning-rate", "0.0"),
        ("imitation", "--init-share", "0.5"),
        ("expert-iteration", "--init-share", "0.5"),
        ("mpo", "--play", "0"),
        ("mpo", "--n-step", "0"),
        ("mpo", "--environments", "0"),
        ("mpo", "--failure-rate", "-0.1"),
        ("explorer", "--levels", "0"),
        ("explorer", "--horizon", "0.0"),
    ],
)
def test_an_option_out_of_its_range_is_named_before_anything_begins(tmp_path, capsys, method, option, value):
    arguments = [method, "--run", str(tmp_path / "run"), option, value]
    assert exit_status("train", partial(train.main, arguments)) == 2
    error = capsys.readouterr().err.strip()
    name = option[2:].replace("-", "_")
    assert f"{name} is {value}" in error and "expected" in error and len(error.splitlines()) == 1
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("method", ["imitation", "mpo", "explorer"])
def test_a_mix_of_no_levels_is_named(tmp_path, capsys, method):
    arguments = [method, "--run", str(tmp_path / "run"), "--mix", "0", "0", "0", "0", "0"]
    assert exit_status("train", partial(train.main, arguments)) == 2
    assert "mix is 0.0 0.0 0.0 0.0 0.0: expected five shares" in capsys.readouterr().err
    assert exit_status("train", partial(train.main, [*arguments[:4], "1", "2"])) == 2
    assert capsys.readouterr().err == "train: error: --mix has too few values, expected 5\n"


@pytest.mark.parametrize("options", [["imitation"], ["expert-iteration"], ["mpo"], ["stages", "--stages", "ppo=1"]])
def test_a_device_that_there_is_not_is_named(tmp_path, capsys, options):
    arguments = [*options, "--run", str(tmp_path / "run"), "--device", "gpu", "--channels", "8", "--blocks", "1"]
    assert exit_status("train", partial(train.main, arguments)) == 2
    assert capsys.readouterr().err == "train: error: device 'gpu': expected cpu or cuda, such as cuda:0\n"


def test_a_larger_network_begins_with_what_a_smaller_one_says(tmp_path):
    torch.manual_seed(0)
    small, path = ResidualPlanner(16, 1, judge=True), tmp_path / "small.safetensors"
    for parameter in small.parameters():
        torch.nn.init.normal_(parameter, 0.0, 0.1)
    save_weights(path, small, small.config, {})
    states = torch.rand(4, GRID_SIZE, GRID_SIZE, 4)
    large = ResidualPlanner(24, 3, judge=True)
    start_from(large, path)
    for expected, given in zip(small(states), large(states), strict=True):
        assert torch.allclose(expected, given, atol=1e-4)
    with pytest.raises(WeightsError, match=r"'judge': True.*'judge': False"):
        start_from(ResidualPlanner(24, 3), path)
    repeating = ThinkingPlanner(16, 2, tied=1, judge=True)
    start_from(repeating, path)
    for expected, given in zip(small(states), repeating(states), strict=True):
        assert torch.allclose(expected, given, atol=1e-4)
    for other in (ResidualPlanner(8, 1, judge=True), RecurrentPlanner(16, propagation=True, judge=True)):
        with pytest.raises(WeightsError, match="at most the channels"):
            start_from(other, path)


def test_what_a_run_makes_of_weights_lies_between_both_by_their_share(tmp_path):
    begun = ResidualPlanner(8, 1, judge=True)
    save_weights(tmp_path / "init.safetensors", begun, begun.config, {})
    made = {}
    for share in (0.0, 0.25, 1.0):
        run = tmp_path / str(share)
        trainer = _imitation(run, init=str(tmp_path / "init.safetensors"), init_share=share)
        trainer.run(limit_samples=64)
        again = _imitation(run, init=str(tmp_path / "init.safetensors"), init_share=share)
        again.run(limit_samples=96)
        made[share] = mujoban_planner.load(run / "planner.safetensors").state_dict()
        for name, weight in again.learner.weights().items():
            assert torch.equal(weight, made[share][name])
    assert any(not torch.equal(weight, made[0.0][name]) for name, weight in begun.state_dict().items())
    for name, weight in begun.state_dict().items():
        assert torch.equal(made[1.0][name], weight)
        torch.testing.assert_close(made[0.25][name], 0.75 * made[0.0][name] + 0.25 * weight)


def test_damaged_weights_are_refused(tmp_path):
    _imitate(tmp_path, 32)
    path = tmp_path / "planner.safetensors"
    path.write_bytes(path.read_bytes()[:-4] + b"abcd")
    with pytest.raises(WeightsError, match="damaged"):
        mujoban_planner.load(path)


