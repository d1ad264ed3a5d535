"""The stack fine-tuned as a whole: what is learned from, what is not, and the promises of every trainer."""

import json
import math

import numpy as np
import pytest
import torch

import mujoban_controller
import mujoban_planner
from mujoban_baselines.joint.actor import Networks, around_instruction, make_actor
from mujoban_baselines.joint.decisions import DecisionLog
from mujoban_baselines.joint.learner import JointBatch, joint_parts
from mujoban_baselines.joint.settings import JointSettings, PlannerSettings, StartingWeights
from mujoban_baselines.task import TaskConfig
from mujoban_baselines.train import JointRunConfig, main, make_trainer
from mujoban_controller.goal_features import NEIGHBOURS
from mujoban_controller.mpo import MPOTrainingConfig
from mujoban_core.bodies import ANT, BALL
from mujoban_core.files import digest
from mujoban_core.grid import AGENT, BOX, TARGET, Instruction
from mujoban_rl.actors import ActorOptions
from mujoban_rl.engine import Cadence
from mujoban_rl.limits import NaNGuard
from mujoban_rl.testing import check_refusal, check_resuming
from mujoban_sim.world import World
from mujoban_sokoban.episodes import EpisodeSpec
from mujoban_sokoban.levels import Level

TASK = TaskConfig(levels="easy", robots=2, episode_seconds=2.4)
CONTROLLER = MPOTrainingConfig(
    window=4, windows=2, sequence=4, replay=60, first=80, reuse=2.0, n_step=1, samples=2, target_period=2, explore=0.2,
    steady=0.5,
)  # fmt: skip
SMALL = JointSettings(
    look_around=0, controller=CONTROLLER, planner=PlannerSettings(batch=3, replay=20, n_step=1, critic_first=1)
)


def state_of(number):
    return np.full((1, 10, 10, 4), number, np.float32)


def decide(log, number):
    log.decided(np.array([0]), state_of(number), np.array([number % 5]))


def finished(log):
    arrays = log.take()
    return [
        (int(arrays["instruction"][i]), round(float(arrays["reward"][i]), 4), round(float(arrays["bootstrap"][i]), 4),
         float(arrays["last"][i].max()))
        for i in range(len(arrays["reward"]))
    ]  # fmt: skip


def test_returns_go_over_instructions_however_long_each_took():
    """Returns of two instructions, discount 0.5 for each, 0.01 paid for each."""
    log, alive = DecisionLog(1, 2, 0.5), np.array([False])
    decide(log, 1)
    for reward in (0.0, 1.0):
        log.rewarded(np.array([reward], np.float32))
        log.ended(alive, alive)
    decide(log, 2)
    log.rewarded(np.array([-1.0], np.float32))
    assert finished(log) == []
    decide(log, 3)
    # 1 - 0.01 + 0.5 (-1 - 0.01), and the value of state 3 counts a quarter.
    assert finished(log) == [(1, pytest.approx(0.485), 0.25, 3.0)]
    log.rewarded(np.array([10.0], np.float32))
    log.ended(np.array([True]), alive)
    # Solved: nothing follows. -1 - 0.01 + 0.5 (10 - 0.01) and 10 - 0.01.
    assert finished(log) == [(2, pytest.approx(3.985), 0.0, 2.0), (3, pytest.approx(9.99), 0.0, 3.0)]
    decide(log, 4)
    log.ended(alive, np.array([True]))
    decide(log, 5)
    decide(log, 6)
    decide(log, 7)
    assert [instruction for instruction, *_ in finished(log)] == [0], "what time cut short is forgotten"


