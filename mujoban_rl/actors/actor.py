"""An actor plays with a version of the learner's weights and hands over experience (paper C.5).

What goes between a learner and its actors, through pipes or over Ray, is these plain dataclasses of NumPy arrays; files
hold none of it but what a checkpoint writes as safetensors and JSON.
"""

from __future__ import annotations

import dataclasses
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from mujoban_rl.engine import State

Arrays = Mapping[str, NDArray[Any]]
"""Arrays by name."""


class ActorError(RuntimeError):
    """An actor raised an error, or dies again and again."""


@dataclass(frozen=True)
class ActorState:
    """Where an actor is, as it goes between processes: a copy of `Actor.state`."""

    values: dict[str, Any]
    arrays: Arrays

    @classmethod
    def of(cls, state: State) -> ActorState:
        """Copy a state, which may share its memory with an actor that plays on."""
        return cls(state.values, {name: tensor.cpu().numpy().copy() for name, tensor in state.tensors.items()})

    def to_state(self) -> State:
        """Return a copy for an actor to go on from; arrays that come over Ray may not be written to."""
        return State(self.values, {name: torch.tensor(array) for name, array in self.arrays.items()})


@dataclass(frozen=True)
class Experience:
    """One sequence of every environment of an actor, or whatever else an actor delivers at a time."""

    arrays: Arrays
    """What goes into the replay."""
    steps: int
    """Environment steps in it."""
    statistics: Arrays = field(default_factory=dict)
    """What happened, such as returns of the episodes that ended, [n] each with any n; their means and n are logged."""
    version: int = 0
    """Number of updates behind the weights with which it was played; pools fill it in, as well as the rest."""
    actor: int = 0
    """Number of the actor."""
    cpu_seconds: float = 0.0
    """CPU time of the actor's process since it last delivered."""
    left: ActorState | None = None
    """Where the actor is after it, for its pool alone, which asks for it."""


class Actor(ABC):
    """Plays with a policy; holds its environments, their randomness and a copy of the policy.

    Pools make actors with a picklable `ActorFactory`, in the process or the thread in which they act.
    """

    @abstractmethod
    def set_weights(self, weights: Mapping[str, Tensor], version: int) -> None:
        """Take over the learner's weights (`Learner.weights`), which have seen `version` updates."""

    @abstractmethod
    def act(self) -> Experience:
        """Play on from where the last call ended, and return what was seen; weights never change within a call."""

    def state(self) -> State:
        """Return all that changes but the weights, so that `restore` goes on to the bit.

        An actor without it cannot go on inside of its episodes: it plays other ones after a resumption.
        """
        return State()

    def restore(self, state: State) -> None:  # noqa: B027 - goes with the default of `state`
        """Take over what `state` returned."""

    def close(self) -> None:  # noqa: B027 - most actors hold nothing open
        """Free what the garbage collector does not, such as cameras."""


ActorFactory = Callable[[int], Actor]
"""Makes an actor that draws from random stream number n. No number comes twice in a run, not even for the actor that
takes the place of one that died. Must be picklable: a `functools.partial` of a function of a module with a
configuration, or an instance of a dataclass with `__call__`."""


@dataclass(frozen=True)
class Order:
    """What an actor is asked to play."""

    version: int
    weights: Arrays | None
    """None where the actor has this version already."""
    start: ActorState | None = None
    """Where to go on from; None where the actor stands there already."""
    report: bool = False
    """Whether the pool wants to know where the actor is afterwards."""


class Seat:
    """An actor at its work, wherever that is: fills in what a pool has to know of its experience."""

    def __init__(self, actor: Actor) -> None:
        """Seat an actor that has no weights yet."""
        self.actor = actor
        self._cpu = 0.0

    def play(self, order: Order) -> Experience:
        """Carry out an order."""
        if order.weights is not None:
            # A copy, since arrays that come over Ray may not be written to.
            weights = {name: torch.tensor(array) for name, array in order.weights.items()}
            self.actor.set_weights(weights, order.version)
        if order.start is not None:
            self.actor.restore(order.start.to_state())
        experience = self.actor.act()
        left = ActorState.of(self.actor.state()) if order.report else None
        spent, self._cpu = time.process_time() - self._cpu, time.process_time()
        return dataclasses.replace(experience, version=order.version, cpu_seconds=spent, left=left)
