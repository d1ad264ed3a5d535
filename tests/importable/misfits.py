"""Modules that cannot play: they raise errors, or answer by what their role does not have."""

import numpy as np

from mujoban_core.interfaces import Controller, Estimator, Planner, Termination


class Forgetful:
    """Remembers nothing."""

    def initial_memory(self, batch):
        return ()


class FailingController(Forgetful, Controller):
    """Fails in every tick."""

    def step(self, inputs, state):
        raise RuntimeError("no legs")


class FlatEstimator(Forgetful, Estimator):
    """Estimates no layers."""

    def step(self, inputs, state):
        return np.zeros((len(inputs.pose), 3), np.float32), state


class ManyHandedController(Forgetful, Controller):
    """Has more torques than the robot has motors."""

    def step(self, inputs, state):
        return np.zeros((len(inputs.instruction), 5), np.float32), state


class DoubtfulTermination(Forgetful, Termination):
    """Gives more probabilities than there are robots."""

    def probability(self, inputs, memory):
        return np.zeros((len(inputs.instruction), 3), np.float32), memory


class CarelessPlanner(Forgetful, Planner):
    """Forgets to return its memory."""

    def decide(self, abstract_state, memory):
        return np.ones(len(abstract_state), np.int64)
