import math

import numpy as np
import pytest
import torch

from mujoban_planner.boards import abstract_states, bit_boards
from mujoban_planner.networks import ResidualPlanner
from mujoban_planner.push_actor import PlayConfig
from mujoban_planner.push_env import PUSHES
from mujoban_planner.push_mpo import PushMPOConfig, PushReplay, push_mpo
from mujoban_planner.push_policy import Anchor, PushPolicy, images
from mujoban_planner.push_ppo import PushPPOConfig, push_ppo
from mujoban_rl.actors import Experience
from mujoban_rl.curves import read_curve
from mujoban_rl.engine import Cadence
from mujoban_rl.limits import NaNGuard
from mujoban_rl.run_directory import RunError
from mujoban_rl.testing import check_refusal, check_resuming
from mujoban_rl.weights import save_weights
from mujoban_sokoban.generator import TRAIN_SEEDS, generate_batch

PLAY = PlayConfig(environments=16, steps=4)
SIZE = {"channels": 8, "blocks": 1, "cpu_seconds": 1e9, "updates": 6.0}


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


def ppo(path, seed=0, **options):
    config = PushPPOConfig(play=PLAY, minibatch=32, seed=seed, **SIZE, **options)
    trainer = push_ppo(config, path, Cadence(publish_updates=1, save_seconds=math.inf))
    trainer.learner.evaluate = dict
    return trainer


def mpo(path, seed=0, **options):
    settings = {"batch_size": 32, "reuse": 3.0, "first_steps": 256, "replay_steps": 40, "n_step": 3, **SIZE, **options}
    config = PushMPOConfig(play=PLAY, seed=seed, **settings)
    trainer = push_mpo(config, path, Cadence(publish_updates=2, save_seconds=math.inf))
    trainer.learner.evaluate = dict
    return trainer


@pytest.mark.parametrize("make", [ppo, mpo])
def test_runs_resume_to_the_bit(make, tmp_path):
    check_resuming(make, tmp_path, stop_at=3, updates=6)


@pytest.mark.parametrize("make", [ppo, mpo])
def test_another_seed_plays_other_levels_by_another_chance(make, tmp_path):
    states = [make(tmp_path / str(seed), seed).source.pool.factory(0).state() for seed in (0, 5)]
    levels = [{level for _, level, *_ in state.part("own").values["tickets"]} for state in states]
    assert not levels[0] & levels[1] and all(level in TRAIN_SEEDS for level in levels[0] | levels[1])
    one, other = (state.part("own").tensors["generator"] for state in states)
    assert not torch.equal(one, other)


@pytest.mark.parametrize("make", [ppo, mpo])
def test_a_batch_with_nan_teaches_nothing(make, tmp_path):
    def poison(batch):
        return {**batch, "reward": batch["reward"] * math.nan}

    check_refusal(make(tmp_path), poison)


@pytest.mark.parametrize("make", [ppo, mpo])
def test_the_loss_teaches_the_push_head_and_the_trunk_but_no_other_head(make, tmp_path):
    trainer = make(tmp_path)
    planner = trainer.learner.policy.planner
    before = {k: v.clone() for k, v in planner.state_dict().items()}
    trainer.run()
    names = [k for k, v in planner.state_dict().items() if not torch.equal(v, before[k])]
    changed = {".".join(name.split(".")[:2]) for name in names}
    assert {"readout.push", "encoder.weight"} <= changed
    assert not {"readout.policy", "readout.dead", "readout.push_dead", "readout.walk", "readout.plan"} & changed


@pytest.mark.parametrize("make", [ppo, mpo])
def test_pushes_that_are_impossible_are_learned_not_to_be_wanted(make, tmp_path):
    trainer = make(tmp_path, learning_rate=1e-2, warm_up=0.0)
    policy, boards = trainer.learner.policy, bit_boards(generate_batch(4, range(64)))

    def strays():
        with torch.no_grad():
            advice = policy.planner(torch.from_numpy(abstract_states(generate_batch(4, range(64)))))
            output = policy(boards)
        possible = advice.push.flatten(1).exp() * (output.logits > -1e8)
        assert torch.allclose(output.stray, -possible.sum(1).log(), atol=1e-3)
        return float(output.stray.mean())

    policy.planner.heads.push.weight.data.mul_(60.0)
    before = strays()
    trainer.run()
    assert before > 1.0
    assert strays() < 0.5 * before


