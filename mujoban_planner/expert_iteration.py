"""Expert iteration: the configuration, and a run of it.

Searches run in actors (`search_lessons`); who learns from them is the learner of imitation.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Final

from mujoban_core.ranges import check_counts, check_positive, check_shares
from mujoban_planner.growth import open_run
from mujoban_planner.imitation import ImitationLearner, LearnerConfig, check_init_share
from mujoban_planner.lesson_store import LessonStore
from mujoban_planner.samples import Batch
from mujoban_planner.search_lessons import SearchActor, SearchConfig
from mujoban_planner.seed_streams import LEVELS, check_seed
from mujoban_rl.actors import ActorOptions, ActorSource
from mujoban_rl.engine import Budget, Cadence, Trainer
from mujoban_rl.weights import lineage, origin, provenance

_DATA: Final = "ways and verdicts of the planner's own search on generated levels, training seeds, without a solver"


@dataclass(frozen=True)
class ExpertIterationConfig(LearnerConfig):
    """What defines a run of expert iteration."""

    channels: int = 48
    """Channels of the network."""
    blocks: int = 6
    """Residual blocks (residual)."""
    search: SearchConfig = field(default_factory=SearchConfig)
    evaluations: float = 2.0
    """Network evaluations of searches per sample that is learned from."""
    first_evaluations: int = 8192
    """Those before the first update."""
    learning_rate: float = 1.5e-3
    """Learning rate."""
    warm_up: float = 0.01
    """Share of the budget in which the learning rate rises."""
    plan_weight: float = 1.0
    """Weight of the plan map in the loss."""
    cpu_seconds: float = 10_800.0
    """CPU seconds after which the run is complete; the learning rate falls until then. Two cores have so many in 90
    minutes."""
    horizon_seconds: float = 1e9
    """Wall-clock seconds after which it is complete, whichever comes first: the measure where a GPU computes."""
    updates: float = 1e9
    """Updates after which it is complete."""

    def __post_init__(self) -> None:
        """Reject numbers with which nothing is learned, seeds that there are not, no shares, and budgets of nothing."""
        super().__post_init__()
        check_seed(self.seed, LEVELS)
        check_counts(self, "first_evaluations")
        check_positive(self, "evaluations", "learning_rate", "horizon_seconds")
        check_shares(self, "warm_up")
        _ = self.budget

    @property
    def budget(self) -> Budget:
        """When the run is complete."""
        return Budget(cpu_seconds=self.cpu_seconds, seconds=self.horizon_seconds, updates=self.updates)


def expert_iteration(
    config: ExpertIterationConfig, directory: Path, cadence: Cadence | None = None,
    actors: ActorOptions | None = None, *, device: str = "cpu",
) -> Trainer[Batch]:  # fmt: skip
    """Open or resume a run.

    Args:
        config: What to train; fixed for the run.
        directory: Run directory.
        cadence: How often it evaluates and saves.
        actors: Where searches run.
        device: Device of the networks, of the learner and of those who search.

    Raises:
        RunError: If the directory belongs to another run.
        WeightsError: If the weights to start from are missing or damaged, or do not fit into the network.
        ValueError: If weights are to have a share that there are none of.
    """
    check_init_share(config)
    searcher = partial(SearchActor, config.network, config.search, config.seed, device=device)
    source = ActorSource(
        (actors or ActorOptions()).pool(searcher),
        LessonStore(config.search, config.seed),
        steps_per_update=config.evaluations * config.search.batch_size,
        first_steps=config.first_evaluations,
    )
    record = {
        **provenance(),
        "method": "expert-iteration",
        "training": asdict(config),
        "init": origin(config.init),
        "data": lineage(_DATA, config.init),
    }
    run, learner = open_run(directory, config), ImitationLearner(config, config.search, device)
    return Trainer(run, learner, source, config.budget, cadence, record=record)
