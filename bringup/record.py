"""Record many episodes as bags, quickly: `python bringup/record.py --out DIR`.

The policy is the learned stack or, in part, its oracles (`--oracle`), and is disturbed so that the recording covers
more than the states that it would visit; `--undisturbed` leaves it alone. Several processes share the work, here or
(`--cluster`) on the machines of a Ray cluster, which must all see the folder.
"""

from __future__ import annotations

if __name__ == "__main__":
    from mujoban_core.early import end_at_once

    end_at_once()

import multiprocessing
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Annotated, NamedTuple, NoReturn

import numpy as np
from tyro.conf import arg

from bringup.cluster import needs, spread
from bringup.command import Stack, import_from_here, recorded_seeds
from bringup.exploration import Disturbance, disturbed
from bringup.options import ClusterOptions, Count, ModuleOptions, WorldOptions, one_of, whole
from bringup.progress import EpisodesBar
from bringup.results import told, told_roles
from bringup.rollout import ticks
from mujoban_core import children
from mujoban_core.bodies import get_body
from mujoban_core.files import check_folder
from mujoban_core.grid import DIFFICULTIES
from mujoban_core.program import called, read_options, reason, run_command
from mujoban_core.sense_plan_act import SensePlanAct
from mujoban_core.signals import StopSignal, interrupt_status, interruptible, leave
from mujoban_core.threads import set_threads
from mujoban_sim.presets import DEFAULT_WORLD
from mujoban_sim.world import World
from mujoban_sokoban.episodes import EpisodeSpec, LazyEpisodes, after_moves
from mujoban_sokoban.generator import generate_level
from mujoban_sokoban.solver import solve_level

PROG = "record.py"
_GRACE = 60.0
"""Seconds that a process has to finish its bags."""
_START_STREAM = 0x6D697865
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
class Options:
    """Record many episodes as bags, quickly."""

    out: Annotated[Path, arg(metavar="DIR")]
    """New folder for the bags."""
    episodes: Count = 256
    """Number of episodes."""
    difficulty: tuple[Annotated[int, one_of(sorted(DIFFICULTIES))], ...] = (1, 2, 3, 4, 5, 5, 5, 5)
    """Difficulties to draw from; one that is named twice comes twice as often."""
    seed: Annotated[int | None, whole("N", 0)] = None
    """Of the first episode; by default the first for training."""
    allow_test_seeds: bool = False
    """Record also levels that are not for training."""
    run_seed: Annotated[int, whole("N", 0)] = 0
    """Of the randomness of modules and disturbances, which follows from no level's seed."""
    advanced: float = 0.5
    """Share of episodes that begin along a solution."""
    time_limit: Annotated[int, whole("STEPS", 0)] = 600
    """Steps of an episode; 0: those of the body."""
    batch: Count = 32
    """Episodes at the same time in each process."""
    processes: Count = 2
    """Processes that share the work."""
    shared: Annotated[ClusterOptions, arg(name="")] = field(default_factory=ClusterOptions)
    undisturbed: bool = False
    """Let the policy do as it will."""
    late_ends: bool = False
    """Have it end every instruction some ticks late, and else do as it will: when ends are told is judged by what
    follows them."""
    physics: Annotated[WorldOptions, arg(name="")] = field(default_factory=WorldOptions)
    modules: Annotated[ModuleOptions, arg(name="")] = field(default_factory=ModuleOptions)

    def __post_init__(self) -> None:
        """Reject what is no share, or contradicts itself."""
        if not 0.0 <= self.advanced <= 1.0:
            raise ValueError(f"--advanced {self.advanced}: expected a share, from 0 to 1")
        if self.undisturbed and self.late_ends:
            raise ValueError("--undisturbed --late-ends: expected one of them, both leave all else undisturbed")

    @property
    def disturbance(self) -> Disturbance | None:
        """How episodes depart from the policy."""
        if self.undisturbed:
            return None
        return Disturbance.late_ends() if self.late_ends else Disturbance()

    @property
    def parts(self) -> int:
        """Number of processes among which the episodes are shared out."""
        return min(self.shared.num_actors if self.shared.cluster else self.processes, self.episodes)


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
    run_seed: int
    """Of the randomness of modules and disturbances; each process has its own."""
    world: str = DEFAULT_WORLD


def record(job: Job, on_end: Callable[[int], None] = lambda _: None) -> int:
    """Play and record the episodes of a job; return the number of ticks.

    Args:
        job: What is recorded.
        on_end: Called with the number of episodes that have ended in a tick, if any.

    Raises:
        ValueError: If a module cannot be loaded.
        OSError: If a bag cannot be written.
        Interrupted: If the process was asked to end; the bags are whole then.
    """
    from bringup.rollout_recorder import Recorder

    set_threads(job.stack.threads)
    policy: SensePlanAct = job.stack.policy()
    if job.disturbance is not None:
        policy = disturbed(policy, job.disturbance, np.random.default_rng(job.run_seed), get_body(job.stack.body))
    world = World(
        min(job.batch, len(job.episodes)), body=job.stack.body, world=job.world, time_limit=job.time_limit,
        threads=job.stack.threads,
    )  # fmt: skip
    difficulties = [job.episodes.difficulty(i) for i in range(len(job.episodes))]
    recorder = Recorder(
        job.out, world.body, job.episodes, difficulties, prefix=job.prefix, world=job.world,
        privileged=told_roles(job.stack.identities()),
    )  # fmt: skip
    with StopSignal(deferred=False) as stop:
        try:
            for tick in ticks(policy, world, job.episodes, camera=True, run_seed=job.run_seed):
                stop.deferred = True
                recorder.write(tick, stop.check)
                stop.deferred = False
                # What a signal's handler raises while an object is deleted is lost; the signal is not.
                stop.check()
                ended = int((tick.solved | tick.truncated).sum())
                if ended:
                    on_end(ended)
        finally:
            stop.deferred = True
            recorder.close()
        stop.check()
    world.close()
    return recorder.ticks


