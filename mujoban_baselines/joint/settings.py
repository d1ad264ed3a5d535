"""Settings of the joint fine-tuning."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from mujoban_controller.mpo import MPOTrainingConfig
from mujoban_core.bodies import Body
from mujoban_core.files import digest
from mujoban_core.plugins import ROLES, shipped_weights
from mujoban_core.ranges import check_counts, check_not_negative, check_positive, check_shares
from mujoban_planner.discrete_mpo import MPOSettings
from mujoban_planner.teacher import DISCOUNT
from mujoban_rl.losses.mpo_continuous import MPOConfig
from mujoban_rl.losses.mpo_discrete import DiscreteMPOConfig


@dataclass(frozen=True)
class StartingWeights:
    """Where the modules come from; by default what ships for the body."""

    controller: Path | None = None
    """Learns on."""
    planner: Path | None = None
    """Its head learns on."""
    estimator: Path | None = None
    """Stays as it is."""
    termination: Path | None = None
    """Stays as it is."""

    def path(self, role: str, body: str) -> Path:
        """Return where the weights of a module are: those given, or those that ship for a body."""
        return getattr(self, role) or shipped_weights(role, body)

    def digests(self, body: str) -> dict[str, str]:
        """Return the digest of the weights of each module, for the record."""
        return {role: digest(self.path(role, body)) for role in ROLES}


@dataclass(frozen=True)
class PlannerSettings:
    """MPO over the instructions that were given, in the states that were estimated."""

    batch: int = 64
    """Decisions of an update."""
    replay: int = 10_000
    """Decisions that are kept."""
    n_step: int = 3
    """Decisions of a return."""
    discount: float = DISCOUNT
    """Of an instruction; by default that of the planner whose head goes on learning."""
    rate: float = 3e-5
    """Learning rate."""
    critic_first: int = 400
    """Updates in which its critic learns alone."""
    anchor: float = 1.0
    """How much it counts that its verdicts on what is deadly go on saying what they said; 0 lets them drift."""

    def __post_init__(self) -> None:
        """Reject what holds no decision, and an anchor that pushes away."""
        check_not_negative(self, "anchor")
        check_positive(self, "rate")
        check_shares(self, "discount")
        check_counts(self, "critic_first", least=0)
        for name in ("batch", "replay", "n_step"):
            if getattr(self, name) < 1:
                raise ValueError(f"planner: {name} {getattr(self, name)}: expected at least 1")

    @property
    def mpo(self) -> MPOSettings:
        """What the planner's learner reads of it."""
        # From where others begin, temperature and multiplier take thousands of updates to come down.
        duals = DiscreteMPOConfig(initial_temperature=0.3, initial_alpha=1.0)
        return MPOSettings(learning_rate=self.rate, mpo=duals)


@dataclass(frozen=True)
class JointSettings:
    """How the stack plays, and how planner and controller learn from it."""

    look_around: int | None = None
    """Ticks of a turn on the spot while the map is uncertain, 0 for none, None for the body's; in such turns nobody
    learns to drive."""
    controller: MPOTrainingConfig = field(
        default_factory=lambda: MPOTrainingConfig(
            window=16, windows=16, sequence=16, replay=24_000, first=8_000, reuse=1.0, gamma=0.99, critic_first=1_500,
            explore=0.1, steady=0.5, average=0.998, policy_rate=1e-5, loss=MPOConfig(initial_temperature=0.2),
        )
    )
    """MPO over torques, with a critic that sees the truth. The policy is good already, and rewards come once in some
    hundred ticks: what it learns of noise ruins it at a larger rate (docs/research/baselines.md)."""
    planner: PlannerSettings = field(default_factory=PlannerSettings)

    def __post_init__(self) -> None:
        """Reject contradictions."""
        if self.look_around is not None and self.look_around < 0:
            raise ValueError(f"look_around {self.look_around}: expected a number of ticks, 0 for none")
        if self.controller.sequence != self.controller.window:
            raise ValueError(
                f"controller: sequence {self.controller.sequence}: expected the window's {self.controller.window} ticks"
            )

    def turn(self, body: Body) -> int:
        """Return the ticks of a turn on the spot of a body."""
        return body.look_ticks if self.look_around is None else self.look_around
