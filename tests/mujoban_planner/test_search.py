import json
from functools import partial

import numpy as np
import pytest
import torch

from mujoban_core.program import exit_status
from mujoban_planner import evaluate
from mujoban_planner.boards import abstract_states, bit_boards, take_levels
from mujoban_planner.lookahead import LookAheadPlanner, look_ahead
from mujoban_planner.networks import ResidualPlanner
from mujoban_planner.play import play
from mujoban_planner.search import advance, search
from mujoban_sokoban import rules
from mujoban_sokoban.generator import generate_batch, generate_level
from mujoban_sokoban.levels import Level, stack_levels, write_levels


@pytest.fixture(scope="module")
def planner():
    torch.set_num_threads(1)
    torch.manual_seed(0)
    return ResidualPlanner(8, 1).eval()


def test_solutions_found_are_solutions_within_the_move_limit(planner):
    levels = generate_batch(3, range(20))
    found = search(planner, bit_boards(levels), expansions=400, limit=60)
    solved = 0
    for i, instructions in enumerate(found.instructions):
        if not len(instructions):
            continue
        assert len(instructions) <= 60
        boxes, player = levels.boxes[i], levels.player[i]
        for instruction in instructions:
            result = rules.apply(levels.wall[i], levels.target[i], boxes, player, instruction)
            assert result.moved
            boxes, player = result.boxes, result.player
        assert result.solved
        solved += 1
    assert solved >= 15


def test_look_ahead_solves_what_the_policy_alone_does_not(planner):
    levels = generate_batch(3, range(100, 116))
    alone = play(planner, levels).solved.sum()
    ahead = play(LookAheadPlanner(planner, 400), levels).solved.sum()
    assert ahead > alone and ahead >= 13


def test_unsolvable_levels_and_unequal_estimates_fall_back_on_the_policy(planner):
    dead = Level.from_text("#####\n#$ .#\n#@  #\n#####")
    states = abstract_states(stack_levels([dead, dead]))
    states[1, ..., 1] = 0.0  # no target seen
    player = LookAheadPlanner(planner, 50)
    memory = player.initial_state(np.zeros(2, np.int64)).memory
    for _ in range(10):
        decision, memory = player.decide(states, memory)
        assert ((decision >= 0) & (decision < 5)).all()


def test_a_planned_move_that_keeps_failing_is_given_up(planner):
    levels = take_levels(generate_batch(1, range(3)), np.array([0]))
    player = LookAheadPlanner(planner, 200)
    memory = player.initial_state(np.zeros(1, np.int64)).memory
    tried = []
    for _ in range(10):
        decision, memory = player.decide(abstract_states(levels), memory)
        tried.append(int(decision[0]))
    assert len(set(tried)) > 1


def walls_of(levels, first, last):
    states = abstract_states(levels)
    states[..., 0] = np.where(states[..., 0] > 0.5, last, first)
    return states


def play_with_ticks(player, levels, ticks, limit=100):
    """Play a level in which every instruction takes so many ticks; return decisions, and whether it was solved."""
    state, decisions = player.initial_state(np.zeros(1, np.int64)), []
    for t in range(limit * ticks):
        instruction, state = player.step(abstract_states(levels), np.array([t % ticks == 0]), state)
        if t % ticks == 0:
            decisions.append(int(instruction[0]))
            result = rules.apply(*levels, instruction)
            levels = levels._replace(boxes=result.boxes, player=result.player)
            if result.solved[0]:
                return decisions, True
    return decisions, False


def test_a_search_spread_over_ticks_solves_what_it_solves_at_once_and_takes_no_more_in_a_tick(planner, monkeypatch):
    levels = generate_batch(3, range(100, 108))
    most = []
    monkeypatch.setattr(
        "mujoban_planner.lookahead.advance",
        lambda searches, guide, steps: most.append(advance(searches, guide, steps)) or most[-1],
    )
    solved = 0
    for i in range(8):
        player = LookAheadPlanner(planner, 400, per_tick=2)
        decisions, success = play_with_ticks(player, take_levels(levels, np.array([i])), ticks=5)
        solved += success
        assert len(decisions) <= 100
    assert solved >= 6 and max(most) == 2


def test_a_robot_that_looks_ahead_waits_before_a_push_until_the_search_has_ended(planner):
    levels = take_levels(generate_batch(4, range(10)), np.array([3]))
    player = LookAheadPlanner(planner, 60, per_tick=1)
    decisions, _ = play_with_ticks(player, levels, ticks=1, limit=200)
    pushed = next(i for i, d in enumerate(decisions) if d and _pushes(levels, decisions[: i + 1]))
    assert 0 in decisions[:pushed] or pushed >= 60


def _pushes(levels, decisions):
    for decision in decisions:
        result = rules.apply(*levels, np.array([decision]))
        moved = bool((result.boxes != levels.boxes).any())
        levels = levels._replace(boxes=result.boxes, player=result.player)
    return moved


def test_a_plan_that_rests_on_what_is_not_known_is_not_followed_and_a_wall_on_its_way_ends_it(planner):
    levels = take_levels(generate_batch(2, range(2)), np.array([0]))
    player = LookAheadPlanner(planner, 400)
    start = player.initial_state(np.zeros(1, np.int64)).memory
    decision, memory = player.decide(abstract_states(levels), start)
    assert memory[0].any()
    _, vague = player.decide(walls_of(levels, 0.2, 1.0), start)
    assert not vague[0].any()
    result = rules.apply(*levels, decision)
    states = abstract_states(levels._replace(boxes=result.boxes, player=result.player))
    _, kept = player.decide(states, memory)
    assert (kept[0] == memory[0]).all()
    used = (int(memory[3][0]) >> np.arange(64)) & 1
    box = int(bit_boards(levels).box[0])
    here = int(states[0, 1:-1, 1:-1, 2].argmax())
    blocked = next(c for c in np.flatnonzero(used) if not box >> int(c) & 1 and c != here)
    states[0, 1 + blocked // 8, 1 + blocked % 8, 0] = 1.0
    _, after = player.decide(states, memory)
    assert not (after[0] == memory[0]).all()


def test_only_the_learned_planner_can_look_ahead(planner):
    assert look_ahead(planner, 0) is planner
    with pytest.raises(ValueError, match="expected the learned planner"):
        look_ahead(LookAheadPlanner(planner), 100)
    with pytest.raises(ValueError, match="-1 evaluations"):
        look_ahead(planner, -1)


def _run(*arguments):
    return exit_status("evaluate", partial(evaluate.main, [str(a) for a in arguments]))


def test_evaluate_reports_rate_interval_and_optimality(tmp_path, capsys):
    path, out = tmp_path / "levels.txt", tmp_path / "out.json"
    write_levels(path, [generate_level(1, seed) for seed in range(12)])
    assert _run("--levels", path, "--json", out) == 0
    result = json.loads(out.read_text())
    assert result["n"] == 12
    low, high = result["success_interval"]
    assert low <= result["success_rate"] <= high
    assert result["moves_over_optimal"] >= 1.0
    assert "success rate" in capsys.readouterr().out


@pytest.mark.parametrize(
    "arguments",
    [("--difficulty", 6), ("--levels", "missing.txt"), ("--weights", "missing.safetensors"), ("--seed", 10**7)],
)
def test_bad_input_ends_evaluate_with_one_line_and_status_2(arguments, capsys):
    assert _run("--episodes", 3, *arguments) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
