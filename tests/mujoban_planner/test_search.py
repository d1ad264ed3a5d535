import json
import sys
from functools import partial
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from mujoban_core.grid import Instruction
from mujoban_core.program import exit_status
from mujoban_msgs_py.runtime.kept import leaves, with_leaves
from mujoban_planner import evaluate, load
from mujoban_planner.boards import abstract_states, bit_boards, take_levels
from mujoban_planner.deliberation import LOOK_AHEAD, Deliberation
from mujoban_planner.lookahead import LookAheadPlanner
from mujoban_planner.networks import ResidualPlanner
from mujoban_planner.planner import split_memory
from mujoban_planner.play import play
from mujoban_planner.search import LoneSearch, advance, search
from mujoban_sokoban import rules
from mujoban_sokoban.generator import generate_batch, generate_level
from mujoban_sokoban.levels import Level, stack_levels, write_levels


@pytest.fixture(scope="module")
def planner():
    torch.manual_seed(0)
    return ResidualPlanner(8, 1).eval()


def test_solutions_found_are_solutions_within_the_move_limit(planner):
    levels = generate_batch(3, range(10))
    found = search(planner, bit_boards(levels), expansions=300, limit=60)
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
    assert solved >= 8


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
        lambda searches, guide, *steps: most.append(advance(searches, guide, *steps)) or most[-1],
    )
    solved = 0
    for i in range(8):
        player = LookAheadPlanner(planner, 400, per_tick=2)
        decisions, success = play_with_ticks(player, take_levels(levels, np.array([i])), ticks=5)
        solved += success
        assert len(decisions) <= 100
    assert solved >= 6 and max(most) == 2


@pytest.mark.parametrize(("deadline", "in_a_tick"), [(1e-9, {1}), (60.0, range(20, 401)), (0.0, {7})])
def test_in_real_time_a_tick_has_as_many_evaluations_as_fit_into_its_share_and_one_at_least(
    planner, deadline, in_a_tick
):
    player = Deliberation(look_ahead=400, per_tick=7, deadline=deadline).prepare(planner)
    states = abstract_states(take_levels(generate_batch(5, range(100, 101)), np.array([0])))
    player.decide(states, player.initial_memory(1))
    assert player.evaluations in in_a_tick


def test_a_robot_that_looks_ahead_waits_before_a_push_until_the_search_has_ended(planner):
    levels = take_levels(generate_batch(4, range(10)), np.array([3]))
    player = LookAheadPlanner(planner, 60, per_tick=1)
    decisions, _ = play_with_ticks(player, levels, ticks=1, limit=200)
    pushed = next(i for i, d in enumerate(decisions) if d and _pushes(levels, decisions[: i + 1]))
    assert 0 in decisions[:pushed] or pushed >= 60


def test_a_robot_waits_for_one_search_at_most_where_estimates_flicker_and_forgets_nothing(planner, monkeypatch):
    lines = ("########\n#@$  . #\n#      #\n#  $ . #\n########", "########\n#@$  . #\n#  $   #\n#    . #\n########")
    states = [abstract_states(stack_levels([Level.from_text(text)])) for text in lines]
    player = LookAheadPlanner(planner, 300, per_tick=1)
    pushing = np.array([Instruction.EAST])
    monkeypatch.setattr(planner, "choose", lambda states, counts, means: (pushing, means))
    decisions, memory = [], player.initial_state(np.zeros(1, np.int64)).memory
    for tick in range(310):
        decision, memory = player.decide(states[tick % 2], memory)
        decisions.append(int(decision[0]))
    assert decisions == [Instruction.STAY] * 300 + [Instruction.EAST] + [Instruction.STAY] * 9
    assert split_memory(memory[8:])[0].count[0] == 1, "what was put off was not tried"


def test_a_search_goes_on_in_the_process_that_comes_after_a_killed_one(planner):
    level = take_levels(generate_batch(5, range(100, 101)), np.array([0]))

    def played(kill):
        player, levels = LookAheadPlanner(planner, 400, per_tick=3), level
        state, decisions = player.initial_state(np.zeros(1, np.int64)), []
        for tick in range(40):
            if kill and tick % 7 == 5:
                player = LookAheadPlanner(planner, 400, per_tick=3)
                state = with_leaves(player.initial_state(np.zeros(1, np.int64)), leaves(state))
            instruction, state = player.step(abstract_states(levels), np.array([tick % 3 == 0]), state)
            if tick % 3 == 0:
                decisions.append(int(instruction[0]))
                result = rules.apply(*levels, instruction)
                levels = levels._replace(boxes=result.boxes, player=result.player)
        return decisions, [leaf.tolist() for leaf in leaves(state)]

    assert played(kill=True) == played(kill=False)


