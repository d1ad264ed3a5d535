from types import SimpleNamespace

import numpy as np
import pytest
import torch

from mujoban_planner.boards import bit_boards
from mujoban_planner.imitation import _verdict_loss
from mujoban_planner.networks import ResidualPlanner
from mujoban_planner.own_play import AuditQueue, Lead, Phase, draw_doubtful
from mujoban_planner.teacher import reachable_pushes
from mujoban_sokoban.generator import TRAIN_SEEDS, generate_batch


@pytest.mark.parametrize("fatal", range(7))
def test_the_push_that_lost_a_level_is_found_by_few_searches(fatal):
    lead = Lead(Phase.LOST, way=[(i, 0, i) for i in range(7)], lost=7, proved=True)
    searches = 0
    while (root := lead.middle) is not None:
        lead.root, searches = root, searches + 1
        lead.learn(solved=root <= fatal, lost=root > fatal)
    assert lead.found and lead.alive == fatal and searches <= 3


@pytest.mark.parametrize("fatal", range(7))
@pytest.mark.parametrize("doubtful", range(1, 7))
def test_where_a_search_comes_to_nothing_others_beside_it_find_the_push_that_lost(fatal, doubtful):
    lead, searched = Lead(Phase.LOST, way=[(i, 0, i) for i in range(7)], lost=7, proved=True), []
    while (root := lead.middle) is not None:
        lead.root = root
        searched.append(root)
        told = root != doubtful
        lead.learn(solved=told and root <= fatal, lost=told and root > fatal)
    assert len(searched) == len(set(searched)) <= 5
    assert lead.found == (doubtful not in (fatal, fatal + 1)), "unless that is a state beside it"
    assert not lead.found or lead.alive == fatal


def test_where_searches_come_to_nothing_no_push_is_blamed():
    lead, searches = Lead(Phase.LOST, way=[(i, 0, i) for i in range(20)], lost=20, proved=True), 0
    while (root := lead.middle) is not None:
        lead.root, searches = root, searches + 1
        lead.learn(solved=False, lost=False)
    assert searches == 4 and not lead.found


def test_play_that_was_cut_off_blames_no_push_while_all_of_it_leaves_a_solution():
    lead = Lead(Phase.LOST, way=[(i, 0, i) for i in range(8)], lost=8, proved=False)
    while (root := lead.middle) is not None:
        lead.root = root
        lead.learn(solved=True, lost=False)
    assert lead.alive == 7 and not lead.found


def test_audits_ask_about_pushes_that_are_possible_and_doubted():
    torch.manual_seed(0)
    planner = ResidualPlanner(8, 1, judge=True).eval()
    boards = bit_boards(generate_batch(5, range(TRAIN_SEEDS.start, TRAIN_SEEDS.start + 64)))
    pushes = draw_doubtful(planner, boards, np.random.default_rng(0))
    possible = reachable_pushes(boards)[np.arange(64), pushes % 4] >> (pushes // 4).astype(np.uint64) & 1
    assert len(set(pushes.tolist())) > 20 and possible.all()
    with torch.no_grad():
        planner.heads.push_dead[-1].bias.fill_(20.0)  # no doubt: all are deadly
    assert (draw_doubtful(planner, boards, np.random.default_rng(0)) == -1).all()


def test_states_wait_for_an_audit_until_they_are_taken():
    queue, again = AuditQueue(), AuditQueue()
    for i in range(3):
        queue.add(2**63, 2, [(i, i, i)], 1.0, np.random.default_rng(0))
    again.restore(queue.values)
    for waiting in (queue, again):
        assert waiting.take(2).box.tolist() == [2, 1]
        last = waiting.take(2)
        assert last.wall.tolist() == [2**63] and last.agent.dtype == np.uint8 and last.box.tolist() == [0]
        assert [len(column) for column in waiting.take(2)] == [0, 0, 0, 0]


def test_verdicts_follow_audits_and_not_those_that_were_chosen_by_what_they_are():
    logit = torch.zeros(4, 4, 8, 8, requires_grad=True)
    known = torch.zeros(4, 4, 8, 8, dtype=torch.bool)
    known[:, 0, 0, 0] = True
    dead = known & torch.tensor([True, False, False, False])[:, None, None, None]
    batch = SimpleNamespace(push_known=known, push_dead=dead, chosen=torch.tensor([False, False, True, True]))
    shares = []
    for chosen in (batch.chosen, torch.ones(4, dtype=torch.bool)):
        batch.chosen = chosen
        (gradient,) = torch.autograd.grad(_verdict_loss(logit, batch), logit)
        shares.append(gradient[:, 0, 0, 0].tolist())
    assert shares[0] == pytest.approx([-0.25, 0.25, 0.025, 0.025]), "little, while there are audits"
    assert shares[1] == pytest.approx([-0.125, 0.125, 0.125, 0.125])
