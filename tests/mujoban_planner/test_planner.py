import numpy as np
import pytest
import torch

import mujoban_planner
from mujoban_core.grid import GRID_SIZE, Instruction
from mujoban_core.interfaces import take_rows
from mujoban_planner.boards import abstract_states
from mujoban_planner.decision import HISTORY, count_visits, initial_means, initial_visits, recall, remember
from mujoban_planner.heads import Advice, PlannerHeads, verdicts
from mujoban_planner.networks import RecurrentPlanner, ResidualPlanner, ThinkingPlanner
from mujoban_planner.planner import LearnedPlanner, input_planes, split_memory
from mujoban_planner.play import play
from mujoban_planner.propagation import legal_pushes
from mujoban_planner.symmetry import (
    SYMMETRIES,
    average_instructions,
    average_pushes,
    instruction_map,
    view_states,
)
from mujoban_planner.validation import NetworkConfig
from mujoban_rl.weights import save_weights
from mujoban_sokoban.generator import generate_batch
from mujoban_sokoban.levels import Level, stack_levels

ALL = torch.arange(SYMMETRIES)[None]


class Stubborn(LearnedPlanner):
    """Wants to go north whatever happens."""

    def __init__(self, preference=(0.0, 9.0, 3.0, 2.0, 1.0)):
        super().__init__(propagation=False)
        self.preference = torch.nn.Parameter(torch.tensor(preference))

    config = property(lambda self: {})

    def features(self, planes):
        raise NotImplementedError

    heads = PlannerHeads(1, propagation=False, judge=False)

    def advise(self, states, seen):
        pushes = torch.zeros(len(states), 4, 8, 8)
        return Advice(self.preference.expand(len(states), -1), torch.zeros(len(states), 5), pushes, pushes)


def _states(n=4, difficulty=5, seed=0):
    return abstract_states(generate_batch(difficulty, range(seed, seed + n)))


@pytest.mark.parametrize(
    "planner",
    [ResidualPlanner(16, 2), ThinkingPlanner(8, 2, 1), RecurrentPlanner(8, 2), RecurrentPlanner(8, 1, 1, True)],
)
def test_decisions_do_not_depend_on_the_batch(planner):
    planner.eval()
    states = _states(6)
    memory = planner.initial_state(np.arange(6)).memory
    together, _ = planner.decide(states, memory)
    alone = [planner.decide(states[i : i + 1], take_rows(memory, np.array([i])))[0][0] for i in range(6)]
    assert together.tolist() == alone


@pytest.mark.parametrize("planner", [ResidualPlanner(16, 2), ResidualPlanner(8, 1, judge=True), RecurrentPlanner(8)])
def test_heads_have_the_shapes_of_the_paper_and_gradients_reach_every_weight(planner):
    output = planner(torch.from_numpy(_states(3)))
    assert output.policy.shape == output.q.shape == output.dead.shape == (3, len(Instruction))
    sum(x.square().mean() for x in output if x is not None).backward()
    for name, parameter in planner.named_parameters():
        assert parameter.grad is not None, name


def test_a_thinking_planner_repeats_its_last_blocks():
    planner, plain = ThinkingPlanner(8, 3, tied=2).eval(), ResidualPlanner(8, 3).eval()
    for parameter in planner.parameters():
        torch.nn.init.normal_(parameter, 0.0, 0.1)
    plain.load_state_dict(planner.state_dict())
    states = torch.from_numpy(_states(2))
    assert torch.equal(planner(states).policy, plain(states).policy)
    planner.thinking = 3
    plain.blocks.extend([plain.blocks[1], plain.blocks[2]] * 2)
    assert torch.equal(planner(states).policy, plain(states).policy)
    with pytest.raises(ValueError, match="tied is 4: expected from 1 to all 3"):
        ThinkingPlanner(8, 3, tied=4)


def test_recurrent_core_starts_from_a_trainable_state_and_thinks_longer_on_demand():
    planner = RecurrentPlanner(8, 2, 2).eval()
    states = torch.from_numpy(_states(2))
    once = planner(states).policy
    planner.thinking = 3
    assert not torch.allclose(once, planner(states).policy)
    planner.thinking = 1
    with torch.no_grad():
        planner.initial += 0.5
    assert not torch.allclose(once, planner(states).policy)


def test_a_move_that_does_nothing_is_not_repeated_for_ever():
    planner, state = Stubborn(), _states(1)
    memory = planner.initial_state(np.zeros(1, np.int64)).memory
    tried = []
    for _ in range(12):
        decision, memory = planner.decide(state, memory)
        tried.append(int(decision[0]))
    assert len(set(tried[:8])) >= 3
    assert max(len(run) for run in "".join("N" if t == 1 else "." for t in tried).split(".")) <= 4


