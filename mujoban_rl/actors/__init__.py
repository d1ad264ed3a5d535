"""Actors and the learner's view of them: one learner, N actors, in one process or on many machines (paper C.5).

A trainer needs two classes of its own: an `Actor` with a picklable factory, and an `ExperienceStore`::

    pool = options.actors.pool(partial(MyActor, config))
    source = ActorSource(pool, MyStore(config), steps_per_update=96)
    Trainer(directory, MyLearner(config), source, budget).run()
"""

from mujoban_rl.actors.actor import Actor, ActorError, ActorFactory, Arrays, Experience
from mujoban_rl.actors.options import ActorOptions
from mujoban_rl.actors.pool import ActorPool, Schedule
from mujoban_rl.actors.source import ActorSource, ExperienceStore, ReplayStore, Rollouts, learner_generators

__all__ = [
    "Actor",
    "ActorError",
    "ActorFactory",
    "ActorOptions",
    "ActorPool",
    "ActorSource",
    "Arrays",
    "Experience",
    "ExperienceStore",
    "ReplayStore",
    "Rollouts",
    "Schedule",
    "learner_generators",
]
