import math
from dataclasses import replace
from functools import partial
from itertools import chain

import numpy as np
import pytest
import torch

from mujoban_core.grid import DIFFICULTIES
from mujoban_planner import load
from mujoban_planner.boards import BitBoards, bit_boards, level_batch
from mujoban_planner.expert_iteration import ExpertIterationConfig, expert_iteration
from mujoban_planner.forest import Forest
from mujoban_planner.lesson_store import LessonStore
from mujoban_planner.lessons import errs
from mujoban_planner.networks import ResidualPlanner
from mujoban_planner.samples import Samples, concatenate
from mujoban_planner.search import evaluate_boards, grow
from mujoban_planner.search_lessons import SearchActor, SearchConfig
from mujoban_planner.teacher import reachable_pushes
from mujoban_planner.training_levels import LevelConfig, TrainingLevels
from mujoban_planner.validation import NetworkConfig
from mujoban_rl.actors import Experience
from mujoban_rl.engine import Cadence
from mujoban_rl.testing import check_refusal, check_resuming
from mujoban_sokoban.bitboard import SQUARE_STEP
from mujoban_sokoban.generator import TRAIN_SEEDS, generate_batch
from mujoban_sokoban.levels import Level, stack_levels
from mujoban_sokoban.solver import Status, solve_batch

NETWORK = NetworkConfig(channels=8, blocks=1)
KINDS = ("way", "verdict")
SMALL = SearchConfig(trees=16, expansions=20, buffer=4000, steps=16, batch_size=32, noise=0.1, hidden=0.2, errors=1.0)


@pytest.fixture(scope="module")
def lessons():
    torch.set_num_threads(1)
    torch.manual_seed(0)
    actor, store = SearchActor(NETWORK, SMALL, 0, 0), LessonStore(SMALL, 0)
    for _ in range(16):
        store.add(actor.act())
    return {kind: buffer.storage.take(np.arange(min(buffer.size, 400))) for kind, buffer in store.buffers.items()}


def judged_pushes(samples: Samples):
    """Return each state, direction and square of a push that was judged, and whether it is deadly."""
    bits = [np.unpackbits(np.ascontiguousarray(x).view(np.uint8), axis=1, bitorder="little") for x in samples[-2:]]
    state, push = np.nonzero(bits[0])
    return state, push // 64, push % 64, bits[1][state, push].astype(bool)


@pytest.fixture(scope="module")
def winner():
    """A planner that wins, and what searches deliver about its play, by the share that is kept of what is easy."""
    actor = SearchActor(NETWORK, replace(SMALL, trees=64, audited=1.0), 0, 0)
    actor.planner = load(compiled=False)
    actor.planner.lay_out()
    delivered = {}
    for easy, acts in ((1.0, 2), (0.0, 3)):
        actor.config = replace(actor.config, easy=easy)
        delivered[easy] = [actor.act().arrays for _ in range(acts)]
    return actor.planner, delivered


def samples_of(kinds, delivered):
    """Return all samples of these kinds."""
    return concatenate([Samples._make(x[f"{kind}.{n}"] for n in Samples._fields) for x in delivered for kind in kinds])


def test_what_searches_prove_of_pushes_is_what_the_solver_says(lessons, winner):
    audits = samples_of(["audit"], [*chain(*winner[1].values())])
    for kind, both, least in (("way", True, 30), ("verdict", False, 30), ("played", True, 3), ("audit", True, 3)):
        samples = (lessons | {"audit": audits})[kind]
        state, direction, square, deadly = judged_pushes(samples)
        one = np.uint64(1)
        box = samples.box[state] ^ (one << square.astype(np.uint64))
        box |= one << (square + SQUARE_STEP[direction]).astype(np.uint64)
        boards = BitBoards(samples.wall[state], samples.target[state], box, square.astype(np.uint8))
        status = solve_batch(level_batch(boards)).status
        assert (status == np.where(deadly, Status.UNSOLVABLE, Status.SOLVED)).all()
        assert deadly.sum() > least and (not both or (~deadly).sum() > least)