def test_flickering_estimates_do_not_hide_a_repetition():
    planner, rng = Stubborn(), np.random.default_rng(0)
    state = _states(1)
    memory = planner.initial_state(np.zeros(1, np.int64)).memory
    tried = []
    for _ in range(30):
        flicker = state.copy()
        flicker[0, rng.integers(1, 9), rng.integers(1, 9), 3] = 0.9
        decision, memory = planner.decide(flicker, memory)
        tried.append(int(decision[0]))
    longest = max(len(run) for run in "".join("N" if t == 1 else "." for t in tried).split("."))
    assert longest <= 8 and len(set(tried)) >= 3


def test_cycles_end():
    # East and west in turn on an empty corridor: the state recurs, so other instructions get their turn.
    planner = Stubborn((0.0, 0.1, 5.0, 0.1, 4.9))
    west, east = _states(1), _states(1)
    for state, column in ((west, 4), (east, 5)):
        state[..., 2] = 0.0
        state[0, 5, column, 2] = 1.0
    memory = planner.initial_state(np.zeros(1, np.int64)).memory
    at, tried = 0, []
    for _ in range(30):
        decision, memory = planner.decide((west, east)[at], memory)
        tried.append(int(decision[0]))
        at = {2: 1, 4: 0}.get(tried[-1], at)
    assert {Instruction.NORTH, Instruction.SOUTH} & set(tried)


def test_history_longer_than_the_memory_is_forgotten_gracefully():
    planner, state = Stubborn(), _states(1)
    memory = planner.initial_state(np.zeros(1, np.int64)).memory
    for _ in range(HISTORY + 20):
        decision, memory = planner.decide(state, memory)
    assert 0 <= decision[0] < len(Instruction)


def test_soft_estimates_and_unseen_cells_give_decisions():
    planner = ResidualPlanner(16, 2).eval()
    rng = np.random.default_rng(0)
    states = rng.random((8, GRID_SIZE, GRID_SIZE, 4)).astype(np.float32)
    states[0] = 0.0
    decision, _ = planner.decide(states, planner.initial_state(np.arange(8)).memory)
    assert ((decision >= 0) & (decision < len(Instruction))).all()


def test_bad_abstract_states_are_named():
    planner = ResidualPlanner(8, 1).eval()
    memory = planner.initial_state(np.zeros(1, np.int64)).memory
    with pytest.raises(ValueError, match="shape"):
        planner.decide(np.zeros((1, 8, 8, 4), np.float32), memory)
    with pytest.raises(ValueError, match="finite"):
        planner.decide(np.full((1, GRID_SIZE, GRID_SIZE, 4), np.nan, np.float32), memory)


def test_instruction_is_held_until_termination():
    planner = ResidualPlanner(8, 1).eval()
    state = planner.initial_state(np.arange(2))
    first, state = planner.step(_states(2), np.zeros(2, bool), state)
    held, state = planner.step(_states(2, seed=9), np.zeros(2, bool), state)
    assert np.array_equal(first, held) and state.sequence.tolist() == [1, 1]
    _, state = planner.step(_states(2, seed=9), np.array([True, False]), state)
    assert state.sequence.tolist() == [2, 1]


def test_symmetric_views_bring_instructions_back():
    states = torch.from_numpy(_states(1))
    where = torch.argwhere(states[0, ..., 2])[0]
    for symmetry in range(SYMMETRIES):
        names = instruction_map(symmetry)
        for a, offset in enumerate([(0, 0), (-1, 0), (0, 1), (1, 0), (0, -1)]):
            moved = states.clone()
            moved[..., 2] = 0
            moved[0, where[0] + offset[0], where[1] + offset[1], 2] = 1
            turned = torch.argwhere(view_states(moved, ALL)[symmetry, ..., 2])[0]
            origin = torch.argwhere(view_states(states, ALL)[symmetry, ..., 2])[0]
            step = [(0, 0), (-1, 0), (0, 1), (1, 0), (0, -1)][names[a]]
            assert (turned - origin).tolist() == list(step)
    values, seen = torch.arange(5.0), torch.zeros(SYMMETRIES, 5)
    seen.scatter_(1, torch.tensor([instruction_map(s) for s in range(SYMMETRIES)]), values.expand(SYMMETRIES, -1))
    for views in range(1, SYMMETRIES + 1):  # each view alone shows in the difference to the mean before it
        assert torch.equal(average_instructions(seen[:views], ALL[:, :views]), values[None])