def test_the_critic_sees_which_way_a_push_goes():
    """North of the robot a box before a target, south of it a box before none: only one of the pushes earns."""
    level = Level.from_text("#####\n# . #\n# $ #\n# @ #\n# $ #\n#   #\n#.  #\n#####\n")
    seen = []
    for direction in (Instruction.NORTH, Instruction.SOUTH):
        world = World(1, max_boxes=2)
        world.reset([0], [EpisodeSpec(level, 0)])
        world.instruct(np.array([direction]), np.array([True]))
        seen.append(around_instruction(world)[0])
        state = seen[-1][:-NEIGHBOURS].reshape(10, 10, 4)
        ((row, column),) = np.argwhere(state[..., AGENT] > 0.5)
        assert state[row, column + 1, BOX] == state[row, column - 1, BOX] == 1.0, "ahead is to the right"
        assert (state[row, column + 2, TARGET] == 1.0) == (direction == Instruction.NORTH)
    assert [int(one[-NEIGHBOURS:].sum()) for one in seen] == [1, 0]


def learner_and_source(settings=SMALL, task=TASK):
    return joint_parts(task, StartingWeights(), settings, 0, ActorOptions())


def joint(folder):
    config = JointRunConfig(task=TASK, joint=SMALL)
    return make_trainer(config, learner_and_source(), folder, Cadence(2, 1), "joint")


def test_a_joint_run_goes_on_where_it_stopped_and_a_batch_with_nan_changes_neither_module(tmp_path):
    check_resuming(joint, tmp_path, stop_at=1, updates=3)

    def poison(batch):
        ticks = batch.ticks | {"reward": batch.ticks["reward"] * math.nan}
        return JointBatch(ticks, batch.decisions._replace(reward=batch.decisions.reward * math.nan))

    check_refusal(joint(tmp_path / "nan"), poison)


def test_policies_are_held_while_their_critics_learn_and_move_after_that():
    first = MPOTrainingConfig(**{**vars(CONTROLLER), "critic_first": 1})
    learner, source = learner_and_source(JointSettings(look_around=0, controller=first, planner=SMALL.planner))
    source.publish(learner.weights(), 0)
    before = {name: values.clone() for name, values in learner.weights().items()}
    batch = source.next_batch()
    assert batch.decisions is not None
    with torch.no_grad():
        policy = learner.networks.planner(batch.decisions.state).policy.softmax(1)

    def moved(part):
        return any((learner.weights()[k] != v).any() for k, v in before.items() if k.startswith(part))

    learner.update(batch, 0.0, NaNGuard())
    assert not moved("controller.mean"), "the critic learns alone"
    with torch.no_grad():
        held = learner.networks.planner(batch.decisions.state).policy.softmax(1)
    torch.testing.assert_close(held, policy, atol=0.0, rtol=0.0)
    learner.update(batch, 0.0, NaNGuard())
    assert moved("controller.mean") and moved("planner.readout.policy")
    before = {name: values.clone() for name, values in learner.weights().items()}
    batch.ticks["driven"][:] = False
    learner.update(batch, 0.0, NaNGuard())
    assert not moved("controller") and moved("planner"), "of a turn on the spot the controller learns nothing"
    source.close()


def test_while_the_robot_turns_to_look_the_critic_expects_the_turn_and_not_what_the_policy_would_do():
    learner, source = learner_and_source()
    source.publish(learner.weights(), 0)
    ticks, own = source.next_batch().ticks, learner.controller
    draws = own._draw(ticks)
    driven = torch.zeros_like(ticks["driven"])
    driven[0] = True
    value = own._value({**ticks, "driven": driven}, draws)
    torch.testing.assert_close(value[0], draws.q.mean(0)[0], atol=0.0, rtol=0.0)
    torch.testing.assert_close(value[1:], own._value_of_play(ticks)[1:], atol=0.0, rtol=0.0)
    source.close()


def test_the_moving_average_of_the_controller_acts():
    controller = MPOTrainingConfig(**{**vars(CONTROLLER), "average": 0.9})
    learner, source = learner_and_source(JointSettings(look_around=0, controller=controller, planner=SMALL.planner))
    with torch.no_grad():
        learner.networks.controller.mean.weight.add_(1.0)
    acts = learner.weights()["controller.mean.weight"]
    assert torch.equal(acts, learner.controller.product.mean.weight)
    assert not torch.equal(acts, learner.networks.controller.mean.weight)
    source.close()


def decisions_of(actor, sequences):
    """Return how many decisions are finished in so many sequences of three new ticks each."""
    return sum(len(actor.act().arrays["decision/reward"]) for _ in range(sequences))


