"""Read a recorded bag tick by tick, without ROS: `python examples/replay_a_bag.py BAG`.

Needs no more than Mujoban itself, and a bag: run `bringup/run_stack.py --record BAG` or `bringup/record.py --out BAG`
first. (`ros2 bag play BAG` plays one back as topics.) Its torques are applied again to the level, body and world that
it names. For each episode are printed its seed, its ticks, and how far the robot ever is from where it was recorded:
0.0e+00, the same to the last bit, if the world has room for as many boxes as the one that was recorded, which older
bags do not say.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from mujoban_core.bodies import BALL
from mujoban_core.program import exit_status, read_options
from mujoban_msgs_py import topics
from mujoban_msgs_py.bags import Bag
from mujoban_msgs_py.bags.training import episodes, find_bags, open_training_bag
from mujoban_sim.presets import DEFAULT_WORLD
from mujoban_sim.world import World
from mujoban_sokoban.episodes import EpisodeSpec
from mujoban_sokoban.levels import Level

TOPICS = (topics.TRUE_EPISODE, topics.POSE, topics.TORQUE)


@dataclass(frozen=True)
class Options:
    """Play every episode of a bag again and say how far the robot is from where it was recorded."""

    bag: Annotated[Path, tyro.conf.Positional]
    """What was recorded: a bag, or a folder of bags, such as record.py writes."""


def replay(bag: Bag) -> None:
    """Play every episode of a bag again."""
    body, name = bag.about.get("body", BALL.name), bag.about.get("world", DEFAULT_WORLD)
    for ticks in episodes(bag, TOPICS, allow_test_seeds=True):  # nothing is learned from them
        spec = EpisodeSpec(Level.from_text(ticks[0][0].level), ticks[0][0].seed)
        boxes = int(bag.about.get("max_boxes", len(spec.level.boxes)))
        # An episode may have been recorded with more time than the body's, after which a world stands still.
        world = World(1, body=body, world=name, max_boxes=boxes, time_limit=len(ticks))
        world.reset([0], [spec])
        apart = 0.0
        for _, pose, torque in ticks:
            apart = max(apart, float(np.abs(world.pose[0] - pose).max()))
            world.step(torque[None])
        print(f"seed {spec.seed}: {len(ticks)} ticks, at most {apart:.1e} apart")


def main(arguments: Sequence[str]) -> int:
    """Run the example."""
    for path in find_bags([read_options(Options, arguments, "replay_a_bag.py", __doc__).bag]):
        replay(open_training_bag(path, TOPICS))
    return 0


if __name__ == "__main__":
    sys.exit(exit_status("replay_a_bag.py", lambda: main(sys.argv[1:])))
