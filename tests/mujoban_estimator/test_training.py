import multiprocessing
import shutil

import numpy as np
import pytest
import torch

from bringup.command import Choice, Stack
from bringup.exploration import Disturbance
from bringup.record import Job, MixedEpisodes, record
from bringup.rollout import Ending, Tick
from bringup.rollout_recorder import TOPICS as RECORDED
from bringup.rollout_recorder import Recorder
from mujoban_core.bodies import ANT, BALL
from mujoban_core.grid import Instruction
from mujoban_core.interfaces import GroundTruth, Observation, TerminationOutput
from mujoban_core.plugins import ROLES
from mujoban_core.program import exit_status
from mujoban_core.sense_plan_act import Decision
from mujoban_estimator import load, load_termination
from mujoban_estimator.bag_stream import TOPICS, BagStream, KeptBags, stretches
from mujoban_estimator.data import Batch, Batcher, Stretch, choose_windows
from mujoban_estimator.estimator import EstimatorConfig
from mujoban_estimator.evaluate import evaluate
from mujoban_estimator.learner import EstimatorLearner, LearnerConfig, TrainConfig
from mujoban_estimator.termination import TerminationConfig
from mujoban_estimator.train import Options, main, make_trainer
from mujoban_msgs_py import topics
from mujoban_msgs_py.bags import BagError, BagWriter
from mujoban_msgs_py.bags.training import ReadReport, find_bags, open_training_bag, require_training_seeds
from mujoban_rl.limits import NaNGuard
from mujoban_rl.run_directory import RunDirectory
from mujoban_rl.testing import check_refusal, check_resuming
from mujoban_rl.weights import WeightsError
from mujoban_sokoban.generator import TRAIN_SEEDS

SEED = TRAIN_SEEDS.start
LENGTHS = (7, 12)
"""Ticks of the recorded episodes."""