@pytest.mark.parametrize("planner", [ResidualPlanner(16, 2), RecurrentPlanner(8, 2), RecurrentPlanner(8, 1, 1, True)])
def test_saved_planners_load_again_and_decide_alike(planner, tmp_path):
    save_weights(tmp_path / "planner.safetensors", planner, planner.config, {})
    states = _states(6)
    memory = planner.initial_state(np.arange(6)).memory
    loaded = mujoban_planner.load(tmp_path / "planner.safetensors")
    assert np.array_equal(loaded.decide(states, memory)[0], planner.eval().decide(states, memory)[0])


def test_shipped_planner_solves_easy_levels():
    planner = mujoban_planner.load()
    torch.set_num_threads(1)
    game = play(planner, generate_batch(1, range(1000, 1100)))
    assert game.solved.sum() >= 98


def test_tried_pushes_count_as_long_as_the_boxes_are_where_they_were():
    state = _states(1)
    state[..., 2:] = 0.0
    state[0, 5, 4, 2] = state[0, 4, 4, 3] = state[0, 7, 7, 3] = 1.0  # robot, boxes
    visits = remember(state, np.array([Instruction.NORTH]), initial_visits(1))
    visits = remember(state, np.array([Instruction.EAST]), visits)
    pushes = count_visits(state, visits).pushes
    assert pushes.sum() == 1 and pushes[0, Instruction.NORTH - 1, 4, 4] == 1
    elsewhere = state.copy()
    elsewhere[0, 5, 4, 2], elsewhere[0, 6, 4, 2] = 0.0, 1.0  # the robot
    assert np.array_equal(count_visits(elsewhere, visits).pushes, pushes)
    elsewhere[0, 7, 7, 3], elsewhere[0, 7, 6, 3] = 0.0, 1.0  # a box
    assert not count_visits(elsewhere, visits).pushes.any()


def test_a_push_that_undoes_another_is_known_as_such():
    before = _states(1)
    before[..., 2:] = 0.0
    before[0, 5, 3, 2] = before[0, 5, 4, 3] = before[0, 2, 2, 3] = 1.0  # robot, boxes
    after = before.copy()
    after[0, 5, 3:6, 2:] = [[0, 0], [1, 0], [0, 1]]
    visits = remember(before, np.array([Instruction.EAST]), initial_visits(1))
    returns = count_visits(after, visits).returns
    assert returns.sum() == 1 and returns[0, Instruction.WEST - 1, 5, 5]


def test_robot_walks_to_another_push_when_one_was_tried():
    rock = "#" * GRID_SIZE + "\n"
    level = Level.from_text(4 * rock + "#. $@ $ .#\n" + 5 * rock)
    states = abstract_states(stack_levels([level]))
    untried = count_visits(states, initial_visits(1))
    planner = ResidualPlanner(8, 1).eval()

    def eagerness(tried: Instruction) -> float:
        pushes = np.zeros((1, 4, GRID_SIZE, GRID_SIZE), np.float32)
        pushes[:, tried - 1] = 5
        scores, _ = planner.scores(states, untried._replace(pushes=pushes), initial_means(1))
        return scores[0, Instruction.EAST] - scores[0, Instruction.WEST]

    assert eagerness(Instruction.WEST) > eagerness(Instruction.EAST) + 2.0


def test_symmetric_views_bring_pushes_back():
    states = torch.from_numpy(_states(3))

    def pushes(boards: torch.Tensor) -> torch.Tensor:
        return legal_pushes(input_planes(boards), torch.ones(len(boards), 8, 8))

    for views in range(1, SYMMETRIES + 1):
        symmetries = (torch.tensor([[0], [3], [6]]) + torch.arange(views)) % SYMMETRIES  # other views of each state
        assert torch.equal(average_pushes(pushes(view_states(states, symmetries)), symmetries), pushes(states))


def test_thinking_time_averages_symmetric_views():
    planner, states = ResidualPlanner(16, 2).eval(), _states(2)
    planner.thinking = 8
    turned = view_states(torch.from_numpy(states), torch.full((2, 1), 3)).numpy()
    untried = count_visits(states, initial_visits(2))
    upright, seen = (planner.scores(s, untried, initial_means(2))[0] for s in (states, turned))
    assert np.allclose(upright, seen[:, instruction_map(3)], atol=1e-4)
    planner.thinking = 1
    assert not np.allclose(upright, planner.scores(states, untried, initial_means(2))[0], atol=1e-4)


def test_decisions_look_at_the_boxes_from_another_side_each_time():
    planner, states = ResidualPlanner(16, 2).eval(), _states(2)
    untried = count_visits(states, initial_visits(2))
    means = initial_means(2)
    for _ in range(SYMMETRIES):
        means = recall(states, means)
        _, means = planner.scores(states, untried, means)
    planner.thinking = SYMMETRIES
    _, at_once = planner.scores(states, untried, recall(states, initial_means(2)))
    assert all(np.allclose(a, b, atol=1e-5) for a, b in zip(means, at_once, strict=True))
    assert NetworkConfig().build().thinking == 1


