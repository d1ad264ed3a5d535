"""What a cluster with many actors needs, computed from what was measured with few: `python -m benchmarks.plan`."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Annotated

import tyro

from benchmarks.command import run_benchmark
from bringup.options import Count
from mujoban_core.ranges import check_counts, check_not_negative, check_positive


@dataclass(frozen=True)
class Measured:
    """What `benchmarks.actors` says of one actor; the defaults are those of docs/cluster.md."""

    frames_per_second: float = 1340.0
    """Of one actor that has a core for itself."""
    bytes_per_frame: float = 12_373.0
    """What is sent and kept of a frame: 64 x 64 x 3 bytes of camera, and the rest."""
    weight_bytes: float = 5.52e6
    """Size of the weights that an actor needs."""
    receive_cpu_seconds_per_gb: float = 2.6
    """CPU time of the learner's process for each gigabyte of experience, without the replay's work."""

    def __post_init__(self) -> None:
        """Reject actors that deliver nothing, and sizes below 0."""
        check_positive(self, "frames_per_second")
        check_not_negative(self, "bytes_per_frame", "weight_bytes", "receive_cpu_seconds_per_gb")


@dataclass(frozen=True)
class Settings:
    """What a training wants of its actors."""

    frames_per_sequence: int = 256
    """That an actor delivers at a time."""
    machine_cores: int = 64
    """Of a machine of the pool."""
    replay_frames: float = 10e6
    """Frames that the learner keeps."""
    frames_per_update: float = 96.0
    """Actor steps for each update of the learner."""
    updates_per_version: float = 10.0
    """Updates between two publications of weights."""

    def __post_init__(self) -> None:
        """Reject what nothing can be divided by."""
        check_counts(self, "frames_per_sequence", "machine_cores")
        check_positive(self, "replay_frames", "frames_per_update", "updates_per_version")


def plan(measured: Measured, actors: int, settings: Settings | None = None) -> dict[str, float]:
    """Return what `actors` actors deliver and need.

    An actor takes the newest weights with every sequence. Ray brings a version to a machine once for all its actors, so
    that a machine takes at most as many versions as there are, and at most as many as its actors play sequences.

    Returns:
        Rates in seconds, sizes in bytes.
    """
    settings = settings or Settings()
    frames = measured.frames_per_second * actors
    machines = -(-actors // settings.machine_cores)
    updates = frames / settings.frames_per_update
    sequences = frames / settings.frames_per_sequence
    taken = min(sequences, machines * updates / settings.updates_per_version)
    return {
        "actors": actors,
        "machines": machines,
        "frames_per_second": frames,
        "updates_per_second": updates,
        "learner_receives_bytes_per_second": frames * measured.bytes_per_frame,
        "learner_cores_to_receive": frames * measured.bytes_per_frame / 1e9 * measured.receive_cpu_seconds_per_gb,
        "learner_sends_bytes_per_second": taken * measured.weight_bytes,
        "replay_bytes": settings.replay_frames * measured.bytes_per_frame,
        "replay_seconds": settings.replay_frames / frames,
        "in_flight_bytes": actors * settings.frames_per_sequence * measured.bytes_per_frame,
    }


@dataclass(frozen=True)
class Options:
    """Print the plan for a number of actors."""

    actors: Count = 1000
    measured: Annotated[Measured, tyro.conf.arg(name="")] = Measured()
    settings: Annotated[Settings, tyro.conf.arg(name="")] = Settings()


def report(options: Options) -> dict[str, object]:
    """Return the plan with what it rests on."""
    return {
        "measured": asdict(options.measured),
        "settings": asdict(options.settings),
        "plan": plan(options.measured, options.actors, options.settings),
    }


if __name__ == "__main__":
    run_benchmark("benchmarks.plan", Options, report)
