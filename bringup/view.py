"""The live terminal view: instruction, estimate and ground truth side by side, and the summary table."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Final

import numpy as np
from numpy.typing import NDArray
from rich import box
from rich.columns import Columns
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from bringup.monitor import MonitorNode, Watched
from bringup.results import EpisodeResult
from mujoban_core.grid import AGENT, BOX, CONTROL_PERIOD, TARGET, WALL, Instruction
from mujoban_core.plugins import TOLD, privileged_roles
from mujoban_msgs_py.conversions import EpisodeTruthReading, InstructionReading

ARROWS = {
    Instruction.STAY: "●",
    Instruction.NORTH: "↑",
    Instruction.EAST: "→",
    Instruction.SOUTH: "↓",
    Instruction.WEST: "←",
}
WIDE: Final = 80
"""Columns in which instruction and maps stand side by side."""


def grid_text(state: NDArray[np.float32]) -> Text:
    """Draw an abstract state, [N, N, 4], two characters a cell; cells of which it is unsure are dim."""
    text = Text()
    agent = int(np.argmax(state[..., AGENT]))
    size = state.shape[1]
    for index in range(state.shape[0] * size):
        cell = state[index // size, index % size]
        glyph, style = _glyph(cell, index == agent)
        layers = cell[[WALL, TARGET, BOX]]
        unsure = bool((np.abs(layers - 0.5) < 0.35).any())
        text.append(glyph, f"{style} dim" if unsure else style)
        if index % size == size - 1:
            text.append("\n")
    text.rstrip()
    return text


def _glyph(cell: NDArray[np.float32], agent: bool) -> tuple[str, str]:
    wall, target, box = (bool(cell[layer] > 0.5) for layer in (WALL, TARGET, BOX))
    if agent:
        return "@ ", "bold cyan on red" if target else "bold cyan"
    if wall:
        return "██", "bright_black"
    if box:
        return "■ ", "bold blue on green" if target else "bold yellow"
    return ("· ", "red") if target else ("  ", "")


def live_view(
    episode: EpisodeTruthReading | None,
    tick: Watched | None,
    outcomes: Sequence[EpisodeResult],
    weights: Mapping[str, str] | None = None,
    *,
    width: int = WIDE,
) -> RenderableType:
    """Return what the terminal shows of the latest tick; modules that are told the ground truth are named.

    Args:
        episode: The episode.
        tick: What the modules, or the agent, said.
        outcomes: Of the episodes before.
        weights: Name of each module -> what identifies it, see `bringup.command.Stack.identities`.
        width: Columns of the terminal; with fewer than `WIDE` the maps stand below the instruction.
    """
    if episode is None or tick is None:
        return Text("waiting for the graph ...")
    facts = {
        "episode": str(episode.episode),
        "seed": str(episode.seed),
        "difficulty": str(episode.difficulty) if episode.difficulty else "level file",
        "time": f"{episode.step * CONTROL_PERIOD:.1f} s",
        "step": str(episode.step),
        "return": f"{episode.episode_return:+.0f}",
        "on target": str(episode.boxes_on_target),
        "solved": f"{sum(r.solved for r in outcomes)} of {len(outcomes)}",
    }
    states = {"ground truth": tick.truth}
    if tick.alone:
        title, decided = "torque", Text(" ".join(f"{torque:+.2f}" for torque in tick.torque), "bold green")
    else:
        title, decided = "instruction", _decided(tick.instruction)
        facts["termination"] = f"p = {tick.termination.probability:.2f}"
        states = {"estimate": tick.estimate, **states}
    maps = [Panel(grid_text(state), title=name, height=12, width=24) for name, state in states.items()]
    told = privileged_roles(weights or {})
    last = Text(f"{TOLD}: {', '.join(told)}" if told else "", "yellow")
    if width < WIDE:
        pairs = [Text.assemble((f"{name} ", "bright_black"), value) for name, value in facts.items()]
        return Group(decided, Columns(pairs), Columns(maps), last)
    table = Table.grid(padding=(0, 1))
    for name, value in facts.items():
        table.add_row(Text(name, "bright_black"), value)
    return Group(Columns([Panel(Group(decided, table), title=title, height=12, width=30), *maps]), last)


def _decided(said: InstructionReading) -> Text:
    """Return an instruction with its number."""
    direction = Instruction(said.direction)
    text = Text(f"{ARROWS[direction]}  {direction.name.lower()}", "bold green")
    return text.append(f"   number {said.sequence}", "bright_black")


@contextmanager
def on_terminal(
    console: Console, weights: Mapping[str, str] | None = None
) -> Iterator[Callable[[MonitorNode, Sequence[EpisodeResult]], None]]:
    """Return what shows the latest tick of a monitor on a terminal, in place of the one before."""
    with Live(console=console, auto_refresh=False) as live:
        yield lambda monitor, results: live.update(
            live_view(monitor.episode, monitor.latest, results, weights, width=console.width), refresh=True
        )


def summary(results: Sequence[EpisodeResult]) -> Table:
    """Return the table of outcomes; at 60 columns only the outcome breaks, and no number."""
    table = Table(title="Episodes", box=box.SIMPLE_HEAD, padding=0, pad_edge=False)
    for name in ("seed", "outcome", "return", "steps", "instruc-\ntions", "time-\nouts", "wrong\nesti-\nmates"):
        words = name == "outcome"
        table.add_column(name, justify="left" if words else "right", no_wrap=not words, vertical="bottom")
    for r in results:
        outcome = Text("solved", "green") if r.solved else Text(str(r.failure), "red")
        table.add_row(
            str(r.seed), outcome, f"{r.episode_return:+.0f}", str(r.steps), str(r.instructions), str(r.time_outs),
            str(r.wrong_estimates),
        )  # fmt: skip
    return table
