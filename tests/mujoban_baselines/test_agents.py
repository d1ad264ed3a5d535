"""The agents of Table 1: what they see, what they remember, what their subgoals are."""

import numpy as np
import pytest
import torch

from mujoban_baselines import load
from mujoban_baselines.agents import AGENTS, SIZES, MonolithicAgent, StructuredAgent
from mujoban_baselines.drawing import Drawing
from mujoban_baselines.networks import Recurrent
from mujoban_baselines.subgoals import SUBGOAL_LIMIT, Subgoals, adjacent_state
from mujoban_core.agent import AgentInput
from mujoban_core.grid import AGENT, BOX
from mujoban_core.interfaces import renew_rows
from mujoban_rl.weights import WeightsError, save_weights
from mujoban_sokoban.levels import Level

ROOM = Level.from_text("#####\n#@$.#\n#   #\n#####\n").abstract_state()


def seen(batch, rng):
    return AgentInput(
        frame=rng.integers(0, 255, (batch, 64, 64, 3), np.uint8),
        proprio=rng.normal(size=(batch, 16)).astype(np.float32),
        pose=rng.normal(size=(batch, 3)).astype(np.float32),
        top_down=rng.integers(0, 255, (batch, 64, 64, 3), np.uint8),
        abstract_state=np.stack([ROOM] * batch),
    )


@pytest.mark.parametrize("name", AGENTS)
def test_a_robot_acts_the_same_alone_and_among_others_and_starts_anew_after_its_episode(name):
    torch.manual_seed(0)
    agent, rng = AGENTS[name]().eval(), np.random.default_rng(0)
    fresh = agent.initial_state(np.array([5, 6, 7]))
    first, second = seen(3, rng), seen(3, rng)
    torque, state = agent.step(first, fresh)
    assert torque.shape == (3, 2) and np.abs(torque).max() <= 1.0
    later, state = agent.step(second, state)
    alone = agent.initial_state(np.array([6]))
    for one, together in ((first, torque), (second, later)):
        said, alone = agent.step(AgentInput(*(value[1:2] for value in one)), alone)
        np.testing.assert_allclose(said, together[1:2], atol=1e-5)
    renewed = renew_rows(state, fresh, np.array([False, True, False]))
    np.testing.assert_allclose(agent.step(first, renewed)[0][1], torque[1], atol=1e-5)


@pytest.mark.parametrize("name", AGENTS)
def test_sequences_give_what_single_ticks_give_and_episodes_begin_inside_of_them(name):
    torch.manual_seed(0)
    agent, rng = AGENTS[name]().eval(), np.random.default_rng(0)
    state, ticks = agent.initial_state(np.arange(2)), []
    memory = agent.initial_memory(2)
    first = np.zeros((2, 4), np.bool_)
    first[1, 2] = True
    single = []
    for i in range(4):
        sights, _, others = agent.look(seen(2, rng), state)
        state = (*state[:2], *others)
        ticks.append(sights)
        memory = renew_rows(memory, agent.initial_memory(2), first[:, i])
        with torch.no_grad():
            output = agent(agent.to_tensors(sights), Recurrent(*memory))
        memory = output.memory
        single.append(output.action.mean[:, 0])
    whole = {name: torch.from_numpy(np.stack([t[name] for t in ticks], 1)) for name in agent.reads}
    with torch.no_grad():
        joined = agent(whole, Recurrent(*agent.initial_memory(2)), torch.from_numpy(first))
    torch.testing.assert_close(joined.action.mean, torch.stack(single, 1), atol=1e-5, rtol=1e-4)


def test_larger_sizes_have_more_weights_and_an_unknown_one_is_named():
    counts = [sum(p.numel() for p in MonolithicAgent(size=size).parameters()) for size in SIZES]
    assert counts == sorted(counts) and counts[0] < counts[1] < counts[2]
    with pytest.raises(ValueError, match="size 'XL': expected one of S, M, L"):
        MonolithicAgent(size="XL")


def test_what_agents_see_is_declared():
    assert not MonolithicAgent().privileged
    assert all(AGENTS[name]().privileged for name in ("TopDownAgent", "StructuredAgent"))


def test_weights_bring_back_the_agent_that_they_are_of(tmp_path):
    torch.manual_seed(0)
    agent, rng = StructuredAgent().eval(), np.random.default_rng(0)
    # What was written before agents knew of held torques says nothing of these.
    save_weights(tmp_path / "agent.safetensors", agent, {"body": "ball"}, {})
    loaded, inputs = load(tmp_path / "agent.safetensors"), seen(1, rng)
    assert isinstance(loaded, StructuredAgent)
    said = [a.step(inputs, a.initial_state(np.array([3])))[0] for a in (agent, loaded)]
    np.testing.assert_array_equal(*said)
    other = torch.nn.Linear(1, 1)
    save_weights(tmp_path / "other.safetensors", other, {"in_features": 1, "out_features": 1}, {})
    with pytest.raises(WeightsError, match=r"holds weights of Linear, expected one of MonolithicAgent"):
        load(tmp_path / "other.safetensors")


def test_subgoals_are_states_one_move_away():
    draws = [adjacent_state(ROOM > 0.5, draw) for draw in np.linspace(0, 0.999, 8)]
    assert all((d != (ROOM > 0.5)).any() for d in draws), "walls lead nowhere, and are not drawn"
    # Two moves are possible: to push the box east, and to go south.
    assert len({d.tobytes() for d in draws}) == 2
    assert {bool((d[..., BOX] != (ROOM[..., BOX] > 0.5)).any()) for d in draws} == {False, True}


def test_a_subgoal_holds_until_it_is_reached_or_its_time_is_up():
    state = ROOM[None]
    subgoals = Subgoals.none_yet(np.array([4])).renewed(state)
    held = subgoals
    for _ in range(SUBGOAL_LIMIT - 1):
        held = held.aged().renewed(state)
        assert (held.target == subgoals.target).all() and not held.reached(state).any()
    assert held.aged().over(state).all() and held.aged().renewed(state).drawn == 2
    there = subgoals.target.astype(np.float32)
    assert subgoals.reached(there).all()
    following = subgoals.renewed(there)
    assert following.drawn == 2 and not following.reached(there).any()


def test_subgoals_and_torques_are_drawn_apart():
    """Both by the episode's seed, in play as in training."""
    seeds = np.arange(500)
    subgoals = Subgoals.none_yet(seeds).renewed(np.stack([ROOM] * 500))
    pushed = (subgoals.target[..., BOX] != (ROOM[..., BOX] > 0.5)).any((1, 2))
    noise = Drawing(StructuredAgent(draws="pink").eval(), "pink").initial_state(seeds)[-3]
    apart = np.corrcoef(pushed, noise[:, 0, 0])[0, 1]
    assert abs(apart) < 0.2, "1/sqrt(500) is 0.04"


def test_a_state_without_an_agent_is_its_own_subgoal():
    nobody = ROOM > 0.5
    nobody[..., AGENT] = False
    assert adjacent_state(nobody, 0.5) is nobody
