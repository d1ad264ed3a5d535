"""Training agents: promises of every trainer, returns at the end of time, levels by the paper's shares."""

import json
import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from benchmarks import golden
from mujoban_baselines import load
from mujoban_baselines.actor import make_actor
from mujoban_baselines.agents import MonolithicAgent, StructuredAgent, TopDownAgent
from mujoban_baselines.critics import Critic
from mujoban_baselines.impala import VTraceLearner, VTraceTrainingConfig
from mujoban_baselines.mpo import MPOLearner, MPOTrainingConfig, WindowStore
from mujoban_baselines.networks import BodySense, RecurrentAgent, dense
from mujoban_baselines.squares import SquaresTask
from mujoban_baselines.task import LEVELS, MujobanTask, TaskConfig
from mujoban_baselines.train import (
    JointRunConfig,
    MPORunConfig,
    VTraceRunConfig,
    main,
    make_trainer,
    mpo_parts,
    vtrace_parts,
)
from mujoban_core.agent import AgentInput
from mujoban_core.bodies import ANT, BALL
from mujoban_rl.actors import ActorOptions, ActorSource
from mujoban_rl.engine import Cadence
from mujoban_rl.limits import NaNGuard
from mujoban_rl.losses.vtrace import VTraceConfig
from mujoban_rl.testing import check_refusal, check_resuming
from mujoban_sokoban.generator import TRAIN_SEEDS

SMALL = MPOTrainingConfig(window=6, warm_up=1, n_step=2, windows=4, replay=120, first=1, samples=4, target_period=2)
CADENCE = Cadence(log_updates=2, publish_updates=1)


def mpo(folder, critic="asymmetric"):
    config = MPORunConfig(task=TaskConfig(robots=4), critic=critic, mpo=SMALL)
    parts = mpo_parts(config, ActorOptions(), partial(SquaresTask, batch=4))
    return make_trainer(config, parts, folder, CADENCE, "mpo")


def structured(folder, actors=1):
    config = VTraceRunConfig(task=TaskConfig(robots=2), vtrace=VTraceTrainingConfig(unroll=3))
    options = ActorOptions(num_actors=actors)
    parts = vtrace_parts(config, StructuredAgent, options, partial(SquaresTask, batch=2))
    return make_trainer(config, parts, folder, CADENCE, "structured")


@pytest.mark.parametrize("make", [mpo, partial(mpo, critic="symmetric"), structured])
def test_a_run_goes_on_where_it_stopped_and_a_batch_with_nan_changes_nothing(make, tmp_path):
    check_resuming(make, tmp_path, stop_at=2, updates=4)

    def poison(batch):
        return {name: values * math.nan if name == "reward" else values for name, values in batch.items()}

    check_refusal(make(tmp_path / "nan"), poison)


def test_v_trace_goes_on_with_more_or_fewer_actors_from_one_unroll_of_each(tmp_path, monkeypatch):
    shapes, update = [], VTraceLearner.update

    def seen(learner, batch, *rest):
        shapes.append(batch["reward"].shape)
        return update(learner, batch, *rest)

    monkeypatch.setattr(VTraceLearner, "update", seen)
    for bit, actors in enumerate((2, 1, 3)):
        structured(tmp_path, actors).run(limit_updates=4 * (bit + 1))
    assert shapes == [(4, 4)] * 4 + [(4, 2)] * 4 + [(4, 6)] * 4


@pytest.mark.parametrize(("batch", "steps"), [(1, 5), (2, 3), (8, 1)])
def test_v_trace_learns_from_so_many_robots_at_a_time_until_each_had_its_turn(batch, steps, monkeypatch):
    seen, learn = [], VTraceLearner._learn

    def noted(learner, ticks, guard):
        seen.append(ticks["action"][:, 0].numpy())
        return learn(learner, ticks, guard)

    monkeypatch.setattr(VTraceLearner, "_learn", noted)
    config = VTraceRunConfig(task=TaskConfig(robots=5), vtrace=VTraceTrainingConfig(unroll=2, batch=batch))
    learner, source = vtrace_parts(config, TopDownAgent, ActorOptions(), partial(SquaresTask, batch=5))
    source.publish(learner.weights(), 0)
    played = source.next_batch()
    told = learner.update(played, 0.0, NaNGuard())
    assert len(seen) == steps and np.array_equal(np.concatenate(seen), played["action"][0])
    (state,) = {int(state["step"]) for state in learner.optimisers["adam"].state.values()}
    assert state == steps and math.isfinite(told["vtrace/value_loss"])