def ended(trainer, by):
    """Return the learner of a run, and its first batch with a large reward and an end `by` either in every step."""
    trainer.source.publish(trainer.learner.weights(), 0)
    batch = trainer.source.next_batch()
    trainer.source.close()
    flags = {name: batch[name] | True if name == by else batch[name] & False for name in ("terminated", "truncated")}
    return trainer.learner, {**batch, **flags, "reward": batch["reward"] + 100.0}


@pytest.mark.parametrize(("by", "taught"), [("terminated", True), ("truncated", False)])
def test_an_end_by_time_is_no_end_to_the_critic(by, taught, tmp_path):
    learner, batch = ended(ppo(tmp_path / "ppo"), by)
    assert (learner._advantages(batch)[1].mean() > 50.0) == taught
    learner, batch = ended(mpo(tmp_path / "mpo", time_outs_lost=False), by)
    assert (learner.update(batch, 0.5, NaNGuard())["q_loss"] > 1.0) == taught


def test_an_end_by_time_is_a_loss_to_the_critic_of_mpo_unless_told_otherwise(tmp_path):
    learner, batch = ended(mpo(tmp_path), "truncated")
    assert learner.update(batch, 0.5, NaNGuard())["q_loss"] > 1.0


@pytest.mark.parametrize(("by", "after"), [("terminated", 7.0), ("truncated", 50.0)])
def test_a_return_goes_on_with_the_value_of_the_state_in_which_time_ran_out(by, after, tmp_path):
    """The second push ends the episode and pays 7; all states are held to be worth 50, and rewards discounted by 0.97.

    `after` is what follows the first push, which pays 3.
    """
    learner, batch = ended(ppo(tmp_path / "ppo"), by)
    batch["reward"] = np.float32([3.0, 7.0, 0.0, 0.0])[:, None].repeat(16, 1)
    batch[by] = np.arange(4)[:, None].repeat(16, 1) == 1
    learner.policy.board[-1].bias.data.fill_(50.0)
    advantage, target = (x.view(4, 16) for x in learner._advantages(batch))
    assert (target[1] == after).all() and (advantage[1] == 0.0).all() == (by == "truncated")
    carried = 0.97 * 0.95 * (after - 50.0)
    torch.testing.assert_close(target[0], torch.full((16,), 3.0 + 0.97 * 50.0 + carried))

    learner, batch = ended(mpo(tmp_path / "mpo", time_outs_lost=False), by)
    batch["reward"] = torch.tensor([3.0, 7.0, 0.0, 0.0]).repeat(32, 1)
    batch[by] = (torch.arange(4) == 1).repeat(32, 1)
    learner.target.board[-1].bias.data.fill_(50.0)
    found = learner.update(batch, 0.5, NaNGuard())["mean_return"]
    assert found == pytest.approx(3.0 + 0.97 * after, rel=1e-3)


def test_a_run_that_kept_other_things_of_a_push_is_refused_in_words(tmp_path, monkeypatch):
    mpo(tmp_path).run(limit_updates=2)
    monkeypatch.setattr("mujoban_planner.push_mpo._KEPT", ("push", "over"))
    with pytest.raises(RunError, match=r"another version or kind of run \(of pushes it holds agent, .*: expected over"):
        mpo(tmp_path)


def deliver(replay, source, number, actor=0):
    """Add four pushes in each level; the target tells where they come from, the wall which pushes they are."""
    mark = np.arange(4 * number, 4 * number + 5, dtype=np.uint64)[:, None].repeat(16, 1)
    boards = {"wall": mark, "target": np.full_like(mark, source), "box": mark, "agent": mark.astype(np.uint8)}
    arrays = {name: values[:4] for name, values in boards.items()}
    arrays |= {f"last_{name}": values[4] for name, values in boards.items()}
    arrays |= {"push": np.zeros((4, 16), np.int64), "reward": np.zeros((4, 16), np.float32)}
    arrays |= {name: np.zeros((4, 16), bool) for name in ("terminated", "truncated")}
    replay.add(Experience(arrays, 64, actor=actor))


def test_a_replay_goes_on_with_more_or_fewer_actors():
    config = PushMPOConfig(play=PLAY, batch_size=400, replay_steps=8, n_step=3, **SIZE)
    replay = PushReplay(config, 1)
    for number in range(1, 8):
        deliver(replay, 5, number)
    more, fewer = PushReplay(config, 2), PushReplay(config, 1)
    more.restore(replay.state())
    deliver(more, 6, 1, actor=1)
    assert set(more.sample()["target"].flatten().tolist()) == {5}, "nothing but what was played"
    deliver(more, 6, 2, actor=1)
    assert set(more.sample()["target"].flatten().tolist()) == {5, 6}
    fewer.restore(more.state())
    assert len(fewer.replay) == len(replay.replay) and fewer.sample()["wall"].min() > 0