def record_again(job: Job) -> int:
    """Record a job that may have been cut off before, by the loss of a machine; return the number of ticks."""
    for left in job.out.glob(f"{job.prefix}*"):
        shutil.rmtree(left)
    return record(job)


class _Answer(NamedTuple):
    """What a recording process has to say."""

    ended: int = 0
    """Episodes that have ended since it said something last."""
    ticks: int | None = None
    """Ticks recorded in all, once its job is done."""
    error: str = ""
    """What is wrong, in one line."""


def _work(job: Job, answers: Connection) -> None:
    """Record a job and tell how it goes."""
    children.end_with_parent()
    import_from_here()
    try:
        with interruptible():
            total = record(job, lambda ended: answers.send(_Answer(ended)))
        answers.send(_Answer(ticks=total))
    except (ValueError, OSError) as error:
        answers.send(_Answer(error=reason(error)))
    except KeyboardInterrupt as error:
        leave(interrupt_status(error))


@contextmanager
def working(jobs: Sequence[Job]) -> Iterator[list[Connection]]:
    """Have a process record each job, and yield where they tell how it goes.

    Those that have not ended when the context does are asked to, and are waited for: their bags are whole then.
    """
    context = multiprocessing.get_context("spawn")
    processes: list[BaseProcess] = []
    answers: list[Connection] = []
    try:
        for job in jobs:
            ours, theirs = context.Pipe(duplex=False)
            process = context.Process(target=_work, args=(job, theirs), daemon=True)
            with children.sheltered(), children.large_pages():
                process.start()
            theirs.close()
            processes.append(process)
            answers.append(ours)
        yield answers
    finally:
        with StopSignal():
            for process in processes:
                process.terminate()
            for process in processes:
                process.join(_GRACE)
                if process.is_alive():
                    process.kill()


def gather(answers: Sequence[Connection], on_end: Callable[[int], None]) -> int:
    """Wait until all recording processes are done; return the number of ticks.

    Args:
        answers: From `working`.
        on_end: Called with the number of episodes that have ended.

    Raises:
        ValueError: If one of them failed.
    """
    total, open_ones = 0, list(answers)
    while open_ones:
        for connection in wait(open_ones):
            assert isinstance(connection, Connection)
            try:
                answer: _Answer = connection.recv()
            except EOFError:
                raise ValueError("a recording process was killed: its last bags lack their end") from None
            if answer.error:
                raise ValueError(answer.error)
            on_end(answer.ended)
            if answer.ticks is not None:
                total += answer.ticks
                open_ones.remove(connection)
    return total


def main(command_line: Sequence[str] | None = None) -> int:
    """Run the command."""
    options = read_options(Options, command_line, called(PROG), __doc__)
    import_from_here()
    check_folder("--out", options.out, may_exist=True)
    seeds = recorded_seeds(options.seed, allow_test_seeds=options.allow_test_seeds)
    jobs = [_job(options, seeds.start, part) for part in range(options.parts)]
    who = told(jobs[0].stack.identities())
    options.out.mkdir(parents=True, exist_ok=True)
    recorded = 0
    with EpisodesBar(options.episodes) as bar:

        def on_end(ended: int) -> None:
            nonlocal recorded
            recorded += ended
            bar.reach(recorded, "recorded")

        on_end(0)
        total = _record_all(jobs, options.shared.cluster, on_end)
    print(f"{total} ticks of {options.episodes} episodes in {len(list(options.out.iterdir()))} bags", *who, sep="\n")
    return 0


def _record_all(jobs: Sequence[Job], cluster: str | None, on_end: Callable[[int], None]) -> int:
    """Record all jobs, on a cluster if there is one; return the number of ticks."""
    if cluster is None:
        with working(jobs) as answers:
            return gather(answers, on_end)
    return sum(
        spread(
            record_again, jobs, cluster, **needs(jobs[0].stack),
            on_result=lambda i, ticks: on_end(len(jobs[i].episodes)),
        )
    )  # fmt: skip


def _job(options: Options, seed: int, part: int) -> Job:
    """Return what process number `part` records: every `parts`-th episode."""
    parts = options.parts
    episodes = MixedEpisodes(
        len(range(part, options.episodes, parts)), seed + part, options.difficulty, advanced=options.advanced,
        stride=parts,
    )  # fmt: skip
    return Job(
        out=options.out,
        prefix=f"part{part}_",
        episodes=episodes,
        stack=options.modules.stack(options.physics.body),
        disturbance=options.disturbance,
        batch=options.batch,
        time_limit=options.time_limit or None,
        run_seed=int(np.random.SeedSequence([options.run_seed, part]).generate_state(1)[0]),
        world=options.physics.world,
    )


def run() -> NoReturn:
    """Run the command and end the process."""
    run_command(PROG, main)


if __name__ == "__main__":
    run()
