"""Levels that come again: those that were lost, and those whose own solution is long, also from within it."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from mujoban_core.grid import OFFSETS_RC
from mujoban_planner.boards import bit_boards, level_batch
from mujoban_planner.push_actor import PlayConfig, PushActor
from mujoban_planner.push_env import PushEnvironment
from mujoban_planner.search_lessons import SearchActor, SearchConfig
from mujoban_planner.training_levels import LevelConfig, Ticket, TrainingLevels
from mujoban_planner.validation import NetworkConfig
from mujoban_rl.actors import Actor
from mujoban_rl.engine import State
from mujoban_sokoban.bitboard import SIDE, SQUARE_STEP, SQUARES
from mujoban_sokoban.generator import TRAIN_SEEDS, generate_batch, generate_level
from mujoban_sokoban.solver import Status, solve_batch, solve_level

NETWORK = NetworkConfig(channels=8, blocks=1)
AGAIN = {"mined": 0.2, "long": 0.5, "long_moves": 6, "restarted": 0.5}
SEARCH = SearchConfig(trees=32, expansions=20, steps=16, **AGAIN)
PLAY = PlayConfig(environments=32, steps=16, **AGAIN)


def actor(kind: str, **changes: object) -> Actor:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    if kind == "search":
        return SearchActor(NETWORK, replace(SEARCH, **changes), 0, 0)
    return PushActor(NETWORK, replace(PLAY, **changes), 0, 0)


def solution(ticket: Ticket) -> tuple[list[int], int]:
    """Return pushes and moves of a shortest solution, pushes as tickets have them."""
    level = generate_level(ticket.difficulty, ticket.seed)
    at, pushes = level.player, []
    moves = solve_level(level).moves.tolist()
    boxes = set(map(tuple, level.boxes.tolist()))
    for instruction in moves:
        row, column = OFFSETS_RC[instruction].tolist()
        at = (at[0] + row, at[1] + column)
        if at in boxes:
            boxes = boxes - {at} | {(at[0] + row, at[1] + column)}
            pushes.append(4 * (SIDE * (at[0] - 1) + at[1] - 1) + instruction - 1)
    return pushes, len(moves)


def flat(push: int) -> int:
    """Return a ticket's push as the environment has it."""
    return SQUARES * (push % 4) + push // 4


def task_of(ticket: Ticket) -> PushEnvironment:
    """Return a level of its own, played to where a ticket begins."""
    task = PushEnvironment(1, move_limit=1000)
    task.reset_to(np.arange(1), bit_boards(generate_batch(ticket.difficulty, [ticket.seed])))
    for push in ticket.done:
        task.step(np.array([flat(push)]))
    return task


@pytest.fixture(scope="module")
def solved():
    """Return tickets of 40 levels with their solutions and moves."""
    tickets = [Ticket(5, TRAIN_SEEDS.start + i, 0) for i in range(40)]
    return [(ticket, *solution(ticket)) for ticket in tickets]


def test_levels_with_long_solutions_come_again_about_ten_times_also_from_along_these(solved):
    config = LevelConfig(long=0.5, long_moves=30, restarted=0.5)
    levels = TrainingLevels(0, config)
    for ticket, pushes, _ in solved:
        levels.solved_by(ticket, pushes)
    rates = levels.success_rates.tolist()
    long = {ticket.seed: (pushes, moves) for ticket, pushes, moves in solved if moves >= config.long_moves}
    assert 8 < len(long) < 32
    drawn = []
    for _ in range(60):
        boards, tickets = levels.draw(10)
        for i, ticket in enumerate(tickets):
            if ticket.long:
                drawn.append(ticket)
                levels.rate(ticket, solved=False)
                begun = task_of(ticket).boards
                assert all(column[i] == expected[0] for column, expected in zip(boards, begun, strict=True))
    assert {ticket.seed for ticket in drawn} == long.keys()
    assert levels.success_rates.tolist() == rates, "the mix follows first tries"
    assert 4 < len(drawn) / len(long) < 20
    assert 0.3 < np.mean([not ticket.done for ticket in drawn]) < 0.7
    assert all(len(ticket.done) < len(long[ticket.seed][0]) for ticket in drawn)
    status = [solve_batch(level_batch(task_of(ticket).boards)).status[0] for ticket in drawn[:40]]
    assert all(x == Status.SOLVED for x in status)


def detour(ticket: Ticket, pushes: list[int]) -> tuple[list[int], int]:
    """Return a solution's pushes with the boxes taking turns as often as possible, and the moves of that."""
    paths: list[list[int]] = []
    for push in pushes:
        path = next((x for x in paths if x[-1] // 4 + SQUARE_STEP[x[-1] % 4] == push // 4), None)
        paths.append([push]) if path is None else path.append(push)
    task, order, last = task_of(ticket), [], None
    while left := [path for path in paths if path]:
        now = [path for path in left if task.possible()[0, flat(path[0])]]
        if not now:
            return [], 0
        last = next((path for path in now if path is not last), now[0])
        order.append(last.pop(0))
        task.step(np.array([flat(order[-1])]))
    return order, int(task.moves[0])


def test_a_solution_is_as_long_as_in_the_best_order_of_its_pushes(solved):
    levels, detours = TrainingLevels(0, LevelConfig(long=1.0, long_moves=30)), 0
    for ticket, pushes, moves in solved:
        order, length = detour(ticket, pushes)
        if moves < 30 <= length:
            levels.solved_by(ticket, order)
            detours += 1
    assert detours > 3 and not any(ticket.long for ticket in levels.draw(50)[1])


@pytest.mark.parametrize("kind", ["search", "pushes"])
def test_actors_bring_long_and_lost_levels_again(kind):
    player = actor(kind)
    ended = [player.act().statistics for _ in range(12)]
    word = "play" if kind == "search" else "solved"
    tries = {name: np.concatenate([found[f"{word}/{name}"] for found in ended]) for name in ("mined", "long")}
    assert len(tries["mined"]) > 10 and len(tries["long"]) > 10
    assert tries["long"].mean() > tries["mined"].mean(), "what was won before is won more often than what was lost"
    waiting = player.state().part("levels").values["long"]
    for ticket in map(Ticket.of, waiting):
        boards = task_of(ticket).boards
        assert boards.box[0] == boards.target[0], "its pushes solve it"


@pytest.mark.parametrize("kind", ["search", "pushes"])
def test_an_actor_with_levels_that_come_again_goes_on_where_it_was(kind):
    one, other = actor(kind), actor(kind)
    state = one.state()
    for _ in range(40):
        one.act()
        state = one.state()
        if state.part("levels").values["long"]:
            break
    assert state.part("levels").values["long"]
    other.restore(State(json.loads(json.dumps(state.values)), state.tensors))
    delivered = [{name: x.copy() for name, x in player.act().arrays.items()} for player in (one, other)]
    assert all((values == delivered[1][name]).all() for name, values in delivered[0].items())
    states = [player.state().part("levels").values for player in (one, other)]
    assert json.dumps(states[0]) == json.dumps(states[1])


def test_settings_of_levels_that_are_no_shares_are_refused():
    for name, value in (("long", 1.5), ("mined", -0.1), ("restarted", 2.0), ("long_moves", 0)):
        with pytest.raises(ValueError, match=f"{name} is {value}: expected"):
            replace(PLAY, **{name: value})
