"""Training runs: every stage learns something, stops, resumes and leaves weights with a record."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mujoban_controller.controller import VisuomotorController
from mujoban_controller.distil import DistilConfig, GoalHead, imitation_loss
from mujoban_controller.episodes import TrainingEpisodes
from mujoban_controller.goal_rewards import RewardConfig
from mujoban_controller.goal_settings import GoalTaskConfig
from mujoban_controller.instructions import InstructionConfig, TerminationConfig
from mujoban_controller.mpo import AsymmetricConfig, MPOTrainingConfig
from mujoban_controller.ppo import PPOTrainingConfig, RolloutSource
from mujoban_controller.privileged import Critic, PrivilegedPolicy
from mujoban_controller.train import NetworkConfig, Options, TrainConfig, main, make_trainer
from mujoban_core.bodies import BALL, BODIES
from mujoban_core.grid import Instruction
from mujoban_rl.engine import CARRIED, Trainer
from mujoban_rl.limits import NaNGuard
from mujoban_rl.run_directory import RunDirectory, RunError, copy_light
from mujoban_rl.testing import check_refusal, check_resuming
from mujoban_rl.weights import WeightsError, load_weights, read_record, save_weights
from mujoban_sim.goals import GoalKind
from mujoban_sokoban.generator import TRAIN_SEEDS

TASK = GoalTaskConfig(batch=4, difficulty=1)
NETWORK = NetworkConfig(channels=(8, 8, 8), features=16, hidden=8)
MPO: dict[str, Any] = dict(window=6, windows=4, sequence=8, replay=64, first=32, reuse=1.0, target_period=2)
DISTIL = DistilConfig(window=4, windows=2, sequence=4, replay=64, first=16, reuse=0.5)
STAGES = {
    "ppo": TrainConfig(stage="teacher", algorithm="ppo", task=TASK, ppo=PPOTrainingConfig(length=8, minibatch=16)),
    "mpo": TrainConfig(stage="teacher", algorithm="mpo", task=TASK, mpo=MPOTrainingConfig(**MPO)),
    "asymmetric": TrainConfig(stage="mpo", task=TASK, network=NETWORK, asymmetric=AsymmetricConfig(**MPO, average=0.9)),
    "critic beside": TrainConfig(
        stage="mpo", task=TASK, network=NETWORK,
        asymmetric=AsymmetricConfig(
            **MPO, critic_updates=2, critic_windows=3, critic_replay=64, critic_first=2, steady=0.5
        ),
    ),
    "distil": TrainConfig(stage="distil", teacher=Path("teacher"), task=TASK, network=NETWORK, distil=DISTIL),
}


@pytest.mark.parametrize(
    ("settings", "name", "value", "expected"),
    [
        (DistilConfig, "windows", 0, "at least 1"),
        (DistilConfig, "sequence", 4, "at least the ticks of a window, 8"),
        (PPOTrainingConfig, "gamma", 1.5, "a share"),
        (PPOTrainingConfig, "least_rate", 0.1, "at most largest_rate"),
        (MPOTrainingConfig, "policy_rate", 0.0, "a number above 0"),
        (MPOTrainingConfig, "steady", 1.5, "a share"),
        (AsymmetricConfig, "critic_windows", 0, "at least 1"),
        (GoalTaskConfig, "astray", math.nan, "a share"),
        (InstructionConfig, "push", -0.1, "a share"),
        (TerminationConfig, "delay", math.inf, "a finite number"),
        (RewardConfig, "time", math.nan, "a finite number"),
        (TrainConfig, "steps", 0, "at least 1"),
    ],
)
def test_a_setting_out_of_its_range_is_named(settings, name, value, expected):
    with pytest.raises(ValueError, match=f"{name} is {value}: expected {expected}"):
        settings(**{name: value})


@pytest.fixture(scope="module")
def teacher(tmp_path_factory):
    path = tmp_path_factory.mktemp("teacher") / "teacher.safetensors"
    policy = PrivilegedPolicy("ball")
    save_weights(path, policy, policy.config, {})
    return path


@pytest.fixture(params=STAGES)
def make(request, teacher):
    config = STAGES[request.param]
    if config.teacher is not None:
        config = replace(config, teacher=teacher)

    def make_run(path: Path, steps: int = 512, **changes: Any) -> Trainer[Any]:
        return make_trainer(Options(path, replace(config, steps=steps), **{"evaluation_episodes": 0, **changes}))

    return make_run


def test_a_batch_with_nan_leaves_all_that_a_stage_learns_untouched(make, tmp_path):
    def poisoned(batch):
        name = next(k for k in ("label", "reward") if (k in batch if isinstance(batch, dict) else hasattr(batch, k)))
        if isinstance(batch, dict):
            return {**batch, name: batch[name] * math.nan}
        return batch._replace(reward=batch.reward * math.nan)

    check_refusal(make(tmp_path), poisoned)


def test_a_run_that_is_terminated_and_resumed_equals_one_that_never_stopped(make, tmp_path):
    check_resuming(make, tmp_path, stop_at=3, updates=6)


def test_a_run_that_is_carried_elsewhere_plays_levels_of_its_own(make, tmp_path):
    def levels(trainer):
        task = trainer.source.task if isinstance(trainer.source, RolloutSource) else trainer.source.player.task
        return {spec.seed for spec in task.world.episodes}

    first = make(tmp_path / "here")
    begun = levels(first)
    first.run(limit_updates=2)
    copy_light(tmp_path / "here", tmp_path / "there", CARRIED)
    carried = make(tmp_path / "there")
    assert begun and not levels(carried) & begun
    carried.run(limit_updates=4)
    assert RunDirectory(tmp_path / "there", carried.directory.config).began == first.progress.samples > 0


def test_a_device_that_is_not_there_is_named_before_anything_is_made(tmp_path):
    with pytest.raises(ValueError, match=r"device 'cuda:99': torch can use \d+ CUDA devices here, expected cpu"):
        main(["--run", str(tmp_path / "run"), "--device", "cuda:99"])
    assert not (tmp_path / "run").exists()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")
def test_a_run_on_a_gpu_goes_on_on_the_cpu_and_back(make, tmp_path):
    for updates, device in enumerate(("cuda", "cpu", "cuda"), 1):
        trainer = make(tmp_path, device=device)
        trainer.run(limit_updates=2 * updates)
        assert trainer.progress.updates == 2 * updates
        weights = (p for module in trainer.learner.modules.values() for p in module.parameters())
        assert {p.device.type for p in weights} == {device}


def test_the_product_of_a_run_has_a_record_and_loads(make, tmp_path):
    trainer = make(tmp_path, 96)
    assert trainer.run() and trainer.progress.samples >= 96
    file = next(tmp_path.glob("*r.safetensors"))
    record = json.loads(file.with_suffix(".json").read_text())
    assert record["samples"] == trainer.progress.samples and record["training"]["seed"] == 0
    product = load_weights(type(trainer.learner.product), file)
    assert all(torch.equal(v, product.state_dict()[k]) for k, v in trainer.learner.product.state_dict().items())


def test_mpo_of_a_student_begins_with_the_critic_of_its_teacher(tmp_path):
    make_trainer(Options(tmp_path / "teacher", replace(STAGES["mpo"], steps=96), evaluation_episodes=0)).run()
    file = tmp_path / "teacher" / "critic.safetensors"
    config = replace(STAGES["critic beside"], critic=file)
    learner = make_trainer(Options(tmp_path / "student", config, evaluation_episodes=0)).learner
    taught = load_weights(Critic, file).state_dict()
    for critic in (learner.critic, learner.target_critic):
        assert all(torch.equal(v, taught[k]) for k, v in critic.state_dict().items())
    other = Critic("ant")
    save_weights(tmp_path / "ant.safetensors", other, other.config, {})
    with pytest.raises(WeightsError, match=r"ant\.safetensors: a critic of .*ant.*, expected one of .*ball"):
        make_trainer(Options(tmp_path / "ant", replace(config, critic=tmp_path / "ant.safetensors")))


@pytest.mark.parametrize(
    ("stage", "option", "of"),
    [("distil", "teacher", PrivilegedPolicy), ("ppo", "initial", PrivilegedPolicy),
     ("asymmetric", "initial", VisuomotorController)],
)  # fmt: skip
def test_weights_of_another_body_are_refused_by_name(stage, option, of, tmp_path):
    weights = of("ant")
    file = tmp_path / "ant.safetensors"
    save_weights(file, weights, weights.config, {})
    with pytest.raises(WeightsError, match=r"ant\.safetensors: weights of the body ant, expected ball"):
        make_trainer(Options(tmp_path / "run", replace(STAGES[stage], **{option: file}), evaluation_episodes=0))


def test_a_network_unlike_the_one_that_training_begins_with_is_refused(tmp_path):
    policy, file = VisuomotorController("ball", channels=(8, 8), features=16, hidden=8), tmp_path / "w.safetensors"
    save_weights(file, policy, policy.config, {})
    for network in (NetworkConfig(), NetworkConfig((8, 8), 16, 8)):
        config = replace(STAGES["asymmetric"], initial=file, network=network)
        make_trainer(Options(tmp_path / str(network.hidden), config, evaluation_episodes=0))
    with pytest.raises(ValueError, match=r"--network\.hidden 9: that of --initial .*w\.safetensors is 8, expected it"):
        config = replace(config, network=NetworkConfig((8, 8), 16, 9))
        make_trainer(Options(tmp_path / "other", config, evaluation_episodes=0))


def test_the_best_product_on_validation_levels_is_exported(monkeypatch, tmp_path):
    monkeypatch.setitem(BODIES, "ball", replace(BALL, time_limit=40))
    learner = make_trainer(Options(tmp_path, replace(STAGES["ppo"], steps=64), evaluation_episodes=2)).learner
    with torch.no_grad():
        for parameter in learner.policy.parameters():
            parameter.zero_()
    first = learner.evaluate()
    learner.best._score = (2.0, 2.0)
    with torch.no_grad():
        learner.policy.log_scale.fill_(-1.0)
    assert learner.evaluate() == first
    learner.export(RunDirectory(tmp_path, {**asdict(STAGES["ppo"]), "steps": 64}), {})
    assert float(load_weights(PrivilegedPolicy, tmp_path / "teacher.safetensors").log_scale.detach().max()) == 0.0
    record = read_record(tmp_path / "teacher.safetensors")
    assert record["validation"] == first and record["evaluation"] == 0


def test_a_number_of_validation_levels_below_none_is_refused(tmp_path):
    with pytest.raises(ValueError, match="evaluation_episodes is -5: expected at least 0"):
        Options(tmp_path, STAGES["ppo"], evaluation_episodes=-5)


def test_a_run_directory_belongs_to_one_configuration(tmp_path):
    make_trainer(Options(tmp_path, STAGES["ppo"], evaluation_episodes=0)).save()
    with pytest.raises(RunError, match="steps"):
        make_trainer(Options(tmp_path, replace(STAGES["ppo"], steps=64)))


@pytest.mark.parametrize("option", ["initial", "critic"])
def test_a_run_does_not_go_on_from_other_weights_of_the_same_name(option, tmp_path):
    weights, file = PrivilegedPolicy("ball") if option == "initial" else Critic("ball"), tmp_path / "w.safetensors"
    save_weights(file, weights, weights.config, {})
    options = Options(tmp_path / "run", replace(STAGES["mpo"], **{option: file}), evaluation_episodes=0)
    make_trainer(options).save()
    with torch.no_grad():
        next(weights.parameters()).add_(1.0)
    save_weights(file, weights, weights.config, {})
    with pytest.raises(RunError, match="origins: "):
        make_trainer(options)


def test_an_episode_without_an_end_can_be_trained_on_and_stands_in_the_record(tmp_path):
    task = replace(TASK, horizon=math.inf, overshoot=math.inf)
    make_trainer(Options(tmp_path, replace(STAGES["ppo"], task=task), evaluation_episodes=0)).save()
    assert read_record(tmp_path / "teacher.safetensors")["training"]["task"]["horizon"] == "Infinity"


def test_training_levels_are_never_test_levels():
    episodes = TrainingEpisodes(1, np.random.default_rng(0), max_nodes=10_000)
    assert all(episodes().seed in TRAIN_SEEDS for _ in range(5))


def test_what_would_have_come_after_an_episode_that_was_cut_off_teaches_the_critic_nothing(tmp_path):
    def critic_after(reward):
        trainer = make_trainer(Options(tmp_path / str(reward), STAGES["mpo"], evaluation_episodes=0))
        batch = trainer.source.next_batch()
        cut = torch.zeros_like(batch["discount"], dtype=torch.bool)
        cut[0] = True
        batch = batch | {"truncated": cut, "reward": batch["reward"].clone()}
        batch["reward"][0] = reward
        trainer.learner.update(batch, 0.0, NaNGuard())
        trainer.source.close()
        return trainer.learner.critic.state_dict()

    one, other = critic_after(0.0), critic_after(100.0)
    assert all(torch.equal(one[name], other[name]) for name in one)


def test_a_failure_teaches_the_critic_also_where_the_next_episode_was_cut_off(tmp_path):
    learner = make_trainer(Options(tmp_path, STAGES["mpo"], evaluation_episodes=0)).learner
    learner.config = replace(learner.config, n_step=3)
    features = learner.critic.state.in_features
    batch = {
        "features": torch.zeros(1, 4, features),
        "action": torch.zeros(1, 4, learner.policy.action_size),
        "reward": torch.full((1, 4), -1.0),
        "discount": torch.tensor([[1.0, 0.0, 0.0, 1.0]]),
    }
    ends = {"failed, then cut off": [0, 0, 1, 0], "cut off": [0, 1, 0, 0], "cut off at once": [1, 0, 0, 0]}
    losses = {
        name: float(learner._critic_loss(batch | {"truncated": torch.tensor([cut]).bool()}, torch.zeros(1, 1)))
        for name, cut in ends.items()
    }
    assert losses["failed, then cut off"] > 0.1 and losses["cut off"] == 0.0 == losses["cut off at once"]


def test_imitation_prefers_the_teachers_torque():
    torch.manual_seed(0)
    controller = VisuomotorController(channels=(8, 8, 8), features=16, hidden=8)
    head = GoalHead(24)
    batch = {
        "frame": torch.zeros(1, 2, 64, 64, 3, dtype=torch.uint8),
        "proprio": torch.zeros(1, 2, controller.proprio_size),
        "instruction": torch.zeros(1, 2, dtype=torch.int64),
        "terminated": torch.zeros(1, 2, dtype=torch.bool),
        "goal": torch.zeros(1, 2, 4),
        "kind": torch.zeros(1, 2, dtype=torch.int64),
        "label": torch.full((1, 2, 2), 0.7),
        "pose": torch.zeros(1, 2, 3),
    }
    optimiser = torch.optim.Adam([*controller.parameters(), *head.parameters()], 1e-2)
    for _ in range(60):
        output = controller(*(batch[k] for k in ("frame", "proprio", "instruction", "terminated")),
                            controller.initial_memory(1))
        loss, stats = imitation_loss(output, head, batch, DISTIL, BALL.cell_size)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    assert float(stats["error/torque"]) < 0.05
    assert float(output.action.scale.detach().max()) < 0.5


def test_torques_of_blocked_instructions_weigh_as_configured():
    config = replace(DISTIL, infeasible_weight=0.25)
    controller = VisuomotorController(channels=(8, 8, 8), features=16, hidden=8)
    batch = {"goal": torch.zeros(1, 1, 4), "label": torch.full((1, 1, 2), 0.7), "pose": torch.zeros(1, 1, 3)}
    output = controller(
        torch.zeros(1, 1, 64, 64, 3, dtype=torch.uint8), torch.zeros(1, 1, controller.proprio_size),
        torch.zeros(1, 1, dtype=torch.int64), torch.zeros(1, 1, dtype=torch.bool), controller.initial_memory(1),
    )  # fmt: skip

    def action_loss(kind: GoalKind, instruction: Instruction) -> float:
        batch["kind"], batch["instruction"] = torch.tensor([[kind]]), torch.tensor([[instruction]])
        return float(imitation_loss(output, GoalHead(24), batch, config, BALL.cell_size)[1]["loss/action"])

    full = action_loss(GoalKind.PUSH, Instruction.NORTH)
    assert action_loss(GoalKind.HOLD, Instruction.NORTH) == pytest.approx(0.25 * full)
    assert action_loss(GoalKind.HOLD, Instruction.STAY) == pytest.approx(full)


def test_stages_say_what_weights_they_need():
    with pytest.raises(ValueError, match="only the stage distil"):
        TrainConfig(stage="mpo", teacher=Path("teacher.safetensors"))
    with pytest.raises(ValueError, match="expected --teacher"):
        TrainConfig(stage="distil")
    with pytest.raises(ValueError, match="only MPO has such a critic, not --stage teacher"):
        TrainConfig(stage="teacher", algorithm="ppo", critic=Path("critic.safetensors"))