def test_learning_waits_until_an_actor_has_played_a_whole_sequence():
    config = PushMPOConfig(play=PLAY, batch_size=4, replay_steps=8, n_step=3, **SIZE)
    replay = PushReplay(config, 2)
    for actor in (0, 1):
        deliver(replay, 5, 1, actor=actor)
        assert replay.sample() is None, "7 steps make a sequence, of which each actor has played 4"
    deliver(replay, 5, 2)
    assert len(replay.sample()["target"]) == 4


@pytest.mark.parametrize("make", [ppo, mpo])
def test_a_run_from_weights_keeps_what_they_say_in_heads_that_it_does_not_teach(make, tmp_path):
    start = ResidualPlanner(8, 1, judge=True)
    save_weights(tmp_path / "start.safetensors", start, start.config, {})
    states = torch.from_numpy(abstract_states(generate_batch(4, range(16))))
    drift = {}
    for anchor in (0.0, 10.0):
        options = {"init": str(tmp_path / "start.safetensors"), "anchor": anchor, "anchored": 1.0}
        trainer = make(tmp_path / str(anchor), learning_rate=1e-2, **options)
        trainer.run()
        planner = trainer.learner.policy.planner.eval()
        with torch.no_grad():
            drift[anchor] = float((planner(states).push_dead - start.eval()(states).push_dead).abs().mean())
    assert 0.0 < drift[10.0] < 0.7 * drift[0.0]


def test_nothing_pulls_at_a_planner_that_says_what_it_said_under_any_symmetry():
    planner = ResidualPlanner(8, 1, judge=True).eval()
    boards = bit_boards(generate_batch(4, range(8)))
    loss = Anchor(planner, 1.0, 1.0).loss(planner, boards, np.arange(8))
    assert abs(float(loss.detach())) < 1e-5


def test_no_return_runs_from_the_levels_of_an_actor_that_died_into_those_of_its_successor():
    config = PushMPOConfig(play=PLAY, batch_size=400, n_step=3, **SIZE)
    replay = PushReplay(config, 1)
    for actor in range(2):
        for number in range(3):
            deliver(replay, actor, number)
    window = replay.sample()
    assert set(window["target"].flatten().tolist()) == {0, 1}
    assert torch.equal(window["target"][:, 1:], window["target"][:, :-1])
    assert torch.equal(window["wall"][:, 1:], window["wall"][:, :-1] + 1)
    # 12 pushes of each actor hold a sequence of 7, and one of 4 that follow it.
    assert set(window["wall"][:, 0].tolist()) == set(range(8))


def test_a_policy_over_pushes_is_that_of_the_planner_that_ships_under_every_symmetry():
    torch.manual_seed(0)
    planner = ResidualPlanner(8, 1, judge=True).eval()
    policy = PushPolicy(planner, untaught=True).eval()
    levels = generate_batch(4, range(8))
    with torch.no_grad():
        output = policy(bit_boards(levels))
        advice = planner(torch.from_numpy(abstract_states(levels)))
    chances = output.logits.softmax(1)
    # The planner that ships gives a little to pushes that are not possible.
    assert torch.allclose(chances, advice.push.exp().flatten(1), atol=0.05)
    push = output.logits.argmax(1).numpy()
    for s in range(8):
        symmetry = np.full(8, s)
        with torch.no_grad():
            seen = policy(bit_boards(levels), symmetry)
        at = images(push, symmetry)[:, None]
        assert (seen.logits.gather(1, at) > -1e8).all()
        assert ((seen.logits > -1e8).sum(1) == (output.logits > -1e8).sum(1)).all()
    assert output.logits.shape == (8, PUSHES)


def test_a_planner_whose_decisions_do_not_follow_pushes_is_refused():
    with pytest.raises(ValueError, match="without propagation"):
        PushPolicy(ResidualPlanner(8, 1, propagation=False), untaught=True)


def test_curves_are_drawn_against_samples_and_cpu_time(tmp_path):
    trainer = ppo(tmp_path)
    trainer.learner.evaluate = lambda: {"success_rate/5": 0.25}
    trainer.run()
    ((samples, cpu_seconds, rate),) = read_curve(tmp_path, "evaluation/success_rate/5")
    assert samples == 6 * 16 * 4 and cpu_seconds == trainer.progress.cpu_seconds > 0.0 and rate == 0.25
