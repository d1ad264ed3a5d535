"""Modules that cannot play."""

from mujoban_core.interfaces import Controller


class Forgetful:
    """Remembers nothing."""

    def initial_memory(self, batch):
        return ()


class FailingController(Forgetful, Controller):
    """Fails in every tick."""

    def step(self, inputs, state):
        raise RuntimeError("no legs")
