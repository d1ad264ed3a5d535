"""Recorded bags give MPO the same transitions as the goal task in which they were recorded."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from bringup.rollout import Ending, Tick
from bringup.rollout_recorder import Recorder
from mujoban_controller.bag_ticks import TOPICS, BagTicks, transitions
from mujoban_controller.controller import Recurrent, VisuomotorController
from mujoban_controller.distil import DistilConfig
from mujoban_controller.goal_features import goal_offsets
from mujoban_controller.goal_settings import GoalTaskConfig, judging_config
from mujoban_controller.goal_task import GoalTask
from mujoban_controller.mpo import AsymmetricConfig
from mujoban_controller.privileged import PrivilegedPolicy
from mujoban_controller.scripted import scripted_driver
from mujoban_controller.train import NetworkConfig, Options, TrainConfig, main, make_trainer
from mujoban_core.bodies import BALL
from mujoban_core.grid import INSTRUCTION_LIMIT
from mujoban_core.interfaces import Observation, TerminationOutput
from mujoban_core.program import exit_status
from mujoban_core.sense_plan_act import Decision
from mujoban_msgs_py import topics
from mujoban_msgs_py.bags import BagError, BagWriter
from mujoban_msgs_py.bags.training import episodes, open_training_bag
from mujoban_rl.testing import check_resuming
from mujoban_rl.weights import save_weights
from mujoban_sim.oracles import OraclePlanner
from mujoban_sokoban.episodes import EpisodeSpec
from mujoban_sokoban.generator import TRAIN_SEEDS, generate_level

STANDSTILL = INSTRUCTION_LIMIT + 5
LENGTH = STANDSTILL + 100
FEATURES_AFTER_SPEED = 3 + 1 + 22
"""Kind, elapsed time, surroundings."""
CONFIG = judging_config(1, difficulty=2)


def play_and_record(path, seed):
    """Record an episode of a robot that stands until an instruction fails, then drives; return what the task said."""
    spec = EpisodeSpec(generate_level(2, seed), seed)
    task = GoalTask(CONFIG, OraclePlanner(), lambda: spec, np.random.default_rng(0))
    live, sequence, never = [], 1, np.array([False])
    with Recorder(path, BALL, [spec], [2]) as recorder:
        for step in range(LENGTH):
            inputs = task.observe()
            torque = scripted_driver(task) * (step > STANDSTILL)
            failed = bool(live) and live[-1]["discount"] == 0
            sequence += bool(inputs.terminated[0])
            live.append({
                "features": task.features()[0], "frame": inputs.frame[0],
                "proprio": inputs.proprio[0], "instruction": int(inputs.instruction[0]),
                "terminated": bool(inputs.terminated[0]), "action": torque[0],
                "goal": goal_offsets(task.world)[0], "kind": task.world.goals.kind[0].copy(),
                "pose": task.world.pose[0].astype(np.float32),
            })  # fmt: skip
            said = TerminationOutput(np.zeros(1, np.float32), inputs.terminated, np.array([failed]))
            pose = task.world.pose.copy()
            result = task.step(torque)
            recorder.write(Tick(
                np.array([0]), np.array([0]), np.array([step]), Observation(inputs.frame, inputs.proprio, pose),
                inputs.truth, Decision(
                    inputs.truth.abstract_state, said, inputs.instruction, np.array([sequence]), inputs.terminated,
                    torque,
                ),
                np.zeros(1, np.float32), np.zeros(1, np.float32), never, np.array([step == LENGTH - 1]),
                Ending(task.world.observation(), task.world.truth()) if step == LENGTH - 1 else None,
            ))  # fmt: skip
            live[-1] |= {"reward": result.reward[0], "discount": result.discount[0], "truncated": result.truncated[0]}
    return {name: np.stack([tick[name] for tick in live])[:-1] for name in live[0]}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    path = tmp_path_factory.mktemp("bags")
    return path, play_and_record(path, TRAIN_SEEDS.start)


def test_the_transitions_are_those_of_the_goal_task(recorded):
    path, live = recorded
    (ticks,) = episodes(open_training_bag(path / "row000", TOPICS), TOPICS)
    found = transitions(ticks, CONFIG)
    assert found.keys() - live.keys() == {"first"} and np.flatnonzero(found["first"]).tolist() == [0]
    assert (live["discount"] == 0).sum() == 1 and (live["reward"] > 1.0).sum() >= 2
    live["discount"][-1], live["truncated"][-1] = 0.0, True
    # The speed of a box, and with it where that will come to rest, is estimated: bags do not hold it.
    speed = -FEATURES_AFTER_SPEED - 1
    assert np.corrcoef(found["features"][:, speed], live["features"][:, speed])[0, 1] > 0.9
    estimated = np.ptp(found["features"] - live["features"], axis=0) > 1e-3
    assert estimated.sum() <= 5
    for fields in (found, live):
        fields["features"] = fields["features"][:, ~estimated]
    rewards = [fields.pop("reward") for fields in (found, live)]
    assert np.corrcoef(*rewards)[0, 1] > 0.8
    for name in live:
        np.testing.assert_allclose(found[name], live[name], atol=1e-4, err_msg=name)


def test_an_episode_ends_where_the_robot_falls_and_costs_a_fall_once(recorded):
    (ticks,) = episodes(open_training_bag(recorded[0] / "row000", TOPICS), TOPICS)
    proprio = TOPICS.index(topics.PROPRIO)
    for tick in range(40, len(ticks)):
        lying = ticks[tick][proprio].copy()
        lying[BALL.proprio.up_axis] = 1.0, 0.0, 0.0
        ticks[tick] = (*ticks[tick][:proprio], lying, *ticks[tick][proprio + 1 :])
    found = transitions(ticks, CONFIG)
    assert {len(values) for values in found.values()} == {40}
    assert found["reward"][-1] == CONFIG.reward.fallen and (found["reward"][:-1] > CONFIG.reward.fallen).all()
    assert found["discount"][-1] == 0.0 and not found["truncated"][-1] and found["discount"][:-1].all()


def test_rows_go_on_from_episode_to_episode_and_know_the_policys_memory(recorded):
    path, live = recorded
    torch.manual_seed(0)
    policy = VisuomotorController(channels=(8, 8, 8), features=16, hidden=8)
    stream = BagTicks([path], CONFIG, policy, 2, np.random.default_rng(0))
    found = [next(stream) for _ in range(LENGTH + 1)]
    assert [t for t, tick in enumerate(found) if tick["first"].all()] == [0, LENGTH - 1]
    assert found[LENGTH - 2]["discount"].tolist() == [0.0, 0.0]
    np.testing.assert_array_equal(np.stack([tick["action"][1] for tick in found[: LENGTH - 1]]), live["action"])
    inputs = (torch.from_numpy(live[k][None, :50]) for k in ("frame", "proprio", "instruction", "terminated"))
    with torch.no_grad():
        memory = policy(*inputs, Recurrent(*policy.initial_memory(1))).memory
    for i, values in enumerate(memory):
        np.testing.assert_allclose(found[50][f"memory{i}"][0], values[0].numpy(), atol=1e-4)


NETWORK = NetworkConfig(channels=(8, 8, 8), features=16, hidden=8)
MPO = TrainConfig(
    stage="mpo", steps=64, task=GoalTaskConfig(batch=4, difficulty=2), network=NETWORK,
    asymmetric=AsymmetricConfig(window=8, windows=2, sequence=8, replay=128, first=64, reuse=1.0),
)  # fmt: skip


def test_a_run_learns_from_bags_as_well(recorded, tmp_path):
    trainer = make_trainer(Options(tmp_path, MPO, bags=(recorded[0],), bag_share=0.5, evaluation_episodes=0))
    assert trainer.run()
    assert trainer.progress.samples == 64 and trainer.progress.updates > 2
    record = json.loads((tmp_path / "controller.json").read_text())
    assert record["bags"] == [recorded[0].name] and record["data"].endswith("; recorded bags")


def test_a_share_of_no_bags_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"--bag-share 1: expected --bags, whose share it is"):
        Options(tmp_path, MPO, bag_share=1.0)


@pytest.fixture(params=["mpo", "distil"])
def offline(request, recorded, tmp_path_factory, monkeypatch):
    """Return what makes runs that learn from bags alone, in which nothing can be simulated."""
    monkeypatch.setattr(GoalTask, "step", None)
    monkeypatch.setattr("mujoban_controller.goal_task.World", None)
    config = MPO
    if request.param == "distil":
        teacher, policy = tmp_path_factory.mktemp("teacher") / "teacher.safetensors", PrivilegedPolicy()
        save_weights(teacher, policy, policy.config, {})
        distil = DistilConfig(window=4, windows=2, sequence=4, replay=64, first=16, reuse=0.5)
        config = replace(MPO, stage="distil", teacher=teacher, distil=distil)

    def make(path, steps=512, **changes):
        options = {"bags": (recorded[0],), "bag_share": 1.0, "evaluation_episodes": 0, **changes}
        return make_trainer(Options(path, replace(config, steps=steps), **options))

    return make


def test_runs_from_bags_alone_resume_to_the_bit(offline, tmp_path):
    check_resuming(offline, tmp_path, stop_at=3, updates=6)


def test_a_missing_topic_is_named_in_one_line(recorded, tmp_path, capsys):
    bag = open_training_bag(recorded[0] / "row000", TOPICS)
    kept = [t for t in topics.GRAPH_TOPICS.values() if t.name in bag.topics and t is not topics.TORQUE]
    with BagWriter(tmp_path / "bag", kept) as writer:
        for message in bag.messages([t.name for t in kept]):
            writer.write(message.topic, message.stamp, message.data)
    command = ["--stage", "mpo", "--run", str(tmp_path / "run"), "--bags", str(tmp_path / "bag")]
    assert exit_status("train", lambda: main(command)) == 2
    said = capsys.readouterr().err
    assert "lacks /torque" in said and said.count("\n") == 1


@pytest.mark.parametrize(("option", "value"), [("world", "eased"), ("body", "ant")])
def test_bags_of_another_world_or_body_are_refused(recorded, tmp_path, option, value):
    config = replace(MPO, task=replace(MPO.task, **{option: value}))
    with pytest.raises(BagError, match=rf"recorded with the {option} .*, expected {value} \(--task\.{option}\)"):
        make_trainer(Options(tmp_path, config, bags=(recorded[0],), evaluation_episodes=0))


def test_episodes_that_are_kept_for_tests_are_refused(tmp_path):
    play_and_record(tmp_path, 5)
    with pytest.raises(BagError, match="seed 5"):
        next(episodes(open_training_bag(tmp_path / "row000", TOPICS), TOPICS))


def test_stages_that_would_not_learn_from_bags_refuse_them(recorded, tmp_path):
    with pytest.raises(ValueError, match="expected --stage distil or mpo"):
        Options(tmp_path, TrainConfig(stage="teacher"), bags=(recorded[0],))
