"""Lessons from recorded bags: what the planner decided on, and what the solver would have done there.

The planner of a running stack sees estimates. A bag holds them beside the truth, so the solver labels the truth and the
network learns to say the same given the estimate: DAgger (Ross et al. 2011) through bags, without a simulator.

Shapes: S samples, B batch, N = `grid.GRID_SIZE`.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mujoban_core.grid import Instruction
from mujoban_msgs_py import topics
from mujoban_msgs_py.bags import BagError
from mujoban_msgs_py.bags.training import EpisodeTick, episode_ticks, find_bags, open_training_bag
from mujoban_planner.boards import BitBoards, level_batch, likeliest_boards
from mujoban_planner.samples import Batch, Samples, make_batch
from mujoban_planner.symmetry import SYMMETRIES, view_states
from mujoban_planner.teacher import Teacher
from mujoban_rl.engine import Source, State

DECISION_TOPICS: Final = (
    topics.TRUE_EPISODE, topics.TRUE_ABSTRACT_STATE, topics.ABSTRACT_STATE, topics.INSTRUCTION,
)  # fmt: skip
"""What a decision is read from."""


class Decision(NamedTuple):
    """What an instruction was decided on."""

    truth: NDArray[np.float32]
    """Abstract state as it was, [N, N, 4]."""
    estimate: NDArray[np.float32]
    """As the estimator gave it, [N, N, 4]."""
    instruction: Instruction
    """What was decided."""


def decisions(ticks: Iterable[EpisodeTick]) -> Iterator[Decision]:
    """Yield what each instruction of an episode was decided on.

    Args:
        ticks: With values (episode, true abstract state, estimate, instruction), as `episode_ticks` yields them.
    """
    for (_, (_, truth, estimate, instruction)), issued in with_issues(ticks):
        if issued:
            yield Decision(truth, estimate, Instruction(instruction.direction))


def with_issues(ticks: Iterable[EpisodeTick]) -> Iterator[tuple[EpisodeTick, bool]]:
    """Yield each tick, and whether an instruction was issued in it.

    Args:
        ticks: With values of `DECISION_TOPICS`, and perhaps of others after them.
    """
    place, sequence = DECISION_TOPICS.index(topics.INSTRUCTION), 0
    for tick in ticks:
        before, sequence = 0 if tick.episode.step == 0 else sequence, tick.values[place].sequence
        yield tick, sequence != before


class Lessons(NamedTuple):
    """Labelled decisions."""

    samples: Samples
    estimates: NDArray[np.float16]
    """Abstract states as they were estimated, [S, N, N, 4]."""
    estimated: NDArray[np.bool_]
    """Whether there is an estimate, [S]; the others are states that a wrong push would have led to."""

    @classmethod
    def read(cls, bags: Sequence[Path], seed: int, *, stays: bool = True) -> Lessons:
        """Read and label the decisions of bags, or of folders of bags.

        Args:
            bags: What is read.
            seed: Of the solver's choice among ways that are equally short.
            stays: Take those to stay as well; most of these are ticks of a look, in which no planner chose anything.

        Raises:
            BagError: If a bag is damaged, lacks a topic or holds a level that is not for training, or none holds a
                decision that the solver can label.
        """
        opened = [open_training_bag(bag, DECISION_TOPICS) for bag in find_bags(bags)]
        made = (decision for bag in opened for decision in decisions(episode_ticks(bag, DECISION_TOPICS)))
        found = [decision for decision in made if stays or decision.instruction != Instruction.STAY]
        if not found:
            raise BagError(f"{', '.join(map(str, bags))}: no instruction, expected bags of played episodes")
        boards = likeliest_boards(np.stack([decision.truth for decision in found]))
        samples = Teacher().demonstrate(level_batch(boards), np.random.default_rng(seed), keep=1)
        if not len(samples.agent):
            raise BagError(f"{', '.join(map(str, bags))}: the solver finds no way from any of {len(found)} decisions")
        origin = _origins(samples.boards, boards)
        estimates = np.stack([decision.estimate for decision in found]).astype(np.float16)
        return cls(samples, estimates[np.maximum(origin, 0)], origin >= 0)


def _origins(samples: BitBoards, decided: BitBoards) -> NDArray[np.int64]:
    """Return the decision that each sample labels, [S]; -1 where it labels none. Equal states take turns."""
    places: dict[tuple[int, ...], list[int]] = defaultdict(list)
    for i, key in reversed(list(enumerate(zip(*(column.tolist() for column in decided), strict=True)))):
        places[key].append(i)
    keys = zip(*(column.tolist() for column in samples), strict=True)
    return np.array([places[key].pop() if places.get(key) else -1 for key in keys], np.int64)


class BagLessons(Source[Batch]):
    """Batches of decisions from bags under random symmetries, most as they were estimated."""

    def __init__(self, lessons: Lessons, batch_size: int, estimated: float, seed: int) -> None:
        """Draw lessons.

        Args:
            lessons: What is drawn from.
            batch_size: B.
            estimated: Share of the decisions that are shown as they were estimated, the others as they were.
            seed: Of what is drawn.
        """
        self.lessons = lessons
        self._batch_size, self._estimated = batch_size, estimated
        self._rng = np.random.default_rng([seed, 1])

    def next_batch(self) -> Batch:
        """Return B samples."""
        n, rng, lessons = self._batch_size, self._rng, self.lessons
        rows, symmetry = rng.integers(0, len(lessons.estimated), n), rng.integers(0, SYMMETRIES, n)
        batch = make_batch(lessons.samples.take(rows), symmetry)
        shown = torch.from_numpy(lessons.estimated[rows] & (rng.random(n) < self._estimated))
        estimates = torch.from_numpy(lessons.estimates[rows].astype(np.float32))
        views = view_states(estimates, torch.from_numpy(symmetry)[:, None])
        self.samples += n
        return batch._replace(state=torch.where(shown[:, None, None, None], views, batch.state))

    def statistics(self) -> dict[str, float]:
        """Return how many lessons there are."""
        return {"bag_lessons": float(len(self.lessons.estimated))}

    def state(self) -> State:
        """Return what draws; the bags are read again."""
        return State({"rng": self._rng.bit_generator.state})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        self._rng.bit_generator.state = state.values["rng"]


class LessonsAndBags(Source[Batch]):
    """Batches that hold lessons of another source and decisions from bags."""

    def __init__(self, lessons: Source[Batch], bags: BagLessons) -> None:
        """Join the batches of both."""
        self._lessons, self._bags = lessons, bags

    def publish(self, weights: Mapping[str, Tensor], version: int) -> None:
        """Correct the play of a planner with these weights from now on."""
        self._lessons.publish(weights, version)

    def next_batch(self) -> Batch | None:
        """Return the samples of both."""
        lessons, recorded = self._lessons.next_batch(), self._bags.next_batch()
        if lessons is None:
            return None
        self.samples += len(lessons.state) + len(recorded.state)
        return Batch._make(torch.cat(columns) for columns in zip(lessons, recorded, strict=True))

    def statistics(self) -> dict[str, float]:
        """Return how many lessons there were."""
        return {**self._lessons.statistics(), **self._bags.statistics()}

    def state(self) -> State:
        """Return the states of both."""
        counts = State({"lessons": self._lessons.samples, "bags": self._bags.samples})
        return State.of({"counts": counts, "lessons": self._lessons.state(), "bags": self._bags.state()})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        counts = state.part("counts").values
        self._lessons.samples, self._bags.samples = counts["lessons"], counts["bags"]
        self._lessons.restore(state.part("lessons"))
        self._bags.restore(state.part("bags"))

    def go_on(self, state: State) -> None:
        """Have lessons made of other levels than so far."""
        self._lessons.go_on(state.part("lessons"))

    def worker_cpu_seconds(self) -> float:
        """Return the CPU time of those who make lessons."""
        return self._lessons.worker_cpu_seconds()

    def close(self) -> None:
        """End those who make lessons."""
        self._lessons.close()
