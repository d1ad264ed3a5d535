"""How long the learned planner thinks before a decision: in the network, and in a search ahead.

The planner that plays in this process, its node and every command take these numbers from here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from mujoban_core.interfaces import Module

MOST_EVALUATIONS: Final = 10_000
"""Evaluations of a search ahead at most."""
MOST_SECONDS: Final = 60.0
"""Of a tick in which it may search."""
MOST_THINKING: Final = 64
"""Repeats or views in one decision at most."""
PER_TICK: Final = 2
"""Evaluations in a tick by default: 8 ms of the 50 ms between two ticks."""
CERTAINTY: Final = 0.9
"""Probability by default with which all must be as it seems that a plan rests on."""
REALTIME_SHARE: Final = 0.2
"""Share of a tick's wall time in which it searches in real time, instead of by a number of evaluations."""


@dataclass(frozen=True)
class Deliberation:
    """Thinking time of a planner."""

    thinking: int = 0
    """Repeats, per decision, of a recurrent core, relative to training, or of a thinking network's last blocks, or
    symmetric views of a residual network; 0 for the network's own."""
    look_ahead: int = 0
    """Evaluations of a tree search for a way to the end of the level; 0 for none."""
    per_tick: int = PER_TICK
    """Evaluations in one tick."""
    certainty: float = CERTAINTY
    """Probability with which all must be as it seems that a plan rests on."""
    deadline: float = 0.0
    """Seconds of a tick in which it searches, in the place of `per_tick`; 0 for none, as where time waits."""

    def __post_init__(self) -> None:
        """Reject numbers out of their range."""
        for name, least, most in (
            ("thinking", 0, MOST_THINKING),
            ("look_ahead", 0, MOST_EVALUATIONS),
            ("per_tick", 1, MOST_EVALUATIONS),
            ("certainty", 0.0, 1.0),
            ("deadline", 0.0, MOST_SECONDS),
        ):
            if not least <= getattr(self, name) <= most:
                raise ValueError(f"{name} is {getattr(self, name)}: expected {least} to {most}")

    def prepare(self, module: Module) -> Module:
        """Let a planner think so long; return what plays in its place, or itself.

        Raises:
            ValueError: If it is no learned planner, and asked for more than it does anyway.
        """
        if not self.thinking and not self.look_ahead:
            return module
        # They import PyTorch, which not every planner needs.
        from mujoban_planner.lookahead import LookAheadPlanner
        from mujoban_planner.planner import LearnedPlanner

        if not isinstance(module, LearnedPlanner):
            asked = "look-ahead" if self.look_ahead else "thinking"
            raise ValueError(f"{asked} with a {type(module).__name__}: expected a learned planner")
        if self.thinking:
            module.thinking = self.thinking
        if not self.look_ahead:
            return module
        return LookAheadPlanner(
            module, self.look_ahead, per_tick=self.per_tick, certainty=self.certainty, deadline=self.deadline
        )

    def settings(self) -> dict[str, int | float]:
        """Return what a report says of it."""
        search = {"look_ahead_per_tick": self.per_tick, "look_ahead_certainty": self.certainty}
        return {"thinking": self.thinking, "look_ahead": self.look_ahead, **(search if self.look_ahead else {})}
