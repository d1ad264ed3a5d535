"""The learner of estimator and termination, by batches alone."""

import numpy as np
import pytest
import torch
from estimator_bags import stretch

from mujoban_core.bodies import ANT, BALL
from mujoban_estimator.data import Batch, Batcher
from mujoban_estimator.estimator import EstimatorConfig
from mujoban_estimator.learner import EstimatorLearner, LearnerConfig, TrainConfig
from mujoban_estimator.termination import TerminationConfig
from mujoban_rl.limits import NaNGuard
from mujoban_rl.run_directory import RunDirectory
from mujoban_rl.weights import WeightsError


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


def test_shards_learn_what_the_whole_batch_teaches(monkeypatch):
    """Equal streams in two shards give the gradient of one shard, and remember every stream in its row."""
    monkeypatch.setattr("mujoban_rl.precision.bfloat16_pays", lambda device: False)  # its rounding is 1 in 256
    one = stretch(16, terminated=(8,), completed=(7, 14, 15))
    batches = [Batch._make(np.concatenate([a] * n) for a in next(Batcher([iter([one])], 16, BALL))) for n in (1, 2)]
    learners = [
        EstimatorLearner(
            TrainConfig(LearnerConfig(window_frames=16 * n, slip=0.0, lost=0.0), streams=n, shards=n, warm_up=0.0)
        )
        for n in (1, 2)
    ]
    # Adam would make a step of full length of what rounding alone changes: no second update.
    losses = [
        learner.update(batch, 0.0, NaNGuard())["train/loss"] for learner, batch in zip(learners, batches, strict=True)
    ]
    assert losses[0] == pytest.approx(losses[1], rel=1e-5)
    parameters = zip(*(learner.estimator.named_parameters() for learner in learners), strict=True)
    for (name, whole), (_, divided) in parameters:
        assert torch.linalg.norm(divided.grad - whole.grad) <= 1e-3 * torch.linalg.norm(whole.grad), name
        # Else Adam's one kernel steps along other weights' gradients.
        assert all(p.grad.stride() == p.stride() for p in (whole, divided)), name
    whole, divided = (learner.own_state().tensors["belief.hidden"] for learner in learners)
    assert divided.shape[0] == 2
    for row in divided:
        np.testing.assert_allclose(row, whole[0], atol=1e-5)


def test_an_episode_that_begins_in_a_refused_batch_does_not_go_on_with_the_memory_of_another():
    learner = EstimatorLearner(TrainConfig(streams=1, length=4, warm_up=0.0))
    batches = Batcher([iter([stretch(4), stretch(4), stretch(4, first=False)])], 4, BALL)
    former, begins, goes_on = (next(batches) for _ in range(3))
    assert [bool(b.first[0]) for b in (former, begins, goes_on)] == [True, True, False]
    learner.update(former, 0.5, NaNGuard())
    learner.update(begins._replace(proprio=begins.proprio * np.nan), 0.5, NaNGuard())
    (shard,) = learner._shards(goes_on)
    assert all(torch.equal(*both) for both in zip(shard.belief, learner.estimator.initial_belief(1), strict=True))
    learner.update(goes_on, 0.5, NaNGuard())
    (shard,) = learner._shards(goes_on)
    assert torch.equal(shard.belief[0], learner.own_state().tensors["belief.hidden"])


def test_estimator_and_termination_must_share_the_resnet():
    with pytest.raises(ValueError, match="channels"):
        LearnerConfig(termination=TerminationConfig(channels=8))
    with pytest.raises(ValueError, match=r"--learner\.estimator and --learner\.termination differ in body: expected"):
        LearnerConfig(termination=TerminationConfig(body="ant"))
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
