"""How long the learned planner thinks before a decision: in the network, and in a search ahead.

The planner that plays in this process, its node and every command take these numbers from here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from mujoban_core.plugins import LEARNED

if TYPE_CHECKING:
    from mujoban_core.interfaces import Module

LOOK_AHEAD: Final = 400
"""Evaluations of a search ahead by the learned planner, where nobody says otherwise."""
MOST_EVALUATIONS: Final = 10_000
"""Evaluations of a search ahead at most."""
MOST_SECONDS: Final = 60.0
"""Of a tick in which it may search."""
MOST_THINKING: Final = 64
"""Repeats or views in one decision at most."""
PER_TICK: Final = 2
"""Evaluations in a tick by default, of less than 1 ms each on one core."""
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
    look_ahead: int | None = None
    """Evaluations of a tree search for a way to the end of the level; 0 for none, None for `LOOK_AHEAD` by the learned
    planner and none by any other."""
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
            given = getattr(self, name)
            if given is not None and not least <= given <= most:
                option = name if name in ("thinking", "look_ahead") else f"look_ahead_{name}"
                raise ValueError(f"{option} is {given}: expected {least} to {most}")

    def evaluations(self, source: str = LEARNED) -> int:
        """Return the evaluations of the search by a planner from a source, as `Choice.source` names it."""
        if self.look_ahead is not None:
            return self.look_ahead
        return LOOK_AHEAD if source == LEARNED else 0

    def prepare(self, module: Module, source: str = LEARNED) -> Module:
        """Let a planner from a source think so long; return what plays in its place, or itself.

        Raises:
            ValueError: If it is no learned planner, and asked for more than it does anyway.
        """
        look_ahead = self.evaluations(source)
        if not self.thinking and not look_ahead:
            return module
        # They import PyTorch, which not every planner needs.
        from mujoban_planner.lookahead import LookAheadPlanner
        from mujoban_planner.planner import LearnedPlanner

        if not isinstance(module, LearnedPlanner):
            asked = "look-ahead" if look_ahead else "thinking"
            raise ValueError(f"{asked} with a {type(module).__name__}: expected a learned planner")
        if self.thinking:
            module.thinking = self.thinking
        if not look_ahead:
            return module
        return LookAheadPlanner(
            module, look_ahead, per_tick=self.per_tick, certainty=self.certainty, deadline=self.deadline
        )

    def settings(self, source: str = LEARNED) -> dict[str, int | float]:
        """Return what a report says of it, for a planner from a source."""
        look_ahead = self.evaluations(source)
        search = {"look_ahead_per_tick": self.per_tick, "look_ahead_certainty": self.certainty}
        return {"thinking": self.thinking, "look_ahead": look_ahead, **(search if look_ahead else {})}
