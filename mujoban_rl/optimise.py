"""Gradient steps as every learner takes them: clipped, scheduled, averaged, and refused when not finite."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Sequence
from typing import Generic, TypeVar

from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from mujoban_rl.limits import NaNGuard

Weights = tuple[Tensor, ...] | list[Tensor]
ModuleT = TypeVar("ModuleT", bound=nn.Module)


def guarded_step(
    loss: Tensor,
    optimisers: Sequence[Optimizer],
    guard: NaNGuard,
    *,
    clip: float = math.inf,
    part: str = "",
) -> Tensor | None:
    """Step all optimisers along the gradient of a loss, or none of them if a number is not finite.

    Args:
        loss: Scalar.
        optimisers: Every optimiser with a parameter in the loss, those of dual variables too.
        guard: Decides.
        clip: Largest norm of the gradient of the first optimiser's parameters, which are clipped together.
        part: Which step of an update, where it has several; see `NaNGuard.accept`.

    Returns:
        The gradient's norm before clipping, or None where the step was refused.
    """
    for optimiser in optimisers:
        optimiser.zero_grad(set_to_none=True)
    loss.backward()
    return step_if_finite(loss, optimisers, guard, clip=clip, part=part)


def step_if_finite(
    loss: Tensor,
    optimisers: Sequence[Optimizer],
    guard: NaNGuard,
    *,
    clip: float = math.inf,
    clipped: Iterable[nn.Parameter] | None = None,
    part: str = "",
) -> Tensor | None:
    """Step all optimisers along the gradients that their parameters have; see `guarded_step`.

    Clipped together are the parameters `clipped`, where they are given in place of the first optimiser's.
    """
    first = list(clipped) if clipped is not None else _parameters(optimisers[:1])
    known = {id(p) for p in first}
    others = [p.grad for p in _parameters(optimisers) if id(p) not in known and p.grad is not None]
    norm = nn.utils.clip_grad_norm_(first, clip)
    if not guard.accept(loss.detach(), norm, *others, part=part):
        return None
    for optimiser in optimisers:
        optimiser.step()
    return norm


def _parameters(optimisers: Sequence[Optimizer]) -> list[nn.Parameter]:
    return [p for optimiser in optimisers for group in optimiser.param_groups for p in group["params"]]


class ProgressSchedule:
    """Learning rates as a function of the share of the budget that is spent."""

    def __init__(self, optimiser: Optimizer, factor: Callable[[float], float]) -> None:
        """Scale the optimiser's present rates by `factor(progress)`."""
        self._progress = 0.0
        self._scheduler = LambdaLR(optimiser, lambda _: factor(self._progress))

    def follow(self, progress: float) -> None:
        """Set the rates for the step to come; call it before a step, with the share in [0, 1] that is spent."""
        self._progress = min(max(progress, 0.0), 1.0)
        with warnings.catch_warnings():
            # Schedulers that count are called after a step; this one does not count.
            warnings.filterwarnings("ignore", "Detected call of `lr_scheduler.step")
            self._scheduler.step()


def warm_up_cosine(warm_up: float, last: float = 0.0) -> Callable[[float], float]:
    """Return a schedule that rises over a share `warm_up` of the budget and falls along a half cosine, to `last`."""

    def factor(progress: float) -> float:
        return _rise(progress, warm_up) * (last + (1.0 - last) * 0.5 * (1.0 + math.cos(math.pi * progress)))

    return factor


def warm_up_linear(warm_up: float, last: float) -> Callable[[float], float]:
    """Return a schedule that rises over a share `warm_up` of the budget and falls linearly, down to `last`."""

    def factor(progress: float) -> float:
        return _rise(progress, warm_up) * max(last, 1.0 - progress)

    return factor


def _rise(progress: float, warm_up: float) -> float:
    return min(1.0, progress / warm_up) if warm_up > 0 else 1.0


class MovingAverage(AveragedModel, Generic[ModuleT]):
    """An average of a module's weights, which is of the module's class."""

    module: ModuleT


def moving_average(module: ModuleT, decay: float, *, warm_up: bool = False) -> MovingAverage[ModuleT]:
    """Return an exponential moving average of a module's weights; `update_parameters` after every step.

    Args:
        module: Module to average.
        decay: Share of the average that a step leaves.
        warm_up: Let the decay of the n-th step be at most (1 + n) / (10 + n), so that early weights are soon forgotten.
    """

    def warming(average: Weights, current: Weights, steps: Tensor | int) -> None:
        n = int(steps) + 1
        get_ema_multi_avg_fn(min(decay, (1 + n) / (10 + n)))(average, current, steps)

    averaging = warming if warm_up else get_ema_multi_avg_fn(decay)
    average: MovingAverage[ModuleT] = MovingAverage(module, multi_avg_fn=averaging, use_buffers=False)
    return average.eval()