def test_learner_and_actors_draw_from_streams_of_their_own():
    config = MPORunConfig(seed=3, task=TaskConfig(robots=1), mpo=SMALL)
    learner, source = mpo_parts(config, ActorOptions(), partial(SquaresTask, batch=1))
    drawing = [learner._generator, source.store.generator]
    for number in range(2):
        actor = make_actor(partial(SquaresTask, batch=1), Informed, 6, 1, (), "white", config.seed, number)
        drawing.append(actor._generator)
    assert len({generator.initial_seed() for generator in drawing}) == len(drawing)


class Blank(Critic):
    """Holds every action to be worth nothing."""

    def state(self, batch, features):
        return torch.zeros(*features.shape[:2], 128)

    def forward(self, state, action):
        return torch.zeros(action.shape[:-1])


@pytest.mark.parametrize(
    ("ending", "target"),
    [
        (None, 1.0 + 0.5 * 1.0 + 0.25 * 80.0),
        (("terminated", 2), 1.0 + 0.5 * 1.0),
        (("truncated", 2), 1.0 + 0.5 * 40.0),
        (("terminated", 1), 1.0),
        (("truncated", 1), None),
    ],
)
def test_returns_end_with_an_episode_but_go_on_from_where_time_ran_out(ending, target):
    """One return of two steps from tick 1 of 4, gamma 0.5, V = 10, 20, 40, 80."""
    settings = MPOTrainingConfig(window=4, warm_up=1, n_step=2, windows=1, gamma=0.5)
    learner = MPOLearner(MonolithicAgent(), Blank("ball"), settings, torch.Generator())
    batch = {name: torch.zeros(1, 4, dtype=torch.bool) for name in ("terminated", "truncated")}
    batch |= {"reward": torch.ones(1, 4), "action": torch.zeros(1, 4, 2)}
    if ending is not None:
        batch[ending[0]][0, ending[1]] = True
    loss = learner._critic_loss(batch, torch.zeros(1, 3, 256), torch.tensor([[10.0, 20.0, 40.0, 80.0]]))
    assert loss.item() == pytest.approx(0.0 if target is None else 0.5 * target**2)


def test_a_step_in_which_time_runs_out_teaches_v_trace_nothing():
    config = VTraceRunConfig(vtrace=VTraceTrainingConfig(unroll=2), task=TaskConfig(robots=2))
    learner, source = vtrace_parts(config, TopDownAgent, ActorOptions(), partial(SquaresTask, batch=2))
    source.publish(learner.weights(), 0)
    batch = dict(source.next_batch())
    batch["reward"] = np.full_like(batch["reward"], 7.0)
    losses = {}
    for name in ("terminated", "truncated"):
        ended = {"terminated": np.zeros((3, 2), np.bool_), "truncated": np.zeros((3, 2), np.bool_)}
        ended[name][:] = True
        losses[name] = learner.update({**batch, **ended}, 0.0, NaNGuard())["vtrace/value_loss"]
    assert losses["truncated"] == 0.0 and losses["terminated"] > 1.0


def test_mujoban_goes_on_to_the_bit_from_its_state():
    def play(task, steps):
        for _ in range(steps):
            step = task.step(np.full((3, 2), 0.3, np.float32))
            task.renew(np.flatnonzero(step.over))
        return task.observe(("proprio", "pose", "abstract_state"))

    config = TaskConfig(levels="curriculum", robots=3, episode_seconds=0.3)
    whole, parts = (MujobanTask(config, np.random.default_rng(seed)) for seed in (0, 1))
    play(whole, 4)
    parts.restore(whole.state())
    for one, other in zip(play(whole, 8).values(), play(parts, 8).values(), strict=True):
        np.testing.assert_array_equal(one, other)