def test_turns_on_the_spot_are_nobodys_driving_and_other_torques_are_drawn():
    learner, source = learner_and_source()
    source.close()
    settings = JointSettings(look_around=40, controller=CONTROLLER, planner=SMALL.planner)
    task = TaskConfig(levels="easy", robots=2, episode_seconds=5.0)
    actor = make_actor(task, learner.networks.plans(), StartingWeights(), settings, 0, 0)
    actor.set_weights(learner.weights(), 0)
    ticks = [actor.act().arrays for _ in range(4)]
    arrays = {name: np.concatenate([tick[name] for tick in ticks]) for name in ("instruction", "driven", "action")}
    turned = ~arrays["driven"]
    assert (arrays["instruction"] == int(Instruction.STAY)).all() and turned[2:].any() and not turned[0].any()
    assert ((arrays["action"] == [0.0, np.float32(0.7)]).all(-1) == turned).all(), "the first look"
    assert not decisions_of(actor, 7), "looks are not the planner's decisions, though each tick has a new instruction"
    actor.close()
    actor = make_actor(task, learner.networks.plans(), StartingWeights(), SMALL, 0, 0)
    actor.set_weights(learner.weights(), 0)
    arrays = actor.act().arrays
    assert decisions_of(actor, 25)
    assert arrays["driven"].all() and np.abs(arrays["action"]).max() <= 1.0
    assert arrays["first"][0].all() and not arrays["first"][1:].any()
    later = [actor.act().arrays["action"] for _ in range(3)]  # some of the draws are beyond the limits, which is one
    assert len(np.unique(np.concatenate([arrays["action"], *later])[..., 0])) > 4
    actor.close()


def test_the_ant_plays_with_its_own_modules_turns_as_long_as_it_takes_and_drives_itself_meanwhile():
    task = TaskConfig(levels="easy", robots=1, body="ant")
    learner, source = learner_and_source(task=task)
    source.close()
    settings = JointSettings(controller=CONTROLLER, planner=SMALL.planner)
    assert settings.turn(ANT) == ANT.look_ticks != settings.turn(BALL) == BALL.look_ticks
    actor = make_actor(task, learner.networks.plans(), StartingWeights(), settings, 0, 0)
    actor.set_weights(learner.weights(), 0)
    arrays = [actor.act().arrays for _ in range(3)]
    actor.close()
    assert all((part["instruction"] == int(Instruction.STAY)).all() and part["driven"].all() for part in arrays)
    with pytest.raises(ValueError, match="of the body ball, expected ant"):
        joint_parts(task, StartingWeights(controller=mujoban_controller.SHIPPED), SMALL, 0, ActorOptions())


def test_the_command_leaves_both_modules_with_the_digests_of_all_they_came_from(tmp_path):
    run = tmp_path / "run"
    options = ["--robots", "1", "--levels", "easy", "--episode-seconds", "0.5", "--steps", "1", "--seconds", "0"]
    assert main(["joint", "--run", str(run), *options]) == 0
    for role, shipped in (("controller", mujoban_controller.SHIPPED), ("planner", mujoban_planner.SHIPPED)):
        record = json.loads((run / f"{role}.json").read_text())
        assert record["start"][role] == digest(shipped) and record["training"]["method"] == "joint"
        assert (record["time_limit"], record["look_around"]) == (10, BALL.look_ticks)
        assert record["start"].keys() == {"estimator", "termination", "planner", "controller"}
    mujoban_planner.load(run / "planner.safetensors")
    mujoban_controller.load(run / "controller.safetensors")
    with pytest.raises(ValueError, match="no such weights file"):
        main(["joint", "--run", str(tmp_path / "other"), "--start.planner", "nobody.safetensors"])


def test_networks_hand_over_their_weights_by_module():
    networks = Networks(mujoban_controller.load(), mujoban_planner.load(compiled=False))
    copies = Networks.built(*networks.plans())
    copies.take(networks.weights())
    for one, other in zip(networks, copies, strict=True):
        assert all(torch.equal(v, other.state_dict()[k]) for k, v in one.state_dict().items())


