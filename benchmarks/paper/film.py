"""Film strips: an episode that the learned modules solved (paper Fig. 3), and one of the ant's (paper Fig. 5).

`record` plays test levels until one is solved and keeps the episode as JSON: its seed, the torques, the instructions
and the digests of the weights. Physics is deterministic, so `draw` plays the torques again, without any network, and
draws frames where it likes.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

mpl.use("Agg")

import matplotlib.pyplot as plt

from benchmarks.paper import runs
from benchmarks.paper.runs import SEED, SENSE, ResultError, read_source
from bringup.command import Choice, Stack, oracle
from bringup.rollout import ticks
from mujoban_core.bodies import ANT, BALL
from mujoban_core.grid import CONTROL_PERIOD, DIFFICULTIES, Instruction
from mujoban_core.plugins import ROLES
from mujoban_core.reports import write_report
from mujoban_rl.sealed_levels import noted_use
from mujoban_sim.presets import DEFAULT_WORLD
from mujoban_sim.world import World
from mujoban_sokoban.episodes import Episodes

_CANDIDATES: Final = 8
"""Levels that are played side by side; the one that is solved first is kept."""
_COLUMNS: Final = 8
_TOP_SIZE: Final = 256
"""Pixels along the edge of a frame from above."""
_ARROWS: Final = dict(zip(Instruction, "•↑→↓←", strict=True))


@dataclass(frozen=True)
class Film:
    """An episode that is kept."""

    name: str
    stack: Stack
    """What plays."""
    difficulty: int = max(DIFFICULTIES)
    seed: int = SEED
    """Of the first level."""

    @property
    def source(self) -> Path:
        """Where the episode lies."""
        return runs.JSON / f"{self.name}.json"

    @property
    def rerun(self) -> str:
        """The command that records it."""
        return f"python -m benchmarks.paper.runs --only {self.name}"


FILMS: Final = {
    BALL.name: Film("film_strip", Stack()),
    ANT.name: Film(
        "film_strip_ant",
        Stack({role: oracle(role, ANT.name) if role in SENSE else Choice(role) for role in ROLES}, body=ANT.name),
    ),
}
"""By the body that is seen; what the ant senses is known, as in Figure 5."""


def record(film: Film) -> None:
    """Play levels and write the first episode that is solved.

    Raises:
        ResultError: If none of them is solved.
    """
    stack, seed = film.stack, film.seed
    episodes = Episodes(_CANDIDATES, seed, difficulty=film.difficulty)
    torque: list[list[NDArray[np.float32]]] = [[] for _ in episodes]
    instructions: list[list[tuple[int, int]]] = [[] for _ in episodes]
    world = World(len(episodes), body=stack.body, max_boxes=episodes.max_boxes)
    for tick in ticks(stack.policy(), world, episodes):
        for m, index in enumerate(tick.episode.tolist()):
            torque[index].append(tick.decision.torque[m].copy())
            if tick.decision.issued[m]:
                instructions[index].append((int(tick.step[m]), int(tick.decision.instruction[m])))
        solved = tick.episode[tick.solved]
        if solved.size:
            first = int(solved[0])
            break
    else:
        raise ResultError(f"none of {len(episodes)} levels from seed {seed} on was solved: no film strip")
    content: dict[str, Any] = {
        "seed": seed + first,
        "difficulty": film.difficulty,
        "body": stack.body,
        "world": DEFAULT_WORLD,
        "weights": stack.identities(),
        "instructions": instructions[first],
        # The shortest decimals that give the same float32 again.
        "torque": [[float(str(value)) for value in values] for values in torque[first]],
    }
    how = {name: content[name] for name in ("difficulty", "body", "world")}
    content |= noted_use(range(seed, seed + len(episodes)), content["weights"], {"program": film.rerun, **how})
    write_report(content, film.source, indent=None)
    print(f"{film.name}: solved the level of seed {seed + first} in {len(torque[first])} steps", flush=True)


def load(film: Film) -> dict[str, Any] | None:
    """Return the recorded episode, or None if there is none.

    Raises:
        ResultError: If the file is not what `record` writes.
    """
    if not film.source.exists():
        return None
    return read_source(film.source, ("seed", "difficulty", "weights", "instructions", "torque"), film.rerun)


def is_stale(film: Film, episode: dict[str, Any]) -> bool:
    """Tell whether other modules played in a recorded episode than would now."""
    now = film.stack.identities()
    return any(now.get(role, played) != played for role, played in episode["weights"].items())


def play(
    episode: dict[str, Any], moments: Collection[int], top_size: int = _TOP_SIZE
) -> Iterator[tuple[int, NDArray[np.uint8], NDArray[np.uint8]]]:
    """Play the episode again and yield (step, first-person frame, frame from above) at the given steps.

    Raises:
        ResultError: If the level is not solved at its end: the world has changed since.
        RenderingError: If there is no OpenGL.
    """
    torque = np.array(episode["torque"], np.float32)
    levels = Episodes(1, episode["seed"], difficulty=episode["difficulty"])
    physics = {name: episode[name] for name in ("body", "world") if name in episode}
    world = World(1, **physics, max_boxes=levels.max_boxes)
    world.reset([0], [levels[0]])
    for step in range(len(torque) + 1):
        if step in moments:
            yield step, world.render()[0], world.render("top_down", size=top_size)[0]
        if step < len(torque):
            world.step(torque[step][None])
    if not world.solved[0]:
        raise ResultError("the world has changed since the film strip's episode was recorded; record another")


def draw(episode: dict[str, Any], file: Path) -> None:
    """Draw first-person frames above frames from above.

    Raises:
        ResultError: If the episode cannot be played again.
        RenderingError: If there is no OpenGL.
    """
    moments = np.linspace(0, len(episode["torque"]), _COLUMNS).round().astype(int).tolist()
    frames = list(play(episode, moments))
    figure, axes = plt.subplots(2, _COLUMNS, figsize=(1.5 * _COLUMNS, 3.4), layout="constrained")
    for column, (step, first_person, top_down) in enumerate(frames):
        axes[0, column].imshow(first_person, interpolation="nearest")
        axes[1, column].imshow(top_down)
        axes[0, column].set_title(f"{step * CONTROL_PERIOD:.1f} s {_arrow(episode['instructions'], step)}")
    for panel in axes.flat:
        panel.set_axis_off()
    figure.savefig(file, dpi=110)
    plt.close(figure)


def _arrow(instructions: list[tuple[int, int]], step: int) -> str:
    """Return the sign of the instruction in force at a step."""
    return _ARROWS[Instruction(max((begin, direction) for begin, direction in instructions if begin <= step)[1])]