def test_an_actor_notes_what_subgoals_paid():
    """A subgoal that is reached pays 0.1, and its sub-episode ends."""
    actor = make_actor(
        partial(MujobanTask, TaskConfig(robots=3, episode_seconds=5.0)), StructuredAgent, 61, 1, (), "white", 0, 0
    )
    arrays = actor.act().arrays
    actor.close()
    over, reward = arrays["pseudo_over"], arrays["pseudo_reward"]
    assert set(np.unique(reward)) <= {0.0, np.float32(0.1)} and over[reward > 0].all()
    assert over.any(), "50 steps have passed"
    changed = (arrays["subgoal"][1:] != arrays["subgoal"][:-1]).any((2, 3, 4))
    assert (changed <= over[:-1]).all(), "a subgoal holds until its sub-episode ends"


def test_levels_are_training_levels_in_the_shares_of_the_paper():
    assert all(sum(shares.values()) == pytest.approx(1.0) for shares in LEVELS.values())
    assert LEVELS["curriculum"] == {1: 0.25, 2: 0.25, 3: 0.2, 4: 0.2, 5: 0.1}
    task = MujobanTask(TaskConfig(levels="curriculum", robots=40, episode_seconds=0.1), np.random.default_rng(0))
    assert all(episode.seed in TRAIN_SEEDS for episode in task.world.episodes)
    for _ in range(2):
        step = task.step(np.zeros((40, 2), np.float32))
    assert step.truncated.all(), "two steps are 0.1 s"
    outcomes = task.renew(np.arange(40))
    assert len({name for name in outcomes if name.startswith("solved/")}) >= 4
    task.close()
    with pytest.raises(ValueError, match=r"episode_seconds is 0\.0: expected from 0\.05 to"):
        TaskConfig(episode_seconds=0.0)
    with pytest.raises(ValueError, match="episode_seconds is inf"):
        TaskConfig(episode_seconds=math.inf)


@pytest.mark.parametrize(("method", "kind"), [("monolithic", TopDownAgent), ("structured", StructuredAgent)])
def test_v_trace_learns_from_decisions_whose_torques_are_held_and_drawn_in_play_as_well(tmp_path, method, kind):
    run = tmp_path / "run"
    options = ["--robots", "3", "--levels", "easy", "--episode-seconds", "1", "--repeat", "4", "--draws", "pink"]
    options += ["--vtrace.exploration", "pink", "--vtrace.unroll", "5", "--steps", "60"]
    assert main([f"{method}-vtrace", "--run", str(run), *options]) == 0
    curve = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert curve[-1]["step"] == (5 + 1) * 4 * 3, "one unroll, in environment steps"
    assert curve[-1]["vtrace/rho"] == pytest.approx(1.0, abs=0.02), "on policy"
    assert curve[-1]["solved/1_n"] == 3, "20 steps of an episode are 5 decisions"
    agent = load(run / "agent.safetensors")
    state, rng, torques = agent.initial_state(np.arange(2)), np.random.default_rng(0), []
    for _ in range(8):
        frame = rng.integers(0, 255, (1, 64, 64, 3), np.uint8)
        seen = {"top_down": frame, "proprio": rng.normal(size=(1, 16)).astype(np.float32)}
        seen["abstract_state"] = np.zeros((1, 10, 10, 4), np.float32)
        alike = AgentInput(**{name: np.repeat(seen[name], 2, 0) for name in kind.sees})
        torque, state = agent.step(alike, state)
        torques.append(torque)
    assert [i for i in range(1, 8) if not np.array_equal(torques[i], torques[i - 1])] == [4]
    assert not np.allclose(torques[0][0], torques[0][1], atol=1e-3), "both see the same, and draw for themselves"


def test_a_subgoal_has_its_50_steps_however_long_torques_are_held():
    task = partial(MujobanTask, TaskConfig(robots=3, episode_seconds=60.0))
    actor = make_actor(task, partial(StructuredAgent, repeat=4), 30, 1, (), "white", 0, 0)
    over = actor.act().arrays["pseudo_over"]
    actor.close()
    assert over[:13].any(0).all() and over[13:26].any(0).all(), "13 decisions are 52 steps"


