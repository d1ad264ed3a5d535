"""The command-line options of every trainer that has actors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from mujoban_rl.actors.actor import ActorFactory
from mujoban_rl.actors.cluster import RayPool, Resources
from mujoban_rl.actors.local import LocalPool, ThreadPool
from mujoban_rl.actors.pool import ActorPool, Schedule
from mujoban_rl.actors.processes import ProcessPool


@dataclass(frozen=True)
class ActorOptions:
    """Where actors run. A trainer embeds this with `Annotated[ActorOptions, tyro.conf.arg(name="")]`.

    It is no part of a run's configuration: a run may go on with more actors, or elsewhere.
    """

    actors: Literal["local", "threads", "processes", "ray"] = "local"
    """In the learner's process by turns, in threads, in processes, or on Ray."""
    num_actors: int = 1
    """Processes that play."""
    schedule: Schedule | None = None
    """`turns`: actors and learner by turns; `ordered`: both at once, in an order that makes runs repeatable; `first`:
    both at once, whoever is ready first, so that no run is like another. By default `turns` for local, `first` for
    ray, `ordered` for the others."""
    address: str | None = None
    """Ray cluster to join: `auto`, HOST:PORT or ray://HOST:PORT; without it one is started on this machine."""
    actor_cpus: float = 1.0
    """CPUs that Ray sets aside for each actor."""
    actor_memory: float = 0.0
    """Gigabytes that Ray sets aside for each actor; 0: none."""
    actor_resources: Mapping[str, float] = field(default_factory=dict)
    """Named resources of the cluster that each actor takes, e.g. `actor 1`."""
    actor_threads: int = 1
    """Threads of torch in each actor's process."""

    def __post_init__(self) -> None:
        """Reject what contradicts itself."""
        if self.num_actors < 1 or self.actor_threads < 1:
            raise ValueError(
                f"--num-actors {self.num_actors} --actor-threads {self.actor_threads}: expected at least 1 of each"
            )
        if self.address is not None and self.actors != "ray":
            raise ValueError(f"--address {self.address}: only --actors ray has one, not {self.actors}")

    def pool(self, factory: ActorFactory) -> ActorPool:
        """Return a pool of actors that a factory makes."""
        count = self.num_actors
        if self.actors == "local":
            return LocalPool(factory, count, self.schedule or "turns")
        if self.actors == "threads":
            return ThreadPool(factory, count, self.schedule or "ordered")
        if self.actors == "processes":
            return ProcessPool(factory, count, self.schedule or "ordered", threads=self.actor_threads)
        return RayPool(
            factory, count, self.schedule or "first", address=self.address, threads=self.actor_threads,
            resources=Resources(self.actor_cpus, self.actor_memory, self.actor_resources),
        )  # fmt: skip
