"""A small problem for actors, in a module that worker processes can import."""

import os
import signal
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn

from mujoban_rl.actors import Actor, Experience
from mujoban_rl.engine import Learner, State
from mujoban_rl.optimise import guarded_step

TICKS, ROWS = 4, 2


@dataclass(frozen=True)
class Walkers:
    """Makes actors; those of the named streams misbehave."""

    fails_in: tuple[int, ...] = ()
    dies_in: tuple[int, ...] = ()

    def __call__(self, stream):
        return Walker(self, stream)


class Walker(Actor):
    """Random walks that weights push; what is seen depends on the weights, on randomness and on the state."""

    def __init__(self, config, stream):
        self.config, self.stream = config, stream
        self.rng = np.random.default_rng([3, stream])
        self.place = np.zeros(ROWS)
        self.push = np.nan

    def set_weights(self, weights, version):
        self.push = float(weights["weight"].mean())

    def act(self):
        if self.stream in self.config.fails_in:
            raise ArithmeticError(f"stream {self.stream} is broken")
        if self.stream in self.config.dies_in:
            os.kill(os.getpid(), signal.SIGKILL)
        places = self.place + np.cumsum(self.rng.normal(size=(TICKS, ROWS)) + self.push, 0)
        self.place = places[-1]
        origin = np.array([self.stream, os.getpid()])
        arrays = {"place": places.astype(np.float32), "origin": origin}
        return Experience(arrays, TICKS * ROWS, {"return": self.place.copy(), "never": np.zeros(0)})

    def state(self):
        return State({"rng": self.rng.bit_generator.state}, {"place": torch.from_numpy(self.place)})

    def restore(self, state):
        self.rng.bit_generator.state = state.values["rng"]
        self.place = state.tensors["place"].numpy().copy()


class LastFew:
    """The last few sequences of all actors."""

    def __init__(self):
        self.origins, self.versions = [], []
        self.kept = []

    def add(self, experience):
        self.origins.append(experience.arrays["origin"].tolist())
        self.versions.append(experience.version)
        self.kept = [*self.kept, torch.tensor(experience.arrays["place"])][-3:]

    def sample(self):
        return torch.cat(self.kept).flatten()[:, None]

    def state(self):
        return State({"count": len(self.kept)}, {str(i): values for i, values in enumerate(self.kept)})

    def restore(self, state):
        self.kept = [state.tensors[str(i)] for i in range(state.values["count"])]


class Centre(Learner):
    """Learns a push that keeps walks where they are."""

    def __init__(self):
        self.net = nn.Linear(1, 1, bias=False)
        nn.init.constant_(self.net.weight, 0.5)
        self.adam = torch.optim.Adam(self.net.parameters(), 0.05)

    @property
    def modules(self):
        return {"net": self.net}

    @property
    def optimisers(self):
        return {"adam": self.adam}

    def weights(self):
        return {"weight": self.net.weight}

    def update(self, batch, progress, guard):
        loss = (batch.mean() * self.net.weight).square().sum() + 0.01 * self.net(batch).square().mean()
        guarded_step(loss, [self.adam], guard)
        return {"loss": float(loss.detach())}


def die_once(mark):
    """Kill the process where the file `mark` is missing, which is made then; return the process's id otherwise."""
    if not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return os.getpid()
