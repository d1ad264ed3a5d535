"""Settings of the joint fine-tuning."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from mujoban_controller.mpo import MPOTrainingConfig
from mujoban_core.bodies import BALL
from mujoban_core.files import digest
from mujoban_core.plugins import ROLES, shipped_weights
from mujoban_planner.discrete_mpo import MPOSettings


@dataclass(frozen=True)
class StartingWeights:
    """Where the modules come from; by default what ships."""

    controller: Path | None = None
    planner: Path | None = None
    estimator: Path | None = None
    """Stays as it is."""
    termination: Path | None = None
    """Stays as it is."""

    def digests(self) -> dict[str, str]:
        """Return the digest of the weights of each module, for the record."""
        return {role: digest(getattr(self, role) or shipped_weights(role)) for role in ROLES}


@dataclass(frozen=True)
class PlannerSettings:
    """MPO over the instructions that were given, in the states that were estimated."""

    batch: int = 64
    """Decisions of an update."""
    replay: int = 10_000
    """Decisions that are kept."""
    n_step: int = 3
    """Decisions of a return."""
    discount: float = 0.99
    """Of an instruction."""
    rate: float = 3e-5
    critic_first: int = 400
    """Updates in which its critic learns alone."""

    def __post_init__(self) -> None:
        """Reject what holds no decision."""
        for name in ("batch", "replay", "n_step"):
            if getattr(self, name) < 1:
                raise ValueError(f"planner: {name} {getattr(self, name)}: expected at least 1")

    @property
    def mpo(self) -> MPOSettings:
        """What the planner's learner reads of it."""
        return MPOSettings(learning_rate=self.rate, critic_first=self.critic_first)


@dataclass(frozen=True)
class JointSettings:
    """How the stack plays, and how planner and controller learn from it."""

    look_around: int = BALL.look_ticks
    """Ticks of a turn on the spot while the map is uncertain, 0 for none; in such turns nobody learns to drive."""
    controller: MPOTrainingConfig = field(
        default_factory=lambda: MPOTrainingConfig(
            window=16, windows=16, sequence=16, replay=24_000, first=8_000, reuse=1.0, gamma=0.99, critic_first=400,
            explore=0.1, policy_rate=3e-5,
        )
    )
    """MPO over torques, with a critic that sees the truth."""
    planner: PlannerSettings = field(default_factory=PlannerSettings)

    def __post_init__(self) -> None:
        """Reject contradictions."""
        if self.look_around < 0:
            raise ValueError(f"look_around {self.look_around}: expected a number of ticks, 0 for none")
        if self.controller.sequence != self.controller.window:
            raise ValueError(
                f"controller: sequence {self.controller.sequence}: expected the window's {self.controller.window} ticks"
            )