def made_up_ticks(episodes, lengths=LENGTHS):
    """Ticks of one row whose frame, pose and so on tell which tick of which episode they are."""
    for index, length in enumerate(lengths):
        spec = episodes[index]
        for step in range(length):
            mark = 20 * index + step
            state = spec.level.abstract_state()[None]
            pose = np.array([[0.01 * mark, 0.5, 0.1]], np.float32)
            boxes = np.zeros((1, 4, 2), np.float32)
            issued = np.array([step % 4 == 0])
            frame = np.full((1, 64, 64, 3), mark, np.uint8)
            observation = Observation(frame, np.full((1, BALL.proprio_size), mark, np.float32), pose)
            truth = GroundTruth(state, pose, np.zeros((1, 3), np.float32), boxes, np.array([step % 4 == 3]))
            yield Tick(
                np.array([0]), np.array([index]), np.array([step]), observation, truth,
                Decision(
                    state, TerminationOutput(np.array([0.25], np.float32), issued & (step > 0), np.array([False])),
                    np.array([1 + step // 4]), np.array([1 + step // 4]), issued, np.zeros((1, 2), np.float32),
                ),
                np.zeros(1, np.float32), np.zeros(1, np.float32),
                np.array([False]), np.array([step == length - 1]),
                Ending(observation, truth) if step == length - 1 else None,
            )  # fmt: skip


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    path = tmp_path_factory.mktemp("bags")
    episodes = MixedEpisodes(len(LENGTHS), SEED, [1])
    with Recorder(path, BALL, episodes, [1, 1]) as recorder:
        for tick in made_up_ticks(episodes):
            recorder.write(tick)
    return path


def test_a_bag_gives_back_the_episodes_in_stretches(bags):
    report = ReadReport()
    found = list(stretches(open_training_bag(find_bags([bags])[0], TOPICS), 8, report))
    assert [len(s.frame) for s in found] == [7, 8, 4]
    assert [s.first for s in found] == [True, True, False]
    assert [int(m) for s in found for m in s.frame[:, 0, 0, 0]] == [*range(7), *range(20, 32)]
    assert report.ticks == 19 and report.episodes == 2 and not report.skipped


def test_instruction_and_termination_are_those_of_the_tick_before(bags):
    first = next(stretches(open_training_bag(find_bags([bags])[0], TOPICS), 8, ReadReport()))
    assert first.instruction.tolist() == [Instruction.STAY, 1, 1, 1, 1, 2, 2]
    assert np.flatnonzero(first.terminated).tolist() == [5]
    assert np.flatnonzero(first.completed).tolist() == [3]


def test_recorded_bags_hold_every_topic_of_the_graph(bags):
    bag = open_training_bag(find_bags([bags])[0], TOPICS)
    assert set(bag.topics) == {t.name for t in RECORDED}
    assert set(topics.GRAPH_TOPICS) - set(bag.topics) == {topics.TOP_CAMERA.name}
    assert bag.topics[topics.EPISODE.name].count == sum(LENGTHS) + len(LENGTHS)


def copy_without(bag, path, drop):
    """Copy the messages of a bag for which `drop(topic, stamp)` is false."""
    names = [t for t in RECORDED if not drop(t.name, None)]
    with BagWriter(path, names) as writer:
        for message in bag.messages():
            if not drop(message.topic, None) and not drop(message.topic, message.stamp):
                writer.write(message.topic, message.stamp, message.data)


def test_a_missing_topic_is_named(bags, tmp_path):
    bag = open_training_bag(find_bags([bags])[0], TOPICS)
    copy_without(bag, tmp_path / "bag", lambda topic, _: topic == topics.TRUE_TERMINATION.name)
    with pytest.raises(BagError, match=topics.TRUE_TERMINATION.name):
        open_training_bag(tmp_path / "bag", TOPICS)


def test_behind_a_missing_tick_an_episode_is_not_used(bags, tmp_path):
    bag = open_training_bag(find_bags([bags])[0], TOPICS)
    gone = 3 * topics.TICK
    copy_without(bag, tmp_path / "bag", lambda topic, stamp: topic == topics.CAMERA.name and stamp == gone)
    report = ReadReport()
    found = list(stretches(open_training_bag(tmp_path / "bag", TOPICS), 64, report))
    assert [len(s.frame) for s in found] == [2, 12]
    assert sum(report.skipped.values()) == 4


def test_a_bag_that_begins_amid_an_episode_is_used_from_the_next_start(bags, tmp_path):
    bag = open_training_bag(find_bags([bags])[0], TOPICS)
    copy_without(bag, tmp_path / "bag", lambda _, stamp: stamp is not None and stamp <= 2 * topics.TICK)
    found = list(stretches(open_training_bag(tmp_path / "bag", TOPICS), 64, ReadReport()))
    assert [len(s.frame) for s in found] == [12]


def test_paths_without_bags_are_named(tmp_path):
    with pytest.raises(BagError, match="nowhere"):
        find_bags([tmp_path / "nowhere"])
    with pytest.raises(BagError, match="no bag in"):
        find_bags([tmp_path])


@pytest.mark.parametrize(
    ("seed", "difficulty", "named"),
    [(1000, 1, "seed 1000"), (5_000_000, 1, "seed 5000000"), (SEED, 0, "whose level comes from a file")],
)
def test_episodes_that_are_not_for_training_are_refused(tmp_path, seed, difficulty, named):
    episodes = MixedEpisodes(1, seed, [1])
    with Recorder(tmp_path, BALL, episodes, [difficulty]) as recorder:
        for tick in made_up_ticks(episodes, (5,)):
            recorder.write(tick)
    paths = find_bags([tmp_path])
    with pytest.raises(BagError, match=named):
        require_training_seeds(open_training_bag(paths[0], TOPICS))
    with pytest.raises(BagError, match=named):
        next(BagStream(paths, 8, np.random.default_rng(0)))
    assert next(BagStream(paths, 8, np.random.default_rng(0), allow_test_seeds=True)).first


def same(ours, theirs):
    return all(np.array_equal(a, b) for a, b in zip(ours, theirs, strict=True))


def test_a_bag_is_read_once_while_it_is_kept_and_streams_side_by_side_stay_within_the_limit(bags, tmp_path):
    shutil.copytree(find_bags([bags])[0], tmp_path / "bag")
    reader = stretches(open_training_bag(tmp_path / "bag", TOPICS), 8, ReadReport())
    size = sum(values.nbytes for s in reader for values in s if isinstance(values, np.ndarray))

    def streams(limit):
        kept = KeptBags(limit)
        return [BagStream([tmp_path / "bag"], 8, np.random.default_rng(i), kept) for i in range(2)]

    room, tight = streams(size), streams(size - 1)
    # In turn, so that both gather the bag at once and neither has room for all of it.
    first = [next(stream) for _ in range(3) for stream in room + tight]
    again = [next(stream) for _ in range(3) for stream in room + tight]
    assert all(same(a, b) for a, b in zip(first, again, strict=True))
    for stream in room:
        [next(stream) for _ in range(3)]
    shutil.rmtree(tmp_path / "bag")
    assert all(same(next(stream), first[0]) for stream in room)
    for stream in tight:
        with pytest.raises(BagError):
            [next(stream) for _ in range(4)]


def test_a_stream_goes_on_amid_a_bag_that_was_kept(bags):
    paths = find_bags([bags])
    stream = BagStream(paths, 8, np.random.default_rng(0))
    for _ in range(4):
        next(stream)
    resumed = BagStream(paths, 8, np.random.default_rng(5))
    resumed.restore(stream.state())
    assert all(same(next(resumed), next(stream)) for _ in range(6))


def stretch(ticks, *, first=True, terminated=(), completed=(), body=BALL):
    rng = np.random.default_rng(ticks)
    state = MixedEpisodes(1, SEED, [1])[0].level.abstract_state()
    flags = np.arange(ticks)
    return Stretch(
        rng.integers(0, 256, (ticks, 64, 64, 3), dtype=np.uint8),
        np.tile(np.float32([-0.5, 0.5, 0.0]), (ticks, 1)),
        np.tile(upright(body), (ticks, 1)),
        np.ones(ticks, np.int64),
        np.isin(flags, terminated),
        np.isin(flags, completed),
        np.repeat(state[None], ticks, 0),
        first,
    )


def upright(body):
    proprio = np.zeros(body.proprio_size, np.float32)
    proprio[body.proprio.up_axis] = (0.0, 0.0, 1.0)
    return proprio


def test_windows_are_whole_instructions_from_their_issue():
    stream = iter([stretch(20, terminated=(6, 10))])
    batch = next(Batcher([stream], 24, BALL))
    windows = choose_windows(batch, 10_000, 64, np.random.default_rng(0))
    found = sorted(w[v].tolist() for w, v in zip(windows.tick, windows.valid, strict=True))
    assert found == [list(range(6)), list(range(6, 10)), list(range(10, 20))]


def test_windows_do_not_begin_where_the_issue_is_unknown():
    stream = iter([stretch(20, first=False, terminated=(6,))])
    batch = next(Batcher([stream], 20, BALL))
    windows = choose_windows(batch, 10_000, 5, np.random.default_rng(0))
    assert windows.tick[windows.valid].tolist() == [6, 7, 8, 9, 10]


def test_a_stream_that_ends_early_is_padding():
    batches = list(Batcher([iter([stretch(4)]), iter([stretch(8), stretch(3, first=False)])], 8, BALL))
    assert [b.valid.sum(1).tolist() for b in batches] == [[4, 8], [0, 3]]
    assert not batches[1].first[0]


def test_cells_stay_seen_until_the_next_episode():
    away = stretch(4)._replace(pose=np.tile(np.float32([-0.5, 0.5, np.pi]), (4, 1)), first=False)
    batcher = Batcher([iter([stretch(4), away, away._replace(first=True)])], 4, BALL)
    first, second, third = batcher
    assert (second.seen[:, -1] & first.in_view[:, 0]).sum() == first.in_view[:, 0].sum()
    assert not (third.seen[:, -1] & first.in_view[:, 0]).all() and third.seen.sum() < second.seen.sum()


@pytest.mark.parametrize("body", [BALL, ANT], ids=lambda body: body.name)
def test_a_learner_fits_what_it_sees_again_and_again(body):
    both = EstimatorConfig(body=body.name), TerminationConfig(body=body.name)
    config = TrainConfig(LearnerConfig(*both, window_frames=16), streams=1, learning_rate=3e-3, warm_up=0.0)
    learner = EstimatorLearner(config)
    batch = next(Batcher([iter([stretch(16, terminated=(8,), completed=(7, 14, 15), body=body)])], 16, body))
    parts = [learner.update(batch, 0.0, NaNGuard()) for _ in range(31)]
    assert parts[-1]["train/loss"] < 0.6 * parts[0]["train/loss"]
    if body.heading_index is None:  # it learns where it faces and stands, too
        assert parts[-1]["train/bearings"] < 0.6 * parts[0]["train/bearings"]


def test_shards_learn_what_the_whole_batch_teaches():
    """Equal streams in two shards give the gradient of one shard, and remember every stream in its row."""
    one = stretch(16, terminated=(8,), completed=(7, 14, 15))
    batches = [Batch._make(np.concatenate([a] * n) for a in next(Batcher([iter([one])], 16, BALL))) for n in (1, 2)]
    learners = [
        EstimatorLearner(
            TrainConfig(LearnerConfig(window_frames=16 * n, slip=0.0, lost=0.0), streams=n, shards=n, warm_up=0.0)
        )
        for n in (1, 2)
    ]
    losses = [
        [learner.update(batch, 0.0, NaNGuard())["train/loss"] for _ in range(3)]
        for learner, batch in zip(learners, batches, strict=True)
    ]
    assert losses[0] == pytest.approx(losses[1], rel=1e-4)
    # Else Adam's one kernel steps along other weights' gradients.
    assert all(p.grad.stride() == p.stride() for learner in learners for p in learner.estimator.parameters())
    whole, divided = (learner.state().tensors["belief.hidden"] for learner in learners)
    assert divided.shape[0] == 2
    for row in divided:
        np.testing.assert_allclose(row, whole[0], atol=1e-4)


def test_estimator_and_termination_must_share_the_resnet():
    with pytest.raises(ValueError, match="channels"):
        LearnerConfig(termination=TerminationConfig(channels=8))
    learner = EstimatorLearner(TrainConfig())
    assert learner.estimator.encoder is learner.termination.encoder


@pytest.mark.parametrize("steps", [1000, 10**12])
def test_the_learning_rate_warms_up_and_falls_over_whichever_budget_there_is(steps):
    """A run whose CPU seconds are what ends it, as those of `make weights`, warms up as well."""
    learner = EstimatorLearner(TrainConfig(steps=steps, learning_rate=2.0, warm_up=0.1, final_rate=0.1))
    batch = next(Batcher([iter([stretch(4)] * 4) for _ in range(4)], 4, BALL))
    rates = []
    for progress in (0.0, 0.05, 0.5, 1.0):
        learner.update(batch._replace(proprio=batch.proprio * np.nan), progress, NaNGuard())
        rates.append(learner.optimiser.param_groups[0]["lr"])
    assert rates == pytest.approx([0.0, 0.95, 1.0, 0.2])


@pytest.mark.parametrize(("name", "value"), [("warm_up", -0.1), ("warm_up", 50.0), ("final_rate", float("nan"))])
def test_what_is_no_share_of_the_budget_is_refused(name, value):
    with pytest.raises(ValueError, match=f"{name} is {value}: expected a share"):
        TrainConfig(**{name: value})


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [("place", float("nan"), "a finite"), ("cells", -1.0, "a finite"), ("lost", 2.0, "a share")],
)
def test_weights_of_losses_must_be_numbers(name, value, expected):
    with pytest.raises(ValueError, match=f"{name} is {value}: expected {expected}"):
        LearnerConfig(**{name: value})


@pytest.mark.parametrize(
    "other",
    [EstimatorConfig(channels=8, blocks=1, belief=8), EstimatorConfig(channels=8, blocks=1, update_every=2)],
)
def test_weights_of_another_configuration_are_no_start(other, tmp_path):
    def learner(estimator, limit=120, out=None):
        termination = TerminationConfig(channels=8, blocks=1, limit=limit)
        return EstimatorLearner(TrainConfig(LearnerConfig(estimator, termination)), out=out)

    former = learner(other, out=tmp_path)
    former.export(RunDirectory(tmp_path / "run", former.training), {})
    with pytest.raises(WeightsError, match=r"estimator.safetensors: weights of .*, expected those of"):
        learner(EstimatorConfig(channels=8, blocks=1)).start_from(tmp_path)
    learner(other, limit=90).start_from(tmp_path)


def test_a_start_from_another_body_lends_what_does_not_depend_on_it(tmp_path):
    def learner(body, out=None):
        sizes = {"body": body, "channels": 8, "blocks": 1}
        both = LearnerConfig(EstimatorConfig(**sizes), TerminationConfig(**sizes))
        return EstimatorLearner(TrainConfig(both), out=out)

    ball, ant = learner("ball", tmp_path), learner("ant")
    for weights in ball.termination.parameters():
        torch.nn.init.normal_(weights)
    ball.export(RunDirectory(tmp_path / "run", ball.training), {})
    ant.start_from(tmp_path)
    for role, own in ant.modules.items():
        lent = ball.modules[role].state_dict()
        for name, weights in own.state_dict().items():
            fits = name in lent and lent[name].shape == weights.shape
            assert fits != name.startswith(("bearings.", "lstm.weight_ih"))
            assert not fits or torch.equal(weights, lent[name])


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


def test_weights_are_in_the_folder_of_the_run_unless_it_is_said_where(make, tmp_path):
    make(tmp_path).save()
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
    small = EstimatorConfig(channels=8, blocks=1), TerminationConfig(channels=8, blocks=1)
    config = TrainConfig(LearnerConfig(*small, window_frames=8), streams=2, length=4, steps=20, warm_up=0.0)

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


def test_other_bags_may_be_learned_from_in_the_next_bit_of_a_run(bags, make, tmp_path):
    make(tmp_path / "run").run(limit_updates=1)
    copy_without(open_training_bag(find_bags([bags])[0], TOPICS), tmp_path / "other", lambda *_: False)
    resumed = make(tmp_path / "run", bags=tmp_path / "other")
    resumed.run(limit_updates=2)
    assert resumed.progress.updates == 2


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
