"""Figure 5 of the paper: the planner with a controller for each body, what is sensed being known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Final

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt

from benchmarks.paper.figures import margins, save_rates
from benchmarks.paper.runs import CONFIGURATIONS, ROOT, SENSE, Run, load
from mujoban_core.bodies import ANT, BALL
from mujoban_core.grid import DIFFICULTIES
from mujoban_sim.presets import REFERENCE

_PAPER: Final = {BALL.name: 0.818, ANT.name: 0.737}
"""Success at difficulty 5 (paper A.3)."""
_WEIGHTS: Final = ROOT / "mujoban_controller" / "weights"
CONTROLLERS: Final = {
    BALL.name: _WEIGHTS / "controller_ball.safetensors",
    ANT.name: _WEIGHTS / "teacher_ant.safetensors",
}
"""Both learned in the reference world, in which they are compared."""
_GIVEN_SENSE: Final = CONFIGURATIONS[1]
_TITLES: Final = {
    BALL.name: "ball, by its camera",
    ANT.name: "ant, by ground truth (privileged)",
}
"""Of the controllers."""


def _run(body: str, difficulty: int) -> Run:
    title = f"{_TITLES[body]}, difficulty {difficulty}"
    if body == BALL.name and difficulty == _GIVEN_SENSE.difficulty:
        return replace(_GIVEN_SENSE, title=title)  # what Table 2 has measured already
    return Run(
        f"{body}_{difficulty}", title, difficulty, SENSE,
        _PAPER[body] if difficulty == max(DIFFICULTIES) else None, body=body, world=REFERENCE.name,
        modules=(("controller", CONTROLLERS[body]),),
    )  # fmt: skip


BODIES: Final = {body: tuple(_run(body, d) for d in DIFFICULTIES) for body in CONTROLLERS}
"""The evaluations of each body, difficulty 1 to 5, in the reference world."""
RUNS: Final = tuple(run for runs in BODIES.values() for run in runs)


def draw(file: Path) -> bool:
    """Draw success against difficulty for each body; return False when nothing has been measured."""
    found = {body: [(run, r) for run in runs if (r := load(run)) is not None] for body, runs in BODIES.items()}
    if not any(found.values()):
        return False
    figure, axes = plt.subplots(figsize=(8, 3.4), layout="constrained")
    for (body, measured), colour, aside in zip(found.items(), ("tab:blue", "tab:orange"), (-0.06, 0.06), strict=True):
        if measured:
            bars = list(zip(*(margins(report) for _, report in measured), strict=True))
            rates = [report["success_rate"] for _, report in measured]
            x = [run.difficulty + aside for run, _ in measured]  # side by side, as their rates are alike
            axes.errorbar(x, rates, yerr=bars, capsize=3, marker="o", color=colour, label=_TITLES[body])
        axes.scatter([max(DIFFICULTIES)], [_PAPER[body]], marker="x", color=colour, label=f"{body}, paper", zorder=3)
    save_rates(figure, axes, file)
    return True
