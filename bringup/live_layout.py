"""What the live view looks like: its panels, the colours and names of curves, the key of the maps, the text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from mujoban_msgs.msg import EpisodeTruth, Instruction
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from bringup.overlay import COLOURS
from bringup.view import ARROWS
from mujoban_core.grid import CONTROL_PERIOD, GRID_SIZE, OFFSETS_RC
from mujoban_core.grid import Instruction as Direction
from mujoban_core.plugins import AGENT, ROLES, TOLD, is_privileged, privileged_roles

CELL: Final = 16
"""Pixels along the edge of a cell of a map."""
_KEY_CELLS: Final = 2.5
"""Height of the key below a map, in cells."""
_SHARPNESS: Final = 4
"""Pixels of the key to one of its map."""
_SHOWN: Final = 20.0
"""Seconds of simulated time that the quick curves show."""
_PALETTE: Final = ((0, 114, 178), (230, 120, 0), (0, 158, 115), (204, 90, 160), (130, 130, 130), (86, 180, 233),
                   (160, 140, 0), (180, 40, 40))  # fmt: skip
"""RGB of curves, told apart by the colour-blind too, on white and on black (after Okabe and Ito)."""
_INSTRUCTION_COLOUR: Final = (0, 220, 90)
_CURVES: Final = {
    "beta/probability": "p(done)",
    "reward/return": "return so far",
    "reward/step": "of this step",
    "milliseconds/simulator": "simulator",
    "milliseconds/estimator": "estimator",
    "milliseconds/termination": "termination",
    "milliseconds/planner": "planner",
    "milliseconds/controller": "controller",
}
ESTIMATE: Final = "grid/estimate"
TRUTH: Final = "grid/ground_truth"


class Shown(NamedTuple):
    """What the text says."""

    instruction: Instruction | None
    episode: EpisodeTruth | None
    modules: Mapping[str, str]
    """Role -> what plays it."""


def text(shown: Shown) -> str:
    """Return the text, Markdown: the instruction with its arrow, the episode, and who plays."""
    heading, rows = "waiting for the graph", []
    if shown.instruction is not None:
        direction = Direction(shown.instruction.direction)
        heading = f"{ARROWS[direction]} {direction.name.lower()}"
        rows.append(("instruction", str(shown.instruction.sequence)))
    if shown.episode is not None:
        episode = shown.episode
        level = f"difficulty {episode.difficulty}" if episode.difficulty else "level file"
        boxes = sum(episode.level.count(glyph) for glyph in "$*")
        rows += [
            ("episode", f"{episode.episode}: seed {episode.seed}, {level}"),
            ("time", f"{episode.step * CONTROL_PERIOD:.1f} s"),
            ("on target", f"{episode.boxes_on_target} of {boxes} boxes{', solved' if episode.solved else ''}"),
            ("return", f"{episode.episode_return:+.0f}"),
        ]
    for role in _roles(shown.modules):
        who = shown.modules.get(role, "not heard yet")
        rows.append((role, f"**{who}**" if is_privileged(who) else who))
    head, *others = rows
    table = [f"| {head[0]} | {head[1]} |", "|---|---|", *(f"| {name} | {value} |" for name, value in others)]
    return "\n".join([f"# {heading}", *table])


def told(modules: Mapping[str, str]) -> str:
    """Return who is told the ground truth, Markdown: it holds for a whole run, whatever moment of it is looked at.

    Args:
        modules: Role -> what plays it, of the roles that were heard of.
    """
    roles = privileged_roles(modules)
    unheard = [role for role in _roles(modules) if role not in modules]
    lines = [f"**{TOLD}: {', '.join(roles)}**"] if roles else []
    lines += [f"not heard yet: {', '.join(unheard)}"] if unheard else []
    return "\n\n".join(lines) or "nobody"


def _roles(modules: Mapping[str, str]) -> Sequence[str]:
    """Return the roles that are played: an agent's, where one was heard of, or those of the four modules."""
    return (AGENT,) if AGENT in modules else tuple(ROLES)


def describe(stream: rr.RecordingStream) -> None:
    """Log what stays: names and colours of the curves, and the key of the maps."""
    places = [entity.partition("/")[0] for entity in _CURVES]
    for index, (entity, name) in enumerate(_CURVES.items()):
        colour = _PALETTE[index - places.index(places[index])]
        stream.log(entity, rr.SeriesLines(colors=[colour], names=[name], widths=[2.0]), static=True)
    points = rr.SeriesPoints(colors=[_PALETTE[1]], names=["said: done"], markers=["circle"], marker_sizes=[4.0])
    stream.log("beta/terminated", points, static=True)
    for place in (ESTIMATE, TRUTH):
        _describe_map(stream, place)


