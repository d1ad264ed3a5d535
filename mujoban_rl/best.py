"""The best product of a run so far, by its score on validation levels."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from pathlib import Path
from typing import Any, TypeVar

from torch import Tensor, nn

from mujoban_rl.engine import Learner, Scalars, State
from mujoban_rl.weights import save_weights

BatchT = TypeVar("BatchT")
ProductT = TypeVar("ProductT", bound=nn.Module)
Score = tuple[float, ...]


class Best:
    """Keeps the weights that scored best: late products differ by more than training improves them, or are worse."""

    def __init__(self) -> None:
        """Know none yet."""
        self._score: Score | None = None
        self._errors: Score = ()
        self._weights: dict[str, Tensor] = {}
        self._scalars: Scalars = {}
        self._at: int | None = None
        self._judged = 0

    def judge(self, product: nn.Module, score: Score, scalars: Scalars, errors: Score | None = None) -> None:
        """Keep a product unless an earlier one has scored more, or its score is not a number.

        Args:
            product: As it is now.
            score: What products are compared by, in this order; the newest of equal ones is kept.
            scalars: What the evaluation found.
            errors: The standard error of each entry. Entries that differ by no more than that of their difference count
                as equal: else no later product takes the place of one that by chance failed in none of a few levels.
        """
        errors = (0.0,) * len(score) if errors is None else errors
        # Nothing is more than one that is not a number: once kept, it would stay.
        if not any(map(math.isnan, score)):
            if self._score is None or not _is_less(score, self._score, errors, self._errors):
                self._scalars, self._at = scalars, self._judged
                self._weights = {k: v.detach().clone() for k, v in product.state_dict().items()}
            if self._score is None or score >= self._score:
                # Later ones are compared with the most that was ever scored, lest each be a little less than the last.
                self._score, self._errors = score, errors
        self._judged += 1

    def chosen(self, product: ProductT) -> ProductT:
        """Return a copy of a product, with the best weights where any was judged."""
        chosen = deepcopy(product)
        chosen.load_state_dict(self._weights or product.state_dict())
        return chosen

    def save(self, file: Path, product: nn.Module, config: Mapping[str, Any], record: Mapping[str, Any]) -> None:
        """Write what `chosen` returns, as `save_weights` does, with what is `told` of it in its record."""
        save_weights(file, self.chosen(product), config, {**record, **self.told})

    @property
    def told(self) -> dict[str, Any]:
        """For the record: under `validation` what was found, under `evaluation` in which evaluation, from 0."""
        return {"validation": self._scalars or None, "evaluation": self._at}

    def state(self) -> State:
        """Return all of it."""
        score = None if self._score is None else list(self._score)
        found = {
            "score": score, "errors": list(self._errors), "scalars": self._scalars, "at": self._at,
            "evaluations": self._judged,
        }  # fmt: skip
        return State(found, self._weights)

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        score = state.values["score"]
        self._score = None if score is None else tuple(score)
        # Checkpoints of earlier versions have none.
        self._errors = tuple(state.values.get("errors", (0.0,) * len(score or ())))
        self._weights, self._scalars = state.tensors, state.values["scalars"]
        self._at, self._judged = state.values["at"], state.values["evaluations"]


def _is_less(score: Score, other: Score, errors: Score, others: Score) -> bool:
    """Return whether the first entry that differs by more than chance is less than the other's."""
    for mine, its, *both in zip(score, other, errors, others, strict=True):
        if abs(mine - its) > math.hypot(*both):
            return mine < its
    return False


@contextmanager
def judged(product: nn.Module) -> Iterator[None]:
    """Have a product in evaluation mode meanwhile, as it plays where it is used."""
    training = product.training
    product.eval()
    try:
        yield
    finally:
        product.train(training)


class JudgedLearner(Learner[BatchT]):
    """A learner that exports the best product of its run: its `evaluate` has `best` judge each."""

    def __init__(self) -> None:
        """Know no best product yet."""
        self.best = Best()

    def own_state(self) -> State:
        """Return what changes beside modules, optimisers and the best product; nothing by default."""
        return State()

    def restore_own(self, state: State) -> None:
        """Take over what `own_state` returned."""

    def state(self) -> State:
        """Return what changes beside modules and optimisers."""
        return State.of({"own": self.own_state(), "best": self.best.state()})

    def restore(self, state: State) -> None:
        """Take over what `state` returned."""
        self.restore_own(state.part("own"))
        self.restore_best(state.part("best"))

    def restore_best(self, state: State) -> None:
        """Take over the best product and its score."""
        self.best.restore(state)
