"""What the learners of all methods have in common: a planner that is judged on whole levels, and the best one kept."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, TypeVar

from mujoban_planner.planner import LearnedPlanner
from mujoban_planner.validation import success_rates
from mujoban_rl.best import JudgedLearner, judged
from mujoban_rl.run_directory import RunDirectory

BatchT = TypeVar("BatchT")


class PlannerLearner(JudgedLearner[BatchT]):
    """A learner whose product is a planner: what solves the most held-out levels, alone, is exported."""

    chooses: bool = True
    """Whether held-out levels, which are seen whole, tell which planner is best; otherwise the newest counts."""

    @property
    @abstractmethod
    def product(self) -> LearnedPlanner:
        """The planner that the run is for, as it is now."""

    def evaluate(self) -> dict[str, float]:
        """Return the planner's solve rates, alone, on held-out levels; keep it if that makes it the best."""
        product = self.product
        with judged(product):
            rates = success_rates(product)
        if self.chooses:
            self.best.judge(product, tuple(rates.values()), rates)
        return rates

    def export(self, directory: RunDirectory, record: Mapping[str, Any]) -> None:
        """Write the best planner, or the present one where none was judged, with its record."""
        product = self.product
        self.best.save(directory.path / "planner.safetensors", product, product.config, record)
