"""Figure 5 of the paper: the planner with a controller for each body, what is sensed being known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt

from benchmarks.paper.figures import draw_rates, save_rates
from benchmarks.paper.runs import CONFIGURATIONS, SENSE, Run, load
from mujoban_controller import camera_weights, teacher_weights
from mujoban_core.bodies import ANT, BALL
from mujoban_core.grid import DIFFICULTIES
from mujoban_core.plugins import shipped_weights
from mujoban_sim.presets import REFERENCE

_GIVEN_SENSE: Final = CONFIGURATIONS[1]
_PAPER: Final = {BALL.name: _GIVEN_SENSE.paper_success, ANT.name: 0.737}
"""Success at difficulty 5 (paper A.3)."""


class Driven(NamedTuple):
    """A body, and what drives it."""

    name: str
    body: str
    title: str
    controller: Path
    colour: str


DRIVEN: Final = (
    Driven("ball", BALL.name, "ball, by its camera", camera_weights(BALL.name), "tab:blue"),
    Driven("ant_camera", ANT.name, "ant, by its camera", camera_weights(ANT.name), "tab:orange"),
    Driven(
        "ant", ANT.name, "ant, by ground truth (privileged)", teacher_weights(ANT.name), "tab:green"
    ),
)  # fmt: skip
"""All learned in the reference world, in which they are compared."""
LEARNED: Final = Run(
    "ant_learned", "ant, all four modules learned, difficulty 5", body=ANT.name, world=REFERENCE.name,
    modules=tuple((role, shipped_weights(role, ANT.name)) for role in (*SENSE, "controller")),
)  # fmt: skip
"""What the paper does not have: the ant with its camera alone."""


def _run(driven: Driven, difficulty: int) -> Run:
    title = f"{driven.title}, difficulty {difficulty}"
    if driven.body == BALL.name and difficulty == _GIVEN_SENSE.difficulty:
        return replace(_GIVEN_SENSE, title=title)  # what Table 2 has measured already
    return Run(
        f"{driven.name}_{difficulty}", title, difficulty, SENSE,
        _PAPER[driven.body] if difficulty == max(DIFFICULTIES) else None, body=driven.body, world=REFERENCE.name,
        modules=(("controller", driven.controller),),
    )  # fmt: skip


BODIES: Final = {driven.name: tuple(_run(driven, d) for d in DIFFICULTIES) for driven in DRIVEN}
"""The evaluations of each body, difficulty 1 to 5, in the reference world."""
RUNS: Final = (*(run for runs in BODIES.values() for run in runs), LEARNED)


def draw(file: Path) -> bool:
    """Draw success against difficulty for each body; return False when nothing has been measured."""
    found = {driven: [(run, r) for run in BODIES[driven.name] if (r := load(run)) is not None] for driven in DRIVEN}
    if not any(found.values()):
        return False
    figure, axes = plt.subplots(figsize=(8, 3.4), layout="constrained")
    for (driven, measured), aside in zip(found.items(), (-0.08, 0.0, 0.08), strict=True):
        if measured:
            draw_rates(axes, measured, driven.title, driven.colour, "o", aside)
    if (learned := load(LEARNED)) is not None:
        draw_rates(axes, [(LEARNED, learned)], "ant, all four modules learned", "tab:red", "o", 0.16)
    for (body, rate), colour in zip(_PAPER.items(), ("tab:blue", "tab:orange"), strict=True):
        axes.scatter([max(DIFFICULTIES)], [rate], marker="x", color=colour, label=f"{body}, paper", zorder=3)
    save_rates(figure, axes, file)
    return True
