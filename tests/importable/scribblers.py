"""Modules that write into what they are given, and modules that note what they are given."""

from mujoban_core.plugins import load_module

SEEN = []
"""What `Noting` was given, tick by tick."""


class Scribbling(type(load_module("estimator", "oracle"))):
    """An estimator that works in place, as a user's may."""

    def step(self, inputs, state):
        estimate, state = super().step(inputs, state)
        estimate = estimate.copy()
        for array in (inputs.frame, inputs.pose, *inputs.truth):
            if array is not None:
                array.fill(1)
        return estimate, state


class Noting(type(load_module("controller", "oracle"))):
    """A controller that notes what it is given."""

    def step(self, inputs, state):
        SEEN.append([array.tolist() for array in (inputs.frame, inputs.proprio, *inputs.truth[:5])])
        return super().step(inputs, state)
