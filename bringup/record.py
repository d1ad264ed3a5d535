"""Record many episodes as bags, quickly: `python bringup/record.py --out DIR`.

The policy is the learned stack or, in part, its oracles (`--oracle`), and is disturbed so that the recording covers
more than the states that it would visit; `--undisturbed` leaves it alone. Several processes share the work.
"""

from __future__ import annotations

import argparse
import multiprocessing
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import Progress

from bringup.command import (
    Parser,
    Stack,
    add_module_options,
    add_world_option,
    import_from_here,
    run_command,
    stack_from,
)
from bringup.exploration import Disturbance, disturbed
from bringup.rollout import ticks
from mujoban_core.grid import DIFFICULTIES
from mujoban_core.sense_plan_act import SensePlanAct
from mujoban_rl.limits import StopSignal
from mujoban_sim.presets import DEFAULT_WORLD
from mujoban_sim.world import World
from mujoban_sokoban.episodes import EpisodeSpec, LazyEpisodes, after_moves
from mujoban_sokoban.generator import TRAIN_SEEDS, generate_level
from mujoban_sokoban.solver import solve_level

PROG = "record.py"
_START_STREAM = 2
"""Tells the random stream of starting positions from others that a seed governs."""


class MixedEpisodes(LazyEpisodes):
    """Episodes of mixed difficulty, some of which begin in the middle of their solution.

    Episode i has seed `seed + i * stride`, which alone decides its level.
    """

    def __init__(
        self, count: int, seed: int, difficulties: Sequence[int], *, advanced: float = 0.0, stride: int = 1
    ) -> None:
        """Describe the episodes.

        Args:
            count: Number of episodes.
            seed: Seed of the first.
            difficulties: From these one is drawn for each episode; name one twice to have it twice as often.
            advanced: Share of episodes that begin along the solver's solution.
            stride: Distance between the seeds.

        Raises:
            ValueError: If an argument is out of its range.
        """
        unknown = [d for d in difficulties if d not in DIFFICULTIES]
        if unknown or not difficulties:
            raise ValueError(f"difficulties {list(difficulties)}: expected some of {', '.join(map(str, DIFFICULTIES))}")
        if count < 1 or seed < 0 or not 0.0 <= advanced <= 1.0:
            raise ValueError(
                f"{count} episodes from seed {seed}, share {advanced} advanced: expected at least 1, a seed from 0, "
                "a share from 0 to 1"
            )
        super().__init__(count)
        self._seed, self._stride = seed, stride
        self._difficulties, self._advanced = tuple(difficulties), advanced

    def difficulty(self, index: int) -> int:
        """Return the difficulty of an episode."""
        return self._difficulties[int(self._rng(index).integers(len(self._difficulties)))]

    def _rng(self, index: int) -> np.random.Generator:
        return np.random.default_rng([_START_STREAM, self._seed + index * self._stride])

    def _make(self, index: int) -> EpisodeSpec:
        seed, rng = self._seed + index * self._stride, self._rng(index)
        rng.integers(len(self._difficulties))
        level = generate_level(self.difficulty(index), seed)
        if rng.random() < self._advanced:
            moves = solve_level(level, weight=2.0).moves
            level = after_moves(level, moves[: rng.integers(0, max(1, len(moves) - 2))])
        return EpisodeSpec(level, seed)


@dataclass(frozen=True)
class Job:
    """What one process records."""

    out: Path
    prefix: str
    episodes: MixedEpisodes
    stack: Stack
    disturbance: Disturbance | None
    batch: int
    time_limit: int | None
    seed: int
    world: str = DEFAULT_WORLD


