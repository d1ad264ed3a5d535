"""A room with two boxes, and how tests drive worlds."""

import numpy as np

from mujoban_sim.world import World
from mujoban_sokoban.episodes import EpisodeSpec
from mujoban_sokoban.levels import Level

ROOM = Level.from_text("""\
##########
#        #
#        #
#  @$ .  #
#        #
#   $  . #
#        #
#        #
#        #
##########
""")
START, FIRST, SECOND = (3, 3), (3, 4), (5, 4)
TARGETS = (3, 6), (5, 7)


def room_world(**options):
    world = World(1, max_boxes=2, **options)
    world.reset([0], [EpisodeSpec(ROOM, 7)])
    return world


def put(world, robot, *boxes, heading=0.0):
    world.place([0], [[*robot, heading]], [list(boxes)])


def rest(world, steps=1):
    for _ in range(steps):
        world.step(np.zeros((world.batch, 2), np.float32))


def random_run(world, steps, seed):
    rng = np.random.default_rng(seed)
    trace = []
    for _ in range(steps):
        world.step(rng.uniform(-1, 1, (world.batch, 2)).astype(np.float32))
        trace.append(np.concatenate([world.qpos.copy(), world.proprio, world.reward[:, None]], 1))
    return np.array(trace)
