"""Random instructions and imperfect termination signals."""

from __future__ import annotations

import numpy as np

from mujoban_controller.instructions import (
    EXACT,
    InstructionConfig,
    TerminationConfig,
    TerminationNoise,
    random_instruction,
)
from mujoban_core.grid import Instruction
from mujoban_sim.goals import GoalKind

KINDS = np.array([GoalKind.HOLD, GoalKind.MOVE, GoalKind.PUSH, GoalKind.HOLD, GoalKind.MOVE])
FAR = np.full(1, np.inf)


def draw(config, kinds=KINDS, previous=0, n=4000):
    rng = np.random.default_rng(0)
    return np.array([random_instruction(kinds, previous, config, rng) for _ in range(n)])


def test_kinds_come_in_their_shares():
    drawn = draw(InstructionConfig(stay=0.1, infeasible=0.1, push=0.5, repeat=0.0))
    share = {i: float((drawn == i).mean()) for i in Instruction}
    assert abs(share[Instruction.STAY] - 0.1) < 0.02
    assert abs(share[Instruction.SOUTH] - 0.1) < 0.02
    assert abs(share[Instruction.EAST] - 0.4) < 0.03


def test_pushes_go_on_in_the_same_direction():
    drawn = draw(InstructionConfig(stay=0.0, infeasible=0.0, push=0.0, repeat=0.8), previous=Instruction.EAST)
    assert abs(float((drawn == Instruction.EAST).mean()) - 0.8) < 0.03


def test_a_walled_in_robot_is_told_to_stay():
    assert set(draw(InstructionConfig(), kinds=np.full(5, GoalKind.HOLD), n=50)) == {Instruction.STAY}


def ticks_until_signal(config, completed_from, distance=FAR, limit=200):
    noise = TerminationNoise(1, config, np.random.default_rng(0))
    noise.issue(np.array([0]))
    for tick in range(1, limit):
        if noise.step(np.array([tick >= completed_from]), distance)[0]:
            return tick
    return None


def test_exact_signals_follow_the_rule_and_the_limit():
    assert ticks_until_signal(EXACT, completed_from=17) == 17
    assert ticks_until_signal(EXACT, completed_from=500) == EXACT.limit


def test_late_signals_come_after_completion_and_early_ones_near_the_goal():
    assert ticks_until_signal(TerminationConfig(late=1.0, early=0.0, delay=6.0), completed_from=17) > 17
    early = TerminationConfig(late=0.0, early=1.0, reach=0.3)
    assert ticks_until_signal(early, completed_from=500, distance=np.zeros(1)) == 1
    assert ticks_until_signal(early, completed_from=30, distance=np.full(1, 0.5)) == 30