class Doubtful(Stubborn):
    """Wants to go north, takes every push for deadly with some probability, and counts how often it looks."""

    perspectives = SYMMETRIES

    def __init__(self, p_dead):
        super().__init__()
        self.p_dead = p_dead
        self.looks: list[list[int]] = []

    def advise(self, states, seen):
        self.looks.append(seen.tolist())
        advice = super().advise(states, seen)
        return advice._replace(push_alive=torch.full((len(states), 4, 8, 8), 1.0 - self.p_dead).log())


def _before_a_push(ahead):
    rock = "#" * GRID_SIZE + "\n"
    return abstract_states(stack_levels([Level.from_text(
        rock + "#.   .  .#\n" + "#   $    #\n" + f"{ahead}\n" + "#  @   $ #\n" + 4 * "#        #\n" + rock
    )]))


@pytest.mark.parametrize(
    ("p_dead", "ahead", "looks"),
    [(0.1, "#  $     #", SYMMETRIES), (0.001, "#  $     #", 1), (0.1, "#     $  #", 1)],
)
def test_planner_looks_from_every_side_before_a_push_that_may_be_deadly(p_dead, ahead, looks):
    planner, state = Doubtful(p_dead).eval(), _before_a_push(ahead)
    memory = planner.initial_state(np.zeros(1, np.int64)).memory
    decision, memory = planner.decide(state, memory)
    assert Instruction(decision[0]) == Instruction.NORTH
    assert planner.looks == [[side] for side in range(looks)], "one side after another"
    if looks == SYMMETRIES:
        planner.decide(state, memory)
        assert len(planner.looks) == SYMMETRIES + 1, "with the boxes where they are no side tells anything new"


def test_a_small_doubt_about_a_push_counts_in_a_decision():
    """What is called deadly with 0.1 % counts as 5.5 %, what is called so for certain as it is."""
    planner, states = ResidualPlanner(8, 1, judge=True).eval(), torch.from_numpy(_states(2))
    for p_dead, counted in ((0.001, 0.055), (0.9999, 0.9998)):
        torch.nn.init.zeros_(planner.heads.push_dead[-1].weight)
        torch.nn.init.constant_(planner.heads.push_dead[-1].bias, float(np.log(p_dead / (1.0 - p_dead))))
        with torch.no_grad():
            said = verdicts(planner(states))
            weighed = planner.advise(states, torch.zeros(2, dtype=torch.int64)).push_alive
        assert torch.allclose(said.exp(), torch.tensor(1.0 - p_dead), atol=1e-6)
        assert torch.allclose(1.0 - weighed.exp(), torch.tensor(counted), atol=5e-4)


def test_planner_that_doubts_nothing_looks_once():
    planner = Doubtful(0.1).eval()
    planner.doubt, planner.thinking = 1.0, 4
    planner.decide(_before_a_push("#  $     #"), planner.initial_state(np.zeros(1, np.int64)).memory)
    assert planner.looks == [[0]]


@pytest.mark.parametrize(("thinking", "looks"), [(1, 1), (4, SYMMETRIES)])
def test_a_planner_that_thinks_longer_looks_again_at_a_smaller_doubt(thinking, looks):
    planner = Doubtful(0.01).eval()  # half of what is doubted by default
    planner.thinking = thinking
    planner.decide(_before_a_push("#  $     #"), planner.initial_state(np.zeros(1, np.int64)).memory)
    assert len(planner.looks) == looks


def test_only_robots_in_doubt_look_again():
    planner = Doubtful(0.1).eval()
    states = np.concatenate([_before_a_push("#     $  #"), _before_a_push("#  $     #")])
    decision, memory = planner.decide(states, planner.initial_state(np.zeros(2, np.int64)).memory)
    assert decision.tolist() == [Instruction.NORTH] * 2
    assert planner.looks == [[0, 0], *([side] for side in range(1, SYMMETRIES))]
    _, means = split_memory(memory)
    assert means.views.tolist() == [1, SYMMETRIES]
    alone = planner.decide(states[1:], planner.initial_state(np.zeros(1, np.int64)).memory)[1]
    assert all(np.array_equal(a[1:], b) for a, b in zip(memory, alone, strict=True)), "each as if it were alone"


def test_means_end_where_the_boxes_move():
    states = _states(2)
    means = recall(states, initial_means(2))._replace(views=np.array([5, 5]))
    assert recall(states, means).views.tolist() == [5, 5]
    moved = states.copy()
    moved[1, ..., 3] = np.roll(states[1, ..., 3], 1, axis=0)
    assert recall(moved, means).views.tolist() == [5, 0]
