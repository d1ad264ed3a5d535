"""How large the trainings of `make weights` are: on CPU cores, or with a GPU.

Cores alone are given CPU seconds, so that a run comes to the same on a busy machine. A GPU is given seconds by the
clock, batches that keep it busy, and cores that play, search and read for it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

_NEVER: Final = "1000000000"
"""CPU seconds that nothing uses up."""
_GPU_NETWORK: Final[Mapping[str, Any]] = {"architecture": "thinking", "channels": 64, "blocks": 12, "tied": 6}
"""Of the planner on a GPU; on cores it has that of its trainer."""
_SEARCHING: Final = (
    "--trees", "768", "--batch-size", "2048", "--buffer", "1500000", "--first-evaluations", "60000",
    "--evaluations", "3", "--expansions", "80", "--questions", "60",
    *(text for name, value in _GPU_NETWORK.items() for text in (f"--{name}", str(value))),
    "--thoughts", "1", "2", "1", "4", "--actors", "processes", "--schedule", "first",
)  # fmt: skip
"""Of the planner: a larger network, whose searches run beside its learner, and larger ones."""
_ON_GPU: Final[Mapping[str, tuple[str, ...]]] = {
    "controller_distil": ("--task.batch", "192", "--distil.windows", "64", "--distil.first", "8000"),
    "planner": (*_SEARCHING, "--learning-rate", "2e-3"),
    "estimator_first": ("--streams", "48", "--learner.window-frames", "512", "--learning-rate", "2.5e-3"),
    "estimator_second": ("--streams", "48", "--learner.window-frames", "512", "--learning-rate", "2e-3"),
}
"""What trainings are told on a GPU, as its first weights learned (docs/research/weights.md)."""
_HALF: Final = ("planner",)
"""Stages that keep half of the cores beside a GPU busy; the others that run side by side have a quarter."""
_ALL: Final = ("bags_first", "estimator_first", "bags_second", "estimator_second")
"""Those that have a machine to themselves."""
_STREAMS_ALONE: Final = 5
"""Rows of the senses' batch on one core."""
_STREAMS_EACH: Final = 3
"""And for each of several."""
_LOSES_FEW: Final = 0.95
"""Share of the held-out levels of difficulty 5 that a planner solves which hardly changes any more."""


@dataclass(frozen=True)
class Machine:
    """What trains."""

    cores: int
    device: str
    """Of the networks, as PyTorch names it."""

    @property
    def gpu(self) -> bool:
        """Whether networks learn elsewhere than on the cores."""
        return self.device != "cpu"

    @property
    def episodes(self) -> int:
        """How many times as many recorded episodes an hour's training has use for, as on cores alone."""
        return 2 if self.gpu else 1

    def cores_of(self, stage: str) -> int:
        """Return the cores that a stage keeps busy."""
        if stage in _ALL:
            return self.cores
        # Without a GPU, what is begun on one core is not to wait for two: others run beside.
        return max(1, self.cores // (2 if stage in _HALF else 4)) if self.gpu else 1

    def budget(self, stage: str, seconds: float) -> tuple[str, ...]:
        """Return the options by which a training ends after so many seconds: of the clock, or of each of its cores."""
        if self.gpu:
            return ("--device", self.device, "--cpu-seconds", _NEVER, "--horizon-seconds", str(round(seconds)))
        return ("--cpu-seconds", str(round(seconds * self.cores_of(stage))))

    def begun_with(self, planner: Path) -> tuple[str, ...]:
        """Return the options, after `sizes`, by which trainings of the planner can begin with weights of another.

        What the other was taught on a GPU goes on without one, slower, and the other way round; none are needed where
        the network of this machine holds the other's.

        Raises:
            WeightsError: If the weights have no record, or it is none of a planner.
        """
        # They import PyTorch, which a run from nothing can do without.
        from mujoban_planner.expert_iteration import ExpertIterationConfig
        from mujoban_planner.validation import NetworkConfig
        from mujoban_rl.weights import read_record

        own = ExpertIterationConfig().network
        own = replace(own, **_GPU_NETWORK) if self.gpu else own
        needed = own.holding(NetworkConfig.of(planner))
        options = list[str]()
        for name, value in asdict(needed).items():
            if isinstance(value, bool):
                options += [] if value == getattr(own, name) else [f"--{'' if value else 'no-'}{name}"]
            elif value != getattr(own, name):
                options += [f"--{name}", str(value)]
        if needed.architecture == "thinking" != own.architecture:
            thoughts = read_record(planner).get("training", {}).get("thoughts", [])
            options += ["--thoughts", *map(str, thoughts)] if thoughts else []
        return tuple(options)

    def sizes(self, stage: str) -> tuple[str, ...]:
        """Return the options that say how large a training is."""
        cores = self.cores_of(stage)
        senses = stage.startswith("estimator")
        if not self.gpu:
            streams = _STREAMS_ALONE if cores == 1 else _STREAMS_EACH * cores
            return ("--streams", str(streams), "--shards", str(cores)) if senses else ()
        if senses:
            helpers = ("--shards", "1", "--workers", str(cores))
        else:
            helpers = ("--num-actors" if stage.startswith("planner") else "--threads", str(cores))
        return (*_ON_GPU.get(stage, ()), *helpers)


def goes_on_between(planner: Path) -> tuple[str, ...]:
    """Return the options by which a planner that loses few levels ends between what it was and what it becomes.

    The ends of all its trainings since then have equal shares: where each changes little, their mean solves more than
    they do (docs/research/planner.md#half-way). One that still learns a lot is only held back.

    Raises:
        WeightsError: If the weights have no record.
    """
    from mujoban_rl.weights import read_record

    record = read_record(planner)
    if (record.get("metrics") or {}).get("success_rate/5", 0.0) < _LOSES_FEW:
        return ()
    share = (record.get("training") or {}).get("init_share", 0.0)
    return ("--init-share", f"{1.0 / (2.0 - share):.3f}")
