import json
import sys

import numpy as np
import pytest
import torch

from mujoban_planner import evaluate
from mujoban_planner.boards import abstract_states, bit_boards, take_levels
from mujoban_planner.lookahead import LookAheadPlanner
from mujoban_planner.networks import ResidualPlanner
from mujoban_planner.play import play
from mujoban_planner.search import search
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


def _run(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["evaluate", *map(str, arguments)])
    evaluate.main()


def test_evaluate_reports_rate_interval_and_optimality(tmp_path, monkeypatch, capsys):
    path, out = tmp_path / "levels.txt", tmp_path / "out.json"
    write_levels(path, [generate_level(1, seed) for seed in range(12)])
    _run(monkeypatch, "--levels", path, "--json", out)
    result = json.loads(out.read_text())
    assert result["episodes"] == 12
    low, high = result["solve_interval"]
    assert low <= result["solve_rate"] <= high
    assert result["moves_over_optimal"] >= 1.0
    assert "solve_rate" in capsys.readouterr().out


@pytest.mark.parametrize(
    "arguments",
    [("--difficulty", 6), ("--levels", "missing.txt"), ("--weights", "missing.safetensors"), ("--seed", 10**7)],
)
def test_bad_input_ends_evaluate_with_one_line_and_status_2(arguments, monkeypatch, capsys):
    with pytest.raises(SystemExit) as exit_:
        _run(monkeypatch, "--episodes", 3, *arguments)
    assert exit_.value.code == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