def record(job: Job, progress: Progress | None = None) -> int:
    """Play and record the episodes of a job, unless a signal asks to stop; return the number of ticks."""
    import torch

    from bringup.rollout_recorder import Recorder

    torch.set_num_threads(1)
    policy: SensePlanAct = job.stack.policy()
    if job.disturbance is not None:
        policy = disturbed(policy, job.disturbance, np.random.default_rng(job.seed))
    world = World(min(job.batch, len(job.episodes)), world=job.world, time_limit=job.time_limit)
    task = None if progress is None else progress.add_task("recorded", total=len(job.episodes))
    difficulties = [job.episodes.difficulty(i) for i in range(len(job.episodes))]
    recording = Recorder(job.out, world.body, job.episodes, difficulties, prefix=job.prefix)
    with StopSignal() as stop, recording as recorder:
        for tick in ticks(policy, world, job.episodes, camera=True):
            recorder.write(tick)
            if stop.requested:
                break
            ended = int((tick.solved | tick.truncated).sum())
            if progress is not None and task is not None and ended:
                progress.update(task, advance=ended)
    world.close()
    return recorder.ticks


def main() -> int:
    """Run the command."""
    arguments = _arguments()
    import_from_here()
    if arguments.out.exists() and any(arguments.out.iterdir()):
        raise ValueError(f"{arguments.out} is not empty: expected a new folder for the bags")
    if arguments.processes < 1 or arguments.batch < 1:
        raise ValueError(f"{arguments.processes} processes, batch {arguments.batch}: expected at least 1")
    jobs = [_job(arguments, part) for part in range(min(arguments.processes, arguments.episodes))]
    arguments.out.mkdir(parents=True, exist_ok=True)
    context = multiprocessing.get_context("spawn")
    with context.Pool(len(jobs) - 1) if len(jobs) > 1 else nullcontext() as pool:
        others = [] if pool is None else [pool.apply_async(record, (job,)) for job in jobs[1:]]
        with Progress(console=Console(stderr=True)) as progress:
            total = record(jobs[0], progress)
        total += sum(other.get() for other in others)
    print(f"{total} ticks of {arguments.episodes} episodes in {len(list(arguments.out.iterdir()))} bags")
    return 0


def _arguments() -> argparse.Namespace:
    parser = Parser(PROG, description="Record many episodes as bags, quickly.")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="new folder for the bags")
    parser.add_argument("--episodes", type=int, default=256, help="number of episodes")
    parser.add_argument(
        "--difficulty", type=int, nargs="+", default=[1, 2, 3, 4, 5, 5, 5, 5],
        help="difficulties to draw from; one that is named twice comes twice as often",
    )  # fmt: skip
    parser.add_argument(
        "--seed", type=int, default=TRAIN_SEEDS.start, help="of the first episode; by default the first for training"
    )
    parser.add_argument("--advanced", type=float, default=0.5, help="share of episodes that begin along a solution")
    parser.add_argument("--time-limit", type=int, default=600, help="ticks of an episode; 0: those of the body")
    parser.add_argument("--batch", type=int, default=32, help="episodes at the same time in each process")
    parser.add_argument("--processes", type=int, default=2, help="processes that share the work")
    parser.add_argument("--undisturbed", action="store_true", help="let the policy do as it will")
    add_world_option(parser)
    add_module_options(parser)
    return parser.parse_args()


def _job(arguments: argparse.Namespace, part: int) -> Job:
    """Return what process number `part` records: every `processes`-th episode."""
    processes = min(arguments.processes, arguments.episodes)
    episodes = MixedEpisodes(
        len(range(part, arguments.episodes, processes)), arguments.seed + part, arguments.difficulty,
        advanced=arguments.advanced, stride=processes,
    )  # fmt: skip
    return Job(
        out=arguments.out,
        prefix=f"part{part}_",
        episodes=episodes,
        stack=stack_from(arguments),
        disturbance=None if arguments.undisturbed else Disturbance(),
        batch=arguments.batch,
        time_limit=arguments.time_limit or None,
        seed=arguments.seed + part,
        world=arguments.world,
    )


if __name__ == "__main__":
    run_command(PROG, main)