def _pushes(levels, decisions):
    for decision in decisions:
        result = rules.apply(*levels, np.array([decision]))
        moved = bool((result.boxes != levels.boxes).any())
        levels = levels._replace(boxes=result.boxes, player=result.player)
    return moved


def first_plan(planner, states):
    """Return the plan for the first state of an episode, zeros where there is none, and the memory."""
    player = LookAheadPlanner(planner, 400)
    decision, memory = player.decide(states, player.initial_state(np.zeros(1, np.int64)).memory)
    return memory[0][0], decision, memory


CORRIDOR = Level.from_text("########\n#@$  .##\n########")
AHEAD, TARGET_CELL, BOX_CELL = (4, 5), (4, 6), (4, 3)


def corridor(cell=None, channel=0, probability=0.0, level=CORRIDOR):
    """Return the abstract state of the corridor, in which one probability is another."""
    states = abstract_states(stack_levels([level]))
    if cell is not None:
        states[0, *cell, channel] = probability
    return states


@pytest.mark.parametrize(
    ("cell", "channel", "vague", "known"),
    [(AHEAD, 0, 0.2, 0.05), (AHEAD, 3, 0.45, 0.05), (TARGET_CELL, 1, 0.6, 0.95), (BOX_CELL, 3, 0.6, 0.95)],
    ids=["wall", "box in the way", "target", "box"],
)
def test_a_plan_is_followed_only_while_all_that_it_needs_is_certain(planner, cell, channel, vague, known):
    player = LookAheadPlanner(planner, 400)
    assert not first_plan(planner, corridor(cell, channel, vague))[0].any()
    plan, decision, memory = first_plan(planner, corridor(cell, channel, known))
    assert decision[0] == plan[0] and np.count_nonzero(plan) == 3
    pushed = Level.from_text("########\n# @$ .##\n########")
    cell = (4, 4) if cell == BOX_CELL else cell
    for probability, kept in ((known, True), (vague, False)):
        _, after = player.decide(corridor(cell, channel, probability, pushed), memory)
        assert (after[0] == memory[0]).all() == kept


HALL = Level.from_text("########\n#@$  .##\n#      #\n#      #\n########")


def hall(box, target, level=HALL):
    """Return a state in which there is so probably a box, and so probably a target, in each cell below the corridor."""
    states = corridor(level=level)
    states[0, 4:6, 2:8, 3], states[0, 4:6, 2:8, 1] = box, target
    assert not states[0, 4:6, 2:8, 0].any() and states[0, 3, :, 1].any()
    return states


@pytest.mark.parametrize(
    ("box", "target", "certainty", "followed"),
    [(0.04, 0.04, 0.9, False), (0.04, 0.04, 0.0, True), (0.001, 0.04, 0.9, True), (0.04, 0.001, 0.9, True)],
    ids=["a box and its target may be hidden", "nothing is to be certain", "no box is hidden", "no target is hidden"],
)
def test_a_plan_is_followed_only_while_no_box_with_its_target_is_to_be_found(
    planner, box, target, certainty, followed
):
    player = LookAheadPlanner(planner, 400, certainty=certainty)
    _, memory = player.decide(hall(box, target), player.initial_state(np.zeros(1, np.int64)).memory)
    assert memory[0].any() == followed
    plan, _, memory = first_plan(planner, hall(0.0, 0.0))
    pushed = Level.from_text(HALL.to_text().replace("@$ ", " @$"))
    _, after = player.decide(hall(box, target, pushed), memory)
    assert np.count_nonzero(plan) == 3 and (after[0] == plan).all() == followed


def test_a_plan_for_a_level_that_was_seen_whole_is_followed(planner):
    """An estimate of such a level, of the running stack: 0.1 % for boxes that there are not, a doubtful target."""
    states = hall(0.0001, 0.0005)
    states[0, 4, 6, 1] = 0.4
    rock = states[0, ..., 0] > 0.5
    states[0, rock, 0], states[0, rock, 1:] = 0.97, [0.01, 0.0, 0.01]
    states[0, [0, -1]], states[0, :, [0, -1]] = [1.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]
    assert first_plan(planner, states)[0].any()


