"""Play Mujoban: start the graph, show what it does, sum up (`python bringup/run_stack.py`)."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from bringup.command import (
    Parser,
    add_episode_options,
    add_module_options,
    add_recording_options,
    episodes_from,
    import_from_here,
    positive,
    recorded_seed,
    run_command,
    stack_from,
)

if TYPE_CHECKING:
    from rich.console import Console

    from bringup.stack import Outcome

PROG = "run_stack.py"


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    parser = Parser(PROG, description="Play Mujoban through the ROS graph; without options, one hard episode.")
    add_episode_options(parser)
    add_module_options(parser)
    parser.add_argument(
        "--realtime", nargs="?", type=_speed, const=1.0, default=0.0, metavar="SPEED",
        help="pace the world by the clock, SPEED (1) times as fast as reality, instead of in lockstep",
    )  # fmt: skip
    parser.add_argument("--processes", action="store_true", help="run each node in a process of its own")
    parser.add_argument("--headless", action="store_true", help="show no live view")
    parser.add_argument("--record", type=Path, metavar="DIR", help="record all topics into a bag")
    add_recording_options(parser)
    parser.add_argument("--episodes-per-file", type=positive, default=32, metavar="N", help="of the bag")
    parser.add_argument("--video", type=Path, metavar="FILE", help="write an .mp4 of the robot's view and from above")
    parser.add_argument("--view", action="store_true", help="serve a live view (Rerun) to the browser")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the report there")
    return parser.parse_args(arguments)


def _speed(text: str) -> float:
    speed = float(text)
    if not (0 < speed < float("inf")):
        raise argparse.ArgumentTypeError(f"{text} is no speed: expected a number above 0")
    return speed


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    options = parse(arguments)
    import_from_here()
    options.seed = recorded_seed(
        options.seed, records=options.record is not None, allow_test_seeds=options.allow_test_seeds
    )
    episodes, stack = episodes_from(options), stack_from(options)

    from rich.console import Console

    from bringup.results import report, write_report
    from bringup.stack import PlayOptions, play
    from bringup.view import on_terminal

    weights = stack.identities()
    console = Console()
    play_options = PlayOptions(
        world=options.world,
        realtime=options.realtime,
        time_limit=options.time_limit,
        processes=options.processes,
        record=options.record,
        episodes_per_file=options.episodes_per_file,
        video=options.video,
        view=options.view,
    )
    with nullcontext() if options.headless else on_terminal(console, weights) as on_refresh:
        outcome = play(stack, episodes, play_options, on_refresh=on_refresh)
    content = report(
        outcome.results,
        weights,
        body=options.body,
        world=options.world,
        ticks_per_second=outcome.ticks_per_second,
        counts=dict(outcome.counts),
    )
    _sum_up(console, outcome, weights, content["success_interval"])
    if options.json is not None:
        write_report(content, options.json)
    return 0


def _sum_up(console: Console, outcome: Outcome, weights: Mapping[str, str], interval: Sequence[float]) -> None:
    from bringup.view import summary
    from mujoban_core.plugins import is_privileged

    console.print(summary(outcome.results))
    solved, total = sum(r.solved for r in outcome.results), len(outcome.results)
    low, high = (100 * bound for bound in interval)
    console.print(
        f"solved {solved} of {total} ({100 * solved / total:.1f} %, 95 % interval {low:.1f} to {high:.1f} %), "
        f"{outcome.ticks_per_second:.0f} ticks/s"
    )
    told = [f"{role}: {identity}" for role, identity in weights.items() if is_privileged(identity)]
    if told:
        console.print(f"privileged, told the ground truth: {', '.join(told)}")
    for event, count in sorted(outcome.counts.items()):
        console.print(f"{event}: {count}")


if __name__ == "__main__":
    run_command(PROG, main)
