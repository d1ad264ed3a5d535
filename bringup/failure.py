"""Keep what an episode's decisions rested on, and tell why an episode failed."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bringup.results import EpisodeResult, Failure
from mujoban_core.grid import AGENT, BOX, OFFSETS_RC, TARGET, WALL, Instruction
from mujoban_sokoban.levels import walls_around
from mujoban_sokoban.rules import abstract_successor
from mujoban_sokoban.solver import Status, solve

PROOF_NODES = 50_000
"""Search nodes that a proof of unsolvability may take; beyond them a state counts as solvable."""
TAIL = 24
"""Last decisions of an episode which tell what it was stuck on."""
LOOP_VISITS = 4
"""Times the same situation recurs in the tail when the planner runs in a loop."""


class DecisionRecord(NamedTuple):
    """What is kept of one decision of the planner."""

    truth: NDArray[np.bool_]
    """True abstract state at that tick, [N, N, 4]."""
    instruction: int
    estimate_right: bool
    timed_out: bool
    """Whether the instruction before this one ran into its time limit."""


class EpisodeLog:
    """The decisions of one episode."""

    def __init__(self, seed: int) -> None:
        """Begin the log of the episode with the given seed."""
        self.seed = seed
        self._decisions: list[DecisionRecord] = []
        self._region: NDArray[np.bool_] | None = None

    def decided(
        self, truth: NDArray[np.float32], estimate: NDArray[np.float32], instruction: int, timed_out: bool
    ) -> None:
        """Note an instruction that was issued on an estimate, [N, N, 4] each."""
        state = truth > 0.5
        if self._region is None:
            self._region = playable_region(state)
        right = estimate_is_right(state, estimate, self._region)
        self._decisions.append(DecisionRecord(state, int(instruction), right, bool(timed_out)))

    def result(
        self, *, solved: bool, steps: int, episode_return: float, last: NDArray[np.float32]
    ) -> EpisodeResult:
        """Return the outcome of the episode, which has ended in the true abstract state `last`, [N, N, 4]."""
        return EpisodeResult(
            seed=self.seed,
            solved=bool(solved),
            episode_return=float(episode_return),
            steps=int(steps),
            instructions=len(self._decisions),
            time_outs=sum(d.timed_out for d in self._decisions),
            wrong_estimates=sum(not d.estimate_right for d in self._decisions),
            failure=None if solved else explain(self._decisions, last > 0.5),
        )


def playable_region(state: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the cells that the robot could reach if boxes were no obstacle, [N, N], from [N, N, 4]."""
    floor = np.pad(~state[..., WALL], 1)
    region = np.pad(state[..., AGENT], 1) & floor
    while True:
        grown = region.copy()
        for row, column in OFFSETS_RC[1:]:
            grown |= np.roll(region, (row, column), (0, 1))
        grown &= floor
        if (grown == region).all():
            return region[1:-1, 1:-1]
        region = grown


def estimate_is_right(
    truth: NDArray[np.bool_], estimate: NDArray[np.float32], region: NDArray[np.bool_]
) -> bool:
    """Tell whether an estimate says of the playable region and the walls around it what is true.

    Args:
        truth: Abstract state, [N, N, 4].
        estimate: Probabilities, [N, N, 4]; the agent counts by its likeliest cell.
        region: `playable_region` of the level, [N, N].
    """
    if np.argmax(estimate[..., AGENT]) != np.argmax(truth[..., AGENT]):
        return False
    padded = np.pad(region, 1)
    border = np.zeros_like(padded)
    for row, column in OFFSETS_RC:
        border |= np.roll(padded, (row, column), (0, 1))
    said = estimate > 0.5
    if (said[..., WALL] != truth[..., WALL])[border[1:-1, 1:-1]].any():
        return False
    return not (said[..., [TARGET, BOX]] != truth[..., [TARGET, BOX]])[region].any()


def is_unsolvable(state: NDArray[np.bool_]) -> bool:
    """Tell whether the rules prove that an abstract state, [N, N, 4], can no longer be solved.

    States that the rules do not know, such as two boxes that round into one cell, a box in the cell that the robot has
    half left, or no wall around, are not proven.
    """
    boxes = np.argwhere(state[..., BOX])
    player = np.argwhere(state[..., AGENT])
    regular = len(boxes) == state[..., TARGET].sum() and len(player) == 1
    wall = state[..., WALL]
    if not regular or not walls_around(wall) or (state[..., [WALL, BOX, AGENT]].sum(-1) > 1).any():
        return False
    row, column = player[0]
    solution = solve(
        wall, state[..., TARGET], boxes, (int(row), int(column)), max_nodes=PROOF_NODES
    )
    return solution.status == Status.UNSOLVABLE


def explain(decisions: list[DecisionRecord], last: NDArray[np.bool_]) -> Failure:
    """Tell why an episode with the given decisions failed, which ended in the state `last`, [N, N, 4].

    A level that was lost is put down to the decision that lost it, the first after which the rules prove
    that no solution is left; otherwise the last decisions tell what the episode was stuck on. An agent without
    modules decides nothing that could be looked at: only whether it lost the level can be told.
    """
    if not decisions:
        return Failure.LEVEL_LOST if is_unsolvable(last) else Failure.TIME_LIMIT
    if is_unsolvable(last) and not is_unsolvable(decisions[0].truth):
        return _explain_loss(decisions, last)
    tail = decisions[-TAIL:]
    # What was possible and not carried out, nobody's estimate is to blame for.
    vain = (after.timed_out and _is_possible(before) for before, after in pairwise(tail))
    if 3 * sum(vain) >= len(tail):
        return Failure.CONTROLLER_TIME_OUT
    if 2 * sum(not d.estimate_right for d in tail) >= len(tail):
        return Failure.WRONG_ESTIMATE
    if 3 * sum(d.timed_out for d in tail) >= len(tail):
        return Failure.CONTROLLER_TIME_OUT
    visits = [d.truth[..., [AGENT, BOX]].tobytes() for d in tail]
    if max(map(visits.count, visits)) >= LOOP_VISITS:
        return Failure.PLANNER_DEAD_END
    return Failure.TIME_LIMIT


def _is_possible(decision: DecisionRecord) -> bool:
    """Tell whether the robot can do what it was told to: stay, or go where neither wall nor box is in the way.

    A state that the rules do not know, without a robot or with two, says nothing.
    """
    if decision.instruction == Instruction.STAY:
        return True
    agent = decision.truth[..., AGENT]
    if agent.sum() != 1:
        return False
    return bool((abstract_successor(decision.truth, decision.instruction)[..., AGENT] != agent).any())


def _explain_loss(decisions: list[DecisionRecord], last: NDArray[np.bool_]) -> Failure:
    states = [*(decision.truth for decision in decisions), last]
    solvable, lost = 0, len(decisions)
    while lost - solvable > 1:
        middle = (solvable + lost) // 2
        if is_unsolvable(states[middle]):
            lost = middle
        else:
            solvable = middle
    fatal = decisions[solvable]
    if not fatal.estimate_right:
        return Failure.WRONG_ESTIMATE
    if is_unsolvable(abstract_successor(fatal.truth, fatal.instruction)):
        return Failure.PLANNER_DEAD_END
    timed_out = lost < len(decisions) and decisions[lost].timed_out
    return Failure.CONTROLLER_TIME_OUT if timed_out else Failure.MISEXECUTION