def _describe_map(stream: rr.RecordingStream, place: str) -> None:
    """Log the key of a map below it, as a picture: Rerun's own labels are small, and wrap."""
    stream.log(f"{place}/key", rr.Image(_key_picture()), static=True)
    below = rr.Transform3D(translation=(0.0, CELL * GRID_SIZE, 0.0), scale=1.0 / _SHARPNESS)
    stream.log(f"{place}/key", below, static=True)


def _key_picture() -> NDArray[np.uint8]:
    """Return what the colours of a map stand for, in two rows, RGB."""
    unit = CELL * _SHARPNESS
    image = Image.new("RGB", (unit * GRID_SIZE, round(unit * _KEY_CELLS)), (255, 255, 255))
    brush = ImageDraw.Draw(image)
    font = ImageFont.load_default(0.7 * unit)
    starts = (0.2, 2.9, 6.4)
    for index, (name, colour) in enumerate(COLOURS.items()):
        row, column = divmod(index, len(starts))
        left, top = unit * starts[column], unit * (0.25 + 1.15 * row)
        brush.rectangle((left, top, left + 0.8 * unit, top + 0.8 * unit), fill=colour, outline=(90, 90, 90), width=2)
        brush.text((left + 1.05 * unit, top + 0.4 * unit), name, fill=(20, 20, 20), anchor="lm", font=font)
    return np.asarray(image)


def arrow(agent: tuple[float, float], direction: int) -> rr.Arrows2D | rr.Points2D:
    """Return the instruction as an arrow from the agent's place, [pixels], to the next cell; a dot for `stay`."""
    down, right = OFFSETS_RC[direction]
    length = CELL if direction != Direction.STAY else 0.0
    return rr.Arrows2D(
        origins=[agent], vectors=[(length * float(right), length * float(down))], colors=[_INSTRUCTION_COLOUR],
        radii=[0.12 * CELL],
    )  # fmt: skip


def torque_curves(joints: Sequence[str], size: int) -> rr.SeriesLines:
    """Return colours and names of the torques, [U]: the joints they act on, or numbers where these are not said."""
    names = list(joints) if len(joints) == size else [str(i + 1) for i in range(size)]
    colours = [_PALETTE[i % len(_PALETTE)] for i in range(size)]
    return rr.SeriesLines(colors=colours, names=names, widths=[2.0] * size)


def blueprint() -> rrb.Blueprint:
    """Return the arrangement of the view."""
    bounds = rrb.VisualBounds2D(x_range=(0, CELL * GRID_SIZE), y_range=(0, CELL * (GRID_SIZE + _KEY_CELLS)))
    maps = [
        rrb.Spatial2DView(
            origin=place, contents=[place, f"{place}/key", f"{place}/instruction"], name=name, visual_bounds=bounds
        )
        for place, name in ((ESTIMATE, "estimate"), (TRUTH, "ground truth"))
    ]
    recent = rrb.VisibleTimeRange(
        "simulated_time",
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-_SHOWN),
        end=rrb.TimeRangeBoundary.cursor_relative(seconds=0.0),
    )
    corner = rrb.PlotLegend(rrb.Corner2D.LeftTop)
    curves = [
        rrb.TimeSeriesView(
            origin="beta", name="is it done? p(beta)", time_ranges=recent, plot_legend=corner,
            axis_y=rrb.ScalarAxis(range=(-0.02, 1.05)),
        ),
        rrb.TimeSeriesView(
            origin="torque", name="torque, 1 = the most", time_ranges=recent, plot_legend=corner,
            axis_y=rrb.ScalarAxis(range=(-1.05, 1.05)),
        ),
        rrb.TimeSeriesView(origin="reward", name="reward", plot_legend=corner),
        rrb.TimeSeriesView(origin="milliseconds", name="ms a tick, by node", time_ranges=recent, plot_legend=corner),
    ]  # fmt: skip
    texts = rrb.Vertical(
        rrb.TextDocumentView(origin="now", name="now"),
        rrb.TextDocumentView(origin="told", name="who is told the ground truth"),
        row_shares=[4.0, 1.0],
    )
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(
                rrb.Spatial2DView(origin="camera/first_person", name="what the robot sees"),
                rrb.Spatial2DView(origin="camera/top_down", name="from above (unseen)"),
                *maps,
            ),
            rrb.Horizontal(texts, *curves, column_shares=[1.1, 1.0, 1.0, 1.0, 1.0]),
        ),
        collapse_panels=True,
    )
