"""The learner of MPO over moves."""

import copy

import numpy as np
import torch

import mujoban_planner
from mujoban_planner.boards import abstract_states
from mujoban_planner.discrete_mpo import MPOBatch, MPOSettings
from mujoban_planner.move_learner import MoveLearner
from mujoban_planner.networks import ResidualPlanner
from mujoban_planner.reinforcement import MPOConfig, reinforcement
from mujoban_rl.limits import NaNGuard
from mujoban_sokoban.generator import generate_batch


def random_batch():
    """Return states of levels, what is done in them, and what it is worth at random."""
    states = torch.from_numpy(abstract_states(generate_batch(4, range(64))))
    instruction, reward = torch.arange(64) % 5, torch.linspace(-2.0, 2.0, 64)
    return MPOBatch(states, instruction, reward, torch.zeros(64), states, torch.ones(64, dtype=torch.bool))


def taught(anchor):
    """Teach a planner what is worth what at random; return it, what it began with, states and losses of Q."""
    torch.manual_seed(0)
    start = ResidualPlanner(8, 1, judge=True)
    planner = copy.deepcopy(start)
    learner = MoveLearner(MPOSettings(learning_rate=1e-2), planner, teach_pushes=True, anchor=anchor)
    batch = random_batch()
    losses = [learner.update(batch, 0.0, NaNGuard())["q_loss"] for _ in range(40)]
    return planner.eval(), start.eval(), batch.state, losses


def test_a_critic_learns_alone_at_first_and_nothing_else_is_touched():
    torch.manual_seed(0)
    planner = ResidualPlanner(8, 1, judge=True)
    before = copy.deepcopy(planner.state_dict())
    learner = MoveLearner(MPOSettings(learning_rate=1e-2), planner, teach_pushes=True, anchor=0.0, critic_first=20)
    losses = [learner.update(random_batch(), 0.0, NaNGuard())["q_loss"] for _ in range(20)]
    assert losses[-1] < 0.95 * losses[0]
    changed = {name for name, values in learner.weights().items() if not torch.equal(values, before[name])}
    assert changed == {"readout.q.weight", "readout.q.bias"}
    learner.update(random_batch(), 0.0, NaNGuard())
    assert not torch.equal(planner.readout.policy.weight, before["readout.policy.weight"])


def test_verdicts_stay_what_they_were_while_the_trunk_learns_what_earns():
    drift = {}
    for anchor in (0.0, 1.0):
        planner, start, states, losses = taught(anchor)
        with torch.no_grad():
            now, before = planner(states), start(states)
        possible = now.push > -5.0  # of others nobody asks
        moves, pushes = (getattr(now, k).sigmoid() - getattr(before, k).sigmoid() for k in ("dead", "push_dead"))
        drift[anchor] = np.array([float(moves.abs().mean()), float(pushes[possible].abs().mean())])
        assert losses[-1] < 0.5 * losses[0]
    assert (drift[1.0] < 0.7 * drift[0.0]).all(), drift


def test_what_teaches_the_policy_teaches_the_pushes_if_told_to_and_never_what_is_deadly():
    planner = mujoban_planner.load(compiled=False)
    states = torch.from_numpy(abstract_states(generate_batch(4, range(64))))
    learners = [MoveLearner(MPOSettings(), planner, teach_pushes=x, anchor=0.0) for x in (True, False)]
    answers = [learner.answers(planner, states) for learner in learners]
    torch.testing.assert_close(answers[0].policy, answers[1].policy)
    heads = planner.heads
    for answer, reached in zip(answers, (True, False), strict=True):
        planner.zero_grad()
        answer.policy.log_softmax(1)[:, 1].sum().backward()
        assert (heads.push.weight.grad is not None and bool(heads.push.weight.grad.any())) == reached
        assert heads.push_dead[-1].weight.grad is None and heads.dead.weight.grad is None


def test_mpo_over_moves_teaches_the_push_head_if_told_to(tmp_path):
    small = {"environments": 8, "batch_size": 8, "warm_up_steps": 8, "replay_steps": 50, "play": 3, "n_step": 2}
    for teach in (False, True):
        config = MPOConfig(channels=8, blocks=1, teach_pushes=teach, **small)
        trainer = reinforcement(config, tmp_path / str(teach))
        before = trainer.learner.network.heads.push.weight.clone()
        trainer.learner.evaluate = dict
        trainer.run(limit_updates=3)
        assert torch.equal(trainer.learner.network.heads.push.weight, before) != teach
