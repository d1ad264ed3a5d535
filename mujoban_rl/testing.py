"""What every trainer promises (see `mujoban_rl.engine`), as checks for tests.

With a `make` that opens or resumes the run in a directory::

    def make(path):
        return Trainer(RunDirectory(path, {}), MyLearner(), MySource(), Budget(updates=6))

    check_resuming(make, tmp_path, stop_at=3, updates=6)
    check_refusal(make(tmp_path / "nan"), lambda batch: batch * math.nan)

And ticks to step modules through.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from mujoban_core.interfaces import ControllerInput, TerminationInput
from mujoban_core.signals import Interrupted
from mujoban_rl.engine import CARRIED, Learner, Source, Trainer
from mujoban_rl.limits import NaNGuard
from mujoban_rl.run_directory import copy_light

BatchT = TypeVar("BatchT")
SeenT = TypeVar("SeenT", ControllerInput, TerminationInput)


def tensors_of(part: Learner[Any] | Source[Any]) -> dict[str, Tensor]:
    """Return copies of all tensors of a part of a run, by name: weights, dual variables, moments, other state."""
    found = {f"{n}.{k}": v.clone() for n, m in part.modules.items() for k, v in m.state_dict().items()}
    found |= {f"state.{k}": v.clone() for k, v in part.state().tensors.items()}
    for name, optimiser in part.optimisers.items():
        for index, moments in optimiser.state_dict()["state"].items():
            found |= {f"{name}.{index}.{k}": torch.as_tensor(v).clone() for k, v in moments.items()}
    return found


def differing(one: dict[str, Tensor], other: dict[str, Tensor]) -> list[str]:
    """Return the names of tensors that are not the same to the bit."""
    names = one.keys() | other.keys()
    return sorted(k for k in names if k not in one or k not in other or not torch.equal(one[k], other[k]))


def check_resuming(make: Callable[[Path], Trainer[Any]], folder: Path, *, stop_at: int, updates: int) -> None:
    """Check that a run that SIGTERM stops leaves a checkpoint, from which it ends as one that never stopped.

    From a light copy of it, it goes on with the same weights, and gathers anew what it learns from.

    Args:
        make: Opens or resumes the run in a directory.
        folder: Receives the runs.
        stop_at: Update in which the signal comes.
        updates: Updates of the whole run.

    Raises:
        AssertionError: If not.
    """
    whole, stopped = make(folder / "whole"), make(folder / "parts")
    whole.run(limit_updates=updates)
    _terminate_at(stopped, stop_at)
    try:
        stopped.run(limit_updates=updates)
    except Interrupted:
        pass
    else:
        raise AssertionError("a run that was stopped ends as if it were not")
    copy_light(folder / "parts", folder / "light", CARRIED)
    resumed = make(folder / "parts")
    assert resumed.progress.updates == stop_at, f"resumed at update {resumed.progress.updates}, stopped at {stop_at}"
    resumed.run(limit_updates=updates)
    assert whole.progress.updates == resumed.progress.updates == updates
    assert whole.progress.samples == resumed.progress.samples
    for one, other in ((whole.learner, resumed.learner), (whole.source, resumed.source)):
        assert not (names := differing(tensors_of(one), tensors_of(other))), f"after resuming differ: {names}"
        assert one.state().values == other.state().values
    carried = make(folder / "light")
    before = carried.progress.samples
    carried.run(limit_updates=updates)
    assert carried.progress.updates == updates and carried.progress.samples > before > 0


def _terminate_at(trainer: Trainer[Any], update: int) -> None:
    learn = trainer.learner.update

    def last(batch: Any, progress: float, guard: NaNGuard) -> Any:
        statistics = learn(batch, progress, guard)
        if trainer.progress.updates + 1 == update:
            os.kill(os.getpid(), signal.SIGTERM)
        return statistics

    trainer.learner.update = last


def check_refusal(trainer: Trainer[BatchT], poison: Callable[[BatchT], BatchT]) -> None:
    """Check that a batch with NaN leaves weights, dual variables, optimisers and memory as they were, the next not.

    Args:
        trainer: A new run; its source is closed.
        poison: Returns a batch with a number that is not finite.

    Raises:
        AssertionError: If not.
    """
    learner, source, guard = trainer.learner, trainer.source, NaNGuard()
    try:
        source.publish(learner.weights(), 0)
        batches = [source.next_batch() for _ in range(3)]
    finally:
        source.close()
    first, second, third = (batch for batch in batches if batch is not None)
    learner.update(first, 0.5, guard)
    before = tensors_of(learner)
    learner.update(poison(second), 0.5, guard)
    after = tensors_of(learner)
    assert guard.skipped, "the batch was not refused"
    changed = [name for name in differing(before, after) if "generator" not in name]
    assert not changed, f"a batch with NaN changed {changed}"
    guard.skipped = 0
    learner.update(third, 0.5, guard)
    assert not guard.skipped, "what the refused batch left behind spoils the next"
    assert differing(before, tensors_of(learner)), "nothing was learned from the next batch"


def robot_ticks(kind: type[SeenT], n: int, proprio_size: int, rng: np.random.Generator) -> Iterator[SeenT]:
    """Yield what a robot might see in n ticks, a new instruction every third."""
    for tick in range(n):
        yield kind(
            frame=rng.integers(0, 256, (1, 64, 64, 3)).astype(np.uint8),
            proprio=rng.normal(size=(1, proprio_size)).astype(np.float32),
            instruction=np.array([tick // 3 % 5]),
            terminated=np.array([tick % 3 == 0]),
        )
