"""Share out independent work, such as the levels of an evaluation, over a Ray cluster."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeVar

from bringup.command import Player
from bringup.options import HERE
from bringup.results import EpisodeResult
from mujoban_core.bodies import BALL
from mujoban_core.threads import set_threads
from mujoban_sim.presets import DEFAULT_WORLD
from mujoban_sokoban.episodes import Episodes, EpisodeSpec, LazyEpisodes

JobT = TypeVar("JobT")
ResultT = TypeVar("ResultT")

_RETRIES: Final = 3
"""Times that a job is done again when the process or the machine that does it dies."""


def needs(player: Player) -> dict[str, float]:
    """Return what `spread` is to set aside for each job of a player; Ray hides GPUs from those that ask for none."""
    return {"cpus": float(player.threads), "gpus": float(player.device.startswith("cuda"))}


def spread(
    function: Callable[[JobT], ResultT],
    jobs: Sequence[JobT],
    address: str = HERE,
    *,
    cpus: float = 1.0,
    gpus: float = 0.0,
    on_result: Callable[[int, ResultT], None] = lambda index, result: None,
) -> list[ResultT]:
    """Do jobs on a Ray cluster and return their results in the order of the jobs.

    Args:
        function: Does a job; must be of a module that all machines have, and do no harm when it is done again after
            it was cut off, since a job whose machine is lost is done by another.
        jobs: Plain dataclasses.
        address: See `mujoban_rl.actors.cluster.Cluster`; or `HERE`.
        cpus: CPUs for each job.
        gpus: GPUs for each job.
        on_result: Called with the index of a job and its result as soon as it is done.

    Raises:
        ValueError: If Ray is not installed.
        ConnectionError: If there is no cluster at the address.
        Exception: What `function` raised.
    """
    from mujoban_rl.actors.cluster import Cluster

    cluster = Cluster(None if address == HERE else address, cpus=cpus * len(jobs))
    try:
        ray: Any = cluster.ray
        task = ray.remote(num_cpus=cpus, num_gpus=gpus, max_retries=_RETRIES)(function)
        waiting = {task.remote(job): index for index, job in enumerate(jobs)}
        results: dict[int, ResultT] = {}
        while waiting:
            (done, *_), _ = ray.wait(list(waiting), num_returns=1)
            index = waiting.pop(done)
            try:
                results[index] = ray.get(done)
            except ray.exceptions.RayTaskError as error:
                raise error.cause from None
            on_result(index, results[index])
        return [results[index] for index in range(len(jobs))]
    finally:
        cluster.close()


class EveryNth(LazyEpisodes):
    """Every n-th episode of a run of episodes."""

    def __init__(self, episodes: Episodes, first: int, n: int) -> None:
        """Take episodes `first`, `first + n`, ..."""
        super().__init__(len(range(first, len(episodes), n)))
        self._episodes, self._first, self._n = episodes, first, n
        self.max_boxes = episodes.max_boxes

    def number(self, index: int) -> int:
        """Return the number of an episode among all of the run."""
        return self._episodes.number(self._first + index * self._n)

    def _make(self, index: int) -> EpisodeSpec:
        return self._episodes[self._first + index * self._n]


@dataclass(frozen=True)
class _Share:
    """What one process of a cluster evaluates."""

    stack: Player
    episodes: EveryNth
    world: str
    batch: int
    time_limit: int | None
    body: str


def evaluate_on_cluster(
    stack: Player,
    episodes: Episodes,
    address: str = HERE,
    *,
    num_actors: int,
    body: str = BALL.name,
    world: str = DEFAULT_WORLD,
    batch: int = 64,
    time_limit: int | None = None,
    on_results: Callable[[Sequence[EpisodeResult]], None] = lambda results: None,
) -> list[EpisodeResult]:
    """Play every `num_actors`-th episode in each of as many processes and return the outcomes in their order.

    The outcomes are those of `bringup.evaluate.evaluate`. Where networks take part, an episode may end some ticks
    earlier or later, as with another `batch`: matrix products round differently with others in the batch.

    Args:
        stack: The four modules, or an agent; weights of one's own must lie on all machines under the same path.
        episodes: Levels and seeds.
        address: See `spread`.
        num_actors: Number of processes.
        body: The robot's body.
        world: The physical world, see `mujoban_sim.presets`.
        batch: Rows of each one's world.
        time_limit: Steps of an episode; None means that of the body.
        on_results: Called with all outcomes so far, in any order, when a process is done.
    """
    n = min(num_actors, len(episodes))
    shares = [_Share(stack, EveryNth(episodes, first, n), world, batch, time_limit, body) for first in range(n)]
    ended: list[EpisodeResult] = []

    def on_result(_: int, results: list[EpisodeResult]) -> None:
        ended.extend(results)
        on_results(ended)

    done = spread(_play, shares, address, **needs(stack), on_result=on_result)
    return [done[i % n][i // n] for i in range(len(episodes))]


def _play(share: _Share) -> list[EpisodeResult]:
    from bringup.evaluate import evaluate

    set_threads(share.stack.threads)
    return evaluate(
        share.stack.policy(), share.episodes, body=share.body, world=share.world, batch=share.batch,
        time_limit=share.time_limit, threads=share.stack.threads,
    )  # fmt: skip
