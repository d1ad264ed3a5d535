"""What `make weights` is asked for, and where in a run's directory what it makes stands."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Final, Literal

import tyro

from bringup.finished_run import body_of, seed_of
from bringup.options import Count, WorldOptions, whole
from bringup.training_sizes import Machine
from mujoban_core.bodies import get_body
from mujoban_planner.seed_streams import LAST_SEED

WEIGHTS: Final = {
    "controller": "controller_mpo/controller.safetensors",
    "planner": "planner/planner.safetensors",
    "estimator": "estimator_second/weights/estimator.safetensors",
    "termination": "estimator_second/weights/termination.safetensors",
}
"""Where in the run's directory the weights of each module stand."""
PRODUCTS: Final = {
    **WEIGHTS,
    "teacher": "teacher/teacher.safetensors",
    "critic": "teacher/critic.safetensors",
    "student": "controller_distil/controller.safetensors",
    "first": "bags_first",
    "second": "bags_second",
}
"""And all that another stage needs: the teacher, its student, the bags."""
BAGS: Final = ("first", "second")


@dataclass(frozen=True)
class Options:
    """Train all four modules from nothing."""

    run: Path = Path("runs/all")
    """Directory of everything; an existing one is resumed."""
    hours: float = 8.0
    """Time that the whole run may take on two cores; the budgets of all stages scale with it."""
    before: Annotated[Path | None, tyro.conf.arg(name="continue")] = None
    """Directory of a finished run: every module goes on from its weights, and learns also from its bags, if they are
    still there."""
    keep: tuple[Literal["controller", "planner", "senses"], ...] = ()
    """Modules that stay what they are there; bags are recorded for the senses alone."""
    physics: Annotated[WorldOptions, tyro.conf.arg(name="")] = field(default_factory=WorldOptions)
    seed: Annotated[int | None, whole("N", 0)] = None
    """Decides levels and weights; by default 0, or one more than that of the run that is gone on from."""
    cores: Count = 2
    device: str = "cpu"
    """Device on which networks learn. A GPU has larger batches, a larger planner, and its time by the clock."""
    evaluation_episodes: Count = 128
    """Validation levels that each table of the report counts."""

    def __post_init__(self) -> None:
        """Reject times in which nothing can be learned, seeds past those for training, and unfit runs to go on from."""
        if not 0 < self.hours < math.inf:
            raise ValueError(f"--hours {self.hours}: expected a positive number")
        if not 0 <= self.stream <= LAST_SEED:
            raise ValueError(f"--seed {self.stream}: expected a whole number from 0 to {LAST_SEED}")
        if self.keep and self.before is None:
            raise ValueError(f"--keep {' '.join(self.keep)}: expected --continue, which says whose are kept")
        body = None if self.before is None else body_of(self.before)
        if body not in (None, self.physics.body):
            told = f"--body {self.physics.body}: --continue {self.before}"
            raise ValueError(f"{told} is a run of the {body}, expected it")
        spared = BAGS if self.has_critic else (*BAGS, "critic")
        needed = (path for name, path in PRODUCTS.items() if name not in spared)
        missing = [] if self.before is None else [path for path in needed if not (self.before / path).exists()]
        if missing:
            raise ValueError(f"--continue {self.before}: lacks {missing[0]}, expected the directory of a finished run")
        if self.before is not None and self.seed is not None and self.seed == seed_of(self.before):
            raise ValueError(f"--seed {self.stream}: the levels of {self.before} again, expected another seed")

    @cached_property
    def stream(self) -> int:
        """The seed of all stages."""
        if self.seed is not None:
            return self.seed
        return 0 if self.before is None else seed_of(self.before) + 1

    @property
    def has_critic(self) -> bool:
        """Whether the teacher leaves a critic beside it: whether it learns by MPO."""
        return get_body(self.physics.body).turn is not None

    @property
    def machine(self) -> Machine:
        """What trains."""
        return Machine(self.cores, self.device)