def test_what_a_plan_has_left_behind_need_not_be_certain(planner):
    _, _, memory = first_plan(planner, corridor())
    states = corridor((4, 2), 3, 0.4, Level.from_text("########\n# @$ .##\n########"))
    _, after = LookAheadPlanner(planner, 400).decide(states, memory)
    assert (after[0] == memory[0]).all()


def test_a_plan_is_followed_although_an_estimate_holds_what_cannot_be(planner):
    wall = (3, 4)
    _, _, memory = first_plan(planner, corridor(wall, 3, 0.6))
    assert memory[0].any()
    states = corridor(wall, 3, 0.6, Level.from_text("########\n# @$ .##\n########"))
    _, after = LookAheadPlanner(planner, 400).decide(states, memory)
    assert (after[0] == memory[0]).all()


def test_a_robot_far_from_where_a_search_began_gets_a_solution_longer_than_its_limit(planner):
    level = Level.from_text("########\n#      #\n#      #\n#      #\n#      #\n#@$.   #\n#      #\n########")
    begun = LoneSearch(bit_boards(stack_levels([level])), 100, 3)
    advance([begun], planner, 100)
    assert len(begun.solution(int(begun.start.agent[0]))) == 1
    moved = level.to_text().replace("@", " ").replace("#      #", "#     @#", 1)
    far = bit_boards(stack_levels([Level.from_text(moved)]))
    found = begun.solution(int(far.agent[0]))
    assert len(found) > 4 and found[-1] == Instruction.EAST


def test_only_the_learned_planner_thinks_longer(planner):
    assert Deliberation(look_ahead=0).prepare(planner) is planner and planner.thinking == 1
    assert Deliberation().prepare(planner).expansions == LOOK_AHEAD
    assert Deliberation().prepare(planner, "oracle") is Deliberation().prepare(planner, "my:Own") is planner
    searching = Deliberation(look_ahead=100, per_tick=7, certainty=0.8).prepare(planner)
    assert (searching.expansions, searching.per_tick, searching.certainty) == (100, 7, 0.8)
    for asked in (Deliberation(look_ahead=100), Deliberation(thinking=2)):
        with pytest.raises(ValueError, match="LookAheadPlanner: expected a learned planner"):
            asked.prepare(searching)


def test_thinking_time_reaches_the_network():
    network, state = load(compiled=False), torch.from_numpy(abstract_states(generate_batch(5, range(2))))
    seen = torch.zeros(2, dtype=torch.int64)
    with torch.inference_mode():
        quick = network.advise(state, seen).push
        Deliberation(thinking=3, look_ahead=0).prepare(network)
        assert network.thinking == 3 and not torch.equal(network.advise(state, seen).push, quick)


@pytest.mark.parametrize("name", ["thinking", "look_ahead", "per_tick", "certainty", "deadline"])
def test_no_thinking_time_out_of_its_range(name):
    with pytest.raises(ValueError, match=f"{name} is -1: expected "):
        Deliberation(**{name: -1})


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


def test_levels_of_which_no_optimal_solution_is_known_say_nothing_of_optimality(monkeypatch):
    monkeypatch.setattr(evaluate, "solve_batch", partial(evaluate.solve_batch, max_nodes=1))
    figures = evaluate.evaluate(load(), generate_batch(1, range(4)), evaluate.Options())
    assert figures["success_rate"] > 0.0 and "moves_over_optimal" not in figures


def test_what_was_evaluated_is_kept_though_nobody_reads_it_any_more(tmp_path, monkeypatch):
    out = tmp_path / "out.json"
    monkeypatch.setattr(sys.stdout, "write", Mock(side_effect=BrokenPipeError))
    with pytest.raises(BrokenPipeError):
        evaluate.main(["--difficulty", "1", "--episodes", "2", "--seed", "1000", "--json", str(out)])
    assert json.loads(out.read_text())["test_uses"][0]["seeds"] == [1000, 1001]


@pytest.mark.parametrize(
    "arguments",
    [
        ("--difficulty", 6),
        ("--levels", "missing.txt"),
        ("--weights", "missing.safetensors"),
        ("--seed", 10**7),
        ("--thinking", -3),
        ("--thinking", 65),
        ("--caution", "nan"),
        ("--look-ahead", -1),
        ("--episodes", -1),
    ],
)
def test_bad_input_ends_evaluate_with_one_line_and_status_2(arguments, capsys):
    assert _run("--episodes", 3, *arguments) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
