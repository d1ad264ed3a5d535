"""What the learners of all stages have in common: a product that is judged on whole levels, and the best one kept."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, TypeVar

from mujoban_controller.judge import judge
from mujoban_controller.policy import GoalPolicy
from mujoban_core.stats import rate_error
from mujoban_rl.best import JudgedLearner, judged
from mujoban_rl.engine import Scalars
from mujoban_rl.run_directory import RunDirectory
from mujoban_sim.oracles import OraclePlanner
from mujoban_sim.presets import DEFAULT_WORLD
from mujoban_sokoban.generator import VALIDATION_SEEDS

BatchT = TypeVar("BatchT")
_RATES: Final = ("success_rate", "success_rate/feasible")
"""Names of what products are compared by."""


@dataclass(frozen=True)
class Validation:
    """On which levels products are compared; 0 episodes: on none, and the newest is the best."""

    episodes: int = 0
    body: str = "ball"
    difficulty: int = 5
    world: str = DEFAULT_WORLD
    threads: int = 1


class ProductLearner(JudgedLearner[BatchT]):
    """A learner whose product is a controller or a teacher.

    Late checkpoints differ by more than training improves them, so what is exported is the newest of the products that
    have solved the most validation levels, or fewer by no more than chance.
    """

    def __init__(self, validation: Validation) -> None:
        """Compare products by `validation`."""
        super().__init__()
        self._validation = validation

    @property
    @abstractmethod
    def product(self) -> GoalPolicy:
        """The network that the run is for, as it is now."""

    def evaluate(self) -> Scalars:
        """Return how many validation levels the product solves under a solver's plans; keep it if it is the best."""
        where, product = self._validation, self.product
        if not where.episodes:
            return {}
        with judged(product):
            report = judge(
                product.driver(), OraclePlanner(), episodes=where.episodes, first_seed=VALIDATION_SEEDS.start,
                body=where.body, difficulty=where.difficulty, world=where.world, batch=128, threads=where.threads,
            )  # fmt: skip
        feasible = report["instructions"]["feasible"]
        counts = ((where.episodes - len(report["lost"]), where.episodes), (feasible["completed"], feasible["n"]))
        score = tuple(succeeded / max(n, 1) for succeeded, n in counts)
        kinds = report["instructions"]["kinds"]
        medians = {f"steps/{k}": v["median_steps"] for k, v in kinds.items() if v["median_steps"] is not None}
        scalars = {**dict(zip(_RATES, score, strict=True)), "steps": report["median_steps"], **medians}
        self.best.judge(product, score, scalars, tuple(rate_error(*count) for count in counts))
        return scalars

    def export(self, directory: RunDirectory, record: Mapping[str, Any]) -> None:
        """Write the best product, or the present one where none was judged.

        The record says under `validation` what the best one solved, and under `evaluation` in which evaluation: in the
        first, 0, of a run that began with an evaluation, training has improved nothing.
        """
        product = self.product
        file = directory.path / f"{product.file_name}.safetensors"
        self.best.save(file, product, product.config, record)
