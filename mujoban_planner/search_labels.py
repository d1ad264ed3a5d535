"""What searches found and proved, as labelled states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from mujoban_planner.boards import BitBoards, level_batch
from mujoban_planner.forest import Forest, Verdicts
from mujoban_planner.own_play import Pushed
from mujoban_planner.samples import Samples, concatenate, unlabelled
from mujoban_planner.teacher import DEAD_SHARE, judge_instructions, label_dead, label_demonstrations
from mujoban_sokoban.solver import label_solutions


def label_ways(forest: Forest, verdicts: Mapping[int, Verdicts], rng: np.random.Generator) -> Samples:
    """Return every state on the ways that searches found as a sample.

    Args:
        forest: The searches.
        verdicts: What was proved in each tree, by its number; all of them found a way of one push at least.
        rng: Chooses among equally short walks.
    """
    starts = [forest.boards(row, np.zeros(1, np.int64)) for row in verdicts]
    levels = level_batch(BitBoards._make(np.concatenate(columns) for columns in zip(*starts, strict=True)))
    found = label_solutions(levels, [forest.solution(row) for row in verdicts], rng=rng)
    samples, upcoming = label_demonstrations(levels, found)
    nodes = [np.searchsorted(proved.node, forest.way(row)) for row, proved in verdicts.items()]
    pushes = np.unique(upcoming)  # one for each node of the ways, in their order
    for column, name in ((samples.push_known, "known"), (samples.push_dead, "dead")):
        column[pushes] |= np.concatenate(
            [getattr(proved, name)[at] for proved, at in zip(verdicts.values(), nodes, strict=True)]
        )
        column[:] = column[upcoming]  # until the next push the boxes stay where they are, and so do the verdicts
    return judge_instructions(samples)


def label_verdicts(
    forest: Forest, row: int, verdicts: Verdicts, most: int, rng: np.random.Generator
) -> Samples:
    """Return at most `most` states off the way of a tree whose pushes were judged, and a few of its dead states."""
    off_way = ~np.isin(verdicts.node, forest.way(row))
    chosen = np.flatnonzero(verdicts.searched & off_way & ~verdicts.lost)
    chosen = rng.permutation(chosen)[:most]
    judged = unlabelled(forest.boards(row, verdicts.node[chosen]))
    judged = judged._replace(push_known=verdicts.known[chosen], push_dead=verdicts.dead[chosen])
    lost = np.flatnonzero(verdicts.lost & (rng.random(len(verdicts.node)) < DEAD_SHARE))
    return concatenate([judged, label_dead(forest.boards(row, verdicts.node[lost]))])


def label_pushes(forest: Forest, row: int, pushes: Sequence[Pushed], *, dead: bool) -> Samples:
    """Return the states before pushes in a tree's level as samples that say that these are deadly, or that none is."""
    n = len(pushes)
    box, agent = np.array([x for x, _, _ in pushes], np.uint64), np.array([x for _, x, _ in pushes], np.uint8)
    wall, target = (np.full(n, column[row]) for column in (forest.trees.wall, forest.trees.target))
    samples = unlabelled(BitBoards(wall, target, box, agent))
    push = np.array([x for _, _, x in pushes], np.int64)
    samples.push_known[np.arange(n), push % 4] = np.uint64(1) << (push // 4).astype(np.uint64)
    if dead:
        samples.push_dead[:] = samples.push_known
    return samples