def test_no_state_is_evaluated_twice_in_a_search():
    torch.manual_seed(0)
    forest, rows = Forest(16, 200, 120), np.arange(16)
    forest.plant(rows, bit_boards(generate_batch(4, range(TRAIN_SEEDS.start, TRAIN_SEEDS.start + 16))))
    planner = ResidualPlanner(8, 1, judge=True).eval()
    while (rows := np.flatnonzero(forest.open & (forest.expansions < 200))).size:
        grow(forest, rows, partial(evaluate_boards, planner))
    trees, again = forest.trees, 0
    for row in range(16):
        nodes = np.flatnonzero(trees.expanded[row, : trees.nodes[row]])
        states = set(zip(trees.box[row, nodes].tolist(), trees.region[row, nodes].tolist(), strict=True))
        assert len(states) == len(nodes) == forest.expansions[row]
        # Some were reached by a likelier way after they had been reached by another: it is theirs then.
        again += int((trees.parent[row, 1 : trees.nodes[row]] > np.arange(1, trees.nodes[row])).sum())
        cost = trees.cost[row, trees.heap[row, : trees.waiting[row]]]
        assert all(cost[(i - 1) // 2] <= cost[i] for i in range(1, len(cost))), "the cheapest first"
    assert again > 0


def test_what_own_play_wins_is_not_searched():
    torch.manual_seed(0)
    actor = SearchActor(NETWORK, SMALL, 0, 0)
    statistics = [actor.act().statistics for _ in range(12)]
    played, searched = (
        np.concatenate([found[f"{kind}/{d}"] for found in statistics for d in DIFFICULTIES])
        for kind in ("play", "search")
    )
    won, lost = int(played.sum()), int((1 - played).sum())
    assert won > 5 and 5 < len(searched) <= lost


def test_learning_waits_until_searches_have_taught_enough(lessons):
    store, batch = LessonStore(SMALL, 0), SMALL.batch_size
    rows = {kind: samples.take(np.arange(min(batch, len(samples.agent)))) for kind, samples in lessons.items()}
    for start, stop in ((0, 0), (0, batch - 1), (batch - 1, batch)):
        assert store.sample() is None
        few = {f"{kind}.{name}": x[start:stop] for kind, part in rows.items() for name, x in part._asdict().items()}
        store.add(Experience(few, 1, {}))
    sampled = store.sample()
    assert sampled is not None and len(sampled.state) == batch


def test_states_of_both_kinds_are_blurred_and_hidden(lessons):
    store = LessonStore(SMALL, 0)
    arrays = {f"{kind}.{name}": x for kind, samples in lessons.items() for name, x in samples._asdict().items()}
    store.add(Experience(arrays, 1, {}))
    blurred, hidden = int(SMALL.batch_size * SMALL.noise), int(SMALL.batch_size * SMALL.hidden)
    right = torch.stack([store.sample().right.any(1) for _ in range(20)])
    for part in (right[:, :blurred], right[:, -hidden:]):
        assert part.any() and not part.all(), "only states of ways say what is right"


def test_a_buffer_holds_a_batch():
    with pytest.raises(ValueError, match="buffer is 100: expected at least a batch of 256"):
        SearchConfig(buffer=100)


def test_of_the_lessons_those_are_kept_in_which_the_planner_errs(winner):
    planner, delivered = winner
    erred = {easy: errs(planner, samples_of(KINDS, lessons)) for easy, lessons in delivered.items()}
    assert erred[0.0].sum() > 0 and (~erred[0.0]).sum() < 3, "but for rounding, all"
    assert (~erred[1.0]).sum() > 3


def test_a_solved_search_goes_on_to_judge_the_pushes_beside_its_way():
    torch.manual_seed(0)
    forest = Forest(32, 400, 120)
    forest.plant(np.arange(32), bit_boards(generate_batch(3, range(TRAIN_SEEDS.start, TRAIN_SEEDS.start + 32))))
    planner = ResidualPlanner(8, 1, judge=True).eval()
    while (rows := np.flatnonzero(forest.open & (forest.expansions < 200))).size:
        grow(forest, rows, partial(evaluate_boards, planner))
    solved = np.flatnonzero(forest.trees.solution > 0)
    assert len(solved) > 8

    def judged(row):
        """Return the pushes from states on the way that are judged, [length of the way, 4]."""
        verdicts = forest.judge(row)
        return verdicts.known[np.isin(verdicts.node, forest.way(row))]

    before, ways = [judged(row) for row in solved], [forest.way(row).tolist() for row in solved]
    forest.question(solved)
    for _ in range(150):
        if (rows := solved[forest.trees.waiting[solved] > 0]).size:
            grow(forest, rows, partial(evaluate_boards, planner))
    after = [judged(row) for row in solved]
    assert all((x & ~y == 0).all() for x, y in zip(before, after, strict=True)), "nothing is forgotten"
    assert [forest.way(row).tolist() for row in solved] == ways, "the solution stays what it was"
    done = [i for i, row in enumerate(solved) if forest.trees.waiting[row] == 0]
    assert len(done) > len(solved) // 4
    missing = 0
    for i in done:
        possible = reachable_pushes(forest.boards(solved[i], np.sort(forest.way(solved[i]))))
        assert (after[i] == possible).all(), "where nothing waits, all is judged"
        missing += int(np.bitwise_count(possible & ~before[i]).sum())
    assert missing > 20


def test_ways_lead_to_the_solution_in_the_moves_that_their_values_count(lessons):
    ways = lessons["way"]
    solved = solve_batch(level_batch(ways.boards))
    assert (solved.status == Status.SOLVED).all()
    last = np.isclose(ways.value, 10.99)  # the last box goes home in the next instruction
    assert last.any() and (solved.length[last] == 1).all()


def test_a_search_that_has_looked_everywhere_proves_a_level_lost():
    lost = Level.from_text("########\n# .#####\n#  $   #\n# $### #\n#@.#####\n########")
    assert solve_batch(stack_levels([lost])).status[0] == Status.UNSOLVABLE
    torch.manual_seed(0)
    forest = Forest(1, 400, 120)
    forest.plant(np.arange(1), bit_boards(stack_levels([lost])))
    planner = ResidualPlanner(8, 1).eval()
    steps = 0
    while forest.open.any():
        verdicts = forest.judge(0)
        assert 0 not in verdicts.node[verdicts.lost], "not while a state waits"
        grow(forest, np.arange(1), partial(evaluate_boards, planner))
        steps += 1
    verdicts = forest.judge(0)
    assert verdicts.lost[0] and not verdicts.solvable[0]
    assert steps == forest.expansions[0] > 5, "it is not dead at sight"


def test_levels_that_were_not_solved_come_again_and_the_mix_follows_what_is_solved():
    levels = TrainingLevels(0, retried=1.0, retries=1)
    _, tickets = levels.draw(64)
    assert all(ticket.seed in TRAIN_SEEDS for ticket in tickets)
    levels.come_again(tickets[0])
    boards, again = levels.draw(1)
    assert again == [tickets[0]._replace(failures=1)]
    expected = bit_boards(generate_batch(tickets[0].difficulty, [tickets[0].seed]))
    assert all((x == y).all() for x, y in zip(boards, expected, strict=True))
    levels.come_again(again[0])
    assert levels.draw(1)[1][0].failures == 0
    for _ in range(300):
        for ticket in levels.draw(4)[1]:
            levels.rate(ticket, solved=True)
    assert levels.shares[-1] > 0.8
    with pytest.raises(ValueError, match="stream -1"):
        TrainingLevels(-1)


def test_levels_that_were_lost_at_first_come_until_they_have_been_won_several_times():
    levels = TrainingLevels(0, LevelConfig(mined=0.5))
    lost, won = levels.draw(2)[1]
    levels.rate(lost, solved=False)
    levels.rate(won, solved=True)
    rates = levels.success_rates.tolist()
    wins = 0
    for _ in range(1000):
        (ticket,) = levels.draw(1)[1]
        if ticket.mined:
            assert ticket == lost._replace(mined=True)
            levels.rate(ticket, solved=True)
            wins += 1
    assert 1 < wins < 200, "about ten times"
    assert levels.success_rates.tolist() == rates, "the mix follows first tries"


def test_levels_that_are_lost_again_and_again_are_given_up():
    levels = TrainingLevels(0, LevelConfig(mined=0.5))
    levels.rate(levels.draw(1)[1][0], solved=False)
    losses = 0
    for _ in range(1000):
        (ticket,) = levels.draw(1)[1]
        levels.rate(ticket, solved=not ticket.mined)
        losses += ticket.mined
    assert 0 < losses < 60, "about five times"


def test_another_seed_plays_other_levels_by_another_chance_and_all_are_for_training():
    seen, chances = [], []
    for seed in (0, 1):
        for stream in (0, 1):
            actor = SearchActor(NETWORK, SMALL, seed, stream)
            actor.act()
            seen += [level for _, level, *_ in actor.state().part("own").values["tickets"]]
            chances.append(float(actor._rng.random()))
    assert len(set(seen)) == 4 * SMALL.trees and all(x in TRAIN_SEEDS for x in seen)
    assert len(set(chances)) == 4
    for seed, stream in ((-1, 0), (0, 1000), (10**7, 0)):
        with pytest.raises(ValueError, match="stream"):
            SearchActor(NETWORK, SMALL, seed, stream)


def run(path, seed=0):
    config = ExpertIterationConfig(
        channels=8,
        blocks=1,
        search=SMALL,
        first_evaluations=1024,
        cpu_seconds=1e9,
        updates=8,
        seed=seed,
    )
    trainer = expert_iteration(config, path, Cadence(publish_updates=2, save_seconds=math.inf))
    trainer.learner.evaluate = dict
    return trainer


def test_a_run_resumes_to_the_bit(tmp_path):
    check_resuming(run, tmp_path, stop_at=4, updates=8)


def test_a_run_plays_the_levels_of_its_seed(tmp_path):
    levels = []
    for seed in (0, 5):
        trainer = run(tmp_path / str(seed), seed)
        actor = trainer.source.pool.factory(0)
        actor.act()
        levels.append({level for _, level, *_ in actor.state().part("own").values["tickets"]})
    assert not levels[0] & levels[1]


def test_a_batch_with_nan_teaches_nothing(tmp_path):
    check_refusal(run(tmp_path), lambda batch: batch._replace(state=batch.state * math.nan))