def test_a_run_by_command_leaves_an_agent_and_a_curve(tmp_path, capsys):
    run = tmp_path / "run"
    options = ["--robots", "2", "--levels", "easy", "--episode-seconds", "0.5", "--steps", "60"]
    small = ["--vtrace.unroll", "5"]
    assert main(["monolithic-vtrace", "--run", str(run), *options, *small]) == 0
    record = json.loads((run / "agent.json").read_text())
    assert record["class"] == TopDownAgent.__name__ and record["training"]["method"] == "monolithic-vtrace"
    assert record["time_limit"] == 10
    curve = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert record["samples"] >= 60 and curve[-1]["step"] == record["samples"], "what came last is in the curve"
    assert {"solved/1", "return/1", "cpu_seconds"} <= curve[-1].keys()
    with pytest.raises(ValueError, match=r"window is 9: expected more than"):
        replace(SMALL, window=9, warm_up=4, n_step=5)


@pytest.mark.parametrize(
    ("name", "value"),
    [("reuse", 0.0), ("n_step", -1), ("target_period", 0), ("windows", 0), ("gamma", 1.5), ("rate", 0.0)],
)
def test_numbers_out_of_their_range_are_refused_by_name_before_anything_is_played(name, value):
    option = f"--mpo.{name.replace('_', '-')}"
    with pytest.raises(ValueError, match=rf"^{name} is {value}: expected"):
        main(["monolithic-mpo", "--run", "nowhere", option, str(value)])


def test_v_trace_and_the_whole_stack_play_to_the_end_of_what_is_evaluated():
    """The stack needs 82 s of difficulty 5 on average; the paper ends partially observable agents' episodes early."""
    assert MPORunConfig().task.steps == 45 * 20
    for body in (BALL, ANT):
        for config in (VTraceRunConfig(), JointRunConfig()):
            task = replace(config.task, body=body.name)
            assert task.steps == body.time_limit == replace(config, task=task).data["time_limit"]


def test_the_entropy_of_a_policy_that_has_subgoals_counts_once(monkeypatch):
    losses = []
    monkeypatch.setattr("mujoban_baselines.impala.guarded_step", lambda loss, *_, **__: losses.append(loss.item()))
    for auxiliary in (0.0, 0.5):
        for weight in (0.0, 1.0):
            unroll = VTraceTrainingConfig(unroll=3, auxiliary=auxiliary, loss=VTraceConfig(entropy_weight=weight))
            config = VTraceRunConfig(task=TaskConfig(robots=2), vtrace=unroll)
            learner, source = vtrace_parts(config, StructuredAgent, ActorOptions(), partial(SquaresTask, batch=2))
            source.publish(learner.weights(), 0)
            learner.update(source.next_batch(), 0.0, NaNGuard())
    alone, beside = losses[0] - losses[1], losses[2] - losses[3]
    assert alone != 0.0 and beside == pytest.approx(alone, abs=1e-4) and losses[0] != losses[2]


def test_symmetric_critics_teach_the_torso_and_asymmetric_ones_do_not():
    moved = {}
    for critic in ("symmetric", "asymmetric"):
        config = MPORunConfig(critic=critic, mpo=SMALL)
        learner, source = mpo_parts(config, ActorOptions(), partial(SquaresTask, batch=4))
        source.publish(learner.weights(), 0)
        batch = source.next_batch()
        agent: MonolithicAgent = learner.agent
        with torch.no_grad():
            value = torch.zeros(batch["reward"].shape)
        loss = learner._critic_loss(batch, learner._over(agent, batch, SMALL.warm_up).features, value)
        loss.backward()
        moved[critic] = any(p.grad is not None and bool(p.grad.any()) for p in agent.parameters())
    assert moved == {"symmetric": True, "asymmetric": False}


@pytest.mark.parametrize("critic", ["symmetric", "asymmetric"])
def test_the_policy_moves_a_torso_of_its_own_alone(critic, monkeypatch):
    learner, source = mpo_parts(MPORunConfig(critic=critic, mpo=SMALL), ActorOptions(), partial(SquaresTask, batch=4))
    source.publish(learner.weights(), 0)
    still = next(learner.critic.parameters()).sum() * 0.0
    monkeypatch.setattr(learner, "_critic_loss", lambda *batch: still)
    before = {name: values.clone() for name, values in learner.agent.named_parameters()}
    learner.update(source.next_batch(), 0.0, NaNGuard())
    moved = {name for name, values in learner.agent.named_parameters() if not torch.equal(values, before[name])}
    head = {name for name in before if name.startswith(("mean.", "scale."))}
    assert moved & head and (moved <= head) == (critic == "symmetric")


class TellingSquares(SquaresTask):
    """Says where the squares are, so that little is to be learned from frames."""

    def observe(self, names):
        places = np.concatenate([*self._places.values(), np.zeros((self.batch, 10))], 1, dtype=np.float32)
        return super().observe(names) | {"proprio": places}


class Informed(RecurrentAgent):
    """Reads what it is told."""

    sees = ("proprio",)

    def __init__(self, body="ball"):
        super().__init__(body, 128, 64, [128])
        self.body_sense, self.encoder = BodySense(body, pose=False), dense(6, 128, 128)

    @property
    def sense(self):
        return self.body_sense

    def embed(self, sights):
        return self.encoder(sights["proprio"][:, :6])


def test_v_trace_learns_to_walk_to_the_red_square_from_nothing():
    """The golden task without pixels, by the code that trains the agents of Table 1."""
    unroll = VTraceTrainingConfig(unroll=10, rate=3e-3, gamma=0.9)
    config = VTraceRunConfig(task=TaskConfig(robots=16), vtrace=unroll)
    learner, source = vtrace_parts(config, Informed, ActorOptions(), partial(TellingSquares, batch=16))
    for update in range(100):
        source.publish(learner.weights(), update)
        learner.update(source.next_batch(), update / 400, NaNGuard())
        if update == 60:
            source.statistics()
    assert source.statistics()["solved"] > 0.8, "by chance half of the squares that are reached are red"


class InformedCritic(Critic):
    """Reads what the agent is told."""

    sees = ("proprio",)

    def __init__(self):
        super().__init__("ball")
        self.encoder = dense(6, 128, 128)

    def state(self, batch, features):
        return self.encoder(batch["proprio"][..., :6])


def test_mpo_learns_to_walk_to_the_red_square_from_nothing():
    """The same by MPO, with the settings of the golden task."""
    torch.manual_seed(0)
    settings = replace(golden.QUICK, replay=6_000, first=500, samples=10)
    learner = MPOLearner(Informed(), InformedCritic(), settings, torch.Generator().manual_seed(1))
    factory = partial(
        make_actor, partial(TellingSquares, batch=16), Informed, settings.window, settings.overlap,
        InformedCritic.sees, settings.exploration, 0,
    )
    store = WindowStore(settings, torch.Generator().manual_seed(2))
    source = ActorSource(
        ActorOptions().pool(factory), store, steps_per_update=settings.steps_per_update, first_steps=settings.first
    )
    for update in range(350):
        if update % 2 == 0:
            source.publish(learner.weights(), update)
        learner.update(source.next_batch(), update / 400, NaNGuard())
        if update == 300:
            source.statistics()
    assert source.statistics()["solved"] > 0.7, "by chance half of the squares that are reached are red"


def test_a_mean_beyond_the_limits_is_led_back_where_no_reward_does_so():
    config = VTraceRunConfig(task=TaskConfig(robots=2), vtrace=VTraceTrainingConfig(unroll=3, rate=3e-3))
    learner, source = vtrace_parts(config, Informed, ActorOptions(), partial(TellingSquares, batch=2))
    with torch.no_grad():
        learner.agent.mean.bias.copy_(torch.tensor([8.0, -8.0]))
    for update in range(30):
        source.publish(learner.weights(), update)
        learner.update(source.next_batch(), 0.0, NaNGuard())
    assert learner.agent.mean.bias.abs().max() < 7.98, "all draws are one torque to the world"
