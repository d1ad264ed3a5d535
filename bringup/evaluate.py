"""Evaluate the stack on many levels in one vectorised rollout: `python bringup/evaluate.py`.

With `--graph` the same episodes run through the ROS graph, one after the other; with `--cluster` they are shared out
over the machines of a Ray cluster.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from bringup.cluster import EveryNth, add_cluster_options, evaluate_on_cluster
from bringup.command import (
    Parser,
    add_episode_options,
    add_module_options,
    episodes_from,
    import_from_here,
    positive,
    run_command,
    stack_from,
)
from bringup.results import EpisodeResult, report, use_of_test_levels, write_report
from bringup.rollout import rollout
from mujoban_core.bodies import BALL
from mujoban_core.sense_plan_act import SensePlanAct
from mujoban_core.threads import set_threads
from mujoban_sim.presets import DEFAULT_WORLD
from mujoban_sim.world import World
from mujoban_sokoban.episodes import Episodes
from mujoban_sokoban.generator import VALIDATION_SEEDS, seed_range

PROG = "evaluate.py"


class SolvedBar(Progress):
    """How many episodes have ended, and how many of these were solved: a bar on stderr, or lines without a terminal."""

    def __init__(self, total: int, *, disable: bool = False) -> None:
        """Count to `total` episodes."""
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        super().__init__(*columns, console=Console(stderr=True), disable=disable)
        self._task = self.add_task("solved", total=total)
        self._total, self._printed = total, 0

    def show(self, results: Sequence[EpisodeResult]) -> None:
        """Show the outcomes so far."""
        if results:
            share = sum(result.solved for result in results) / len(results)
            solved = f"solved {100 * share:4.1f} %"
            self.update(self._task, completed=len(results), description=solved)
            self._print(len(results), solved)

    def _print(self, ended: int, solved: str) -> None:
        """Print a line whenever another tenth has ended, in a log, which shows a bar only when it is full."""
        if self.disable or self.console.is_terminal or 10 * (ended - self._printed) < self._total:
            return
        self._printed = ended
        self.console.print(f"{ended} of {self._total} episodes, {solved}")


def evaluate(
    policy: SensePlanAct,
    episodes: Episodes | EveryNth,
    *,
    body: str = BALL.name,
    world: str = DEFAULT_WORLD,
    batch: int = 64,
    time_limit: int | None = None,
    threads: int = 1,
    progress: bool = False,
) -> list[EpisodeResult]:
    """Play the episodes in one batched world and return their outcomes.

    Args:
        policy: The four modules.
        episodes: Levels and seeds.
        body: The robot's body.
        world: The physical world, see `mujoban_sim.presets`.
        batch: Rows of the world.
        time_limit: Steps of an episode; None means that of the body.
        threads: Threads of the physics.
        progress: Whether to show a progress bar on stderr.
    """
    robots = World(
        min(batch, len(episodes)),
        body=body,
        world=world,
        max_boxes=episodes.max_boxes,
        time_limit=time_limit,
        threads=threads,
    )
    with SolvedBar(len(episodes), disable=not progress) as bar:
        ended: list[EpisodeResult] = []

        def on_result(_: int, result: EpisodeResult) -> None:
            ended.append(result)
            bar.show(ended)

        return rollout(policy, robots, episodes, on_result=on_result)


def main(command_line: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = Parser(PROG, description="Evaluate the stack on many levels in one vectorised rollout.")
    add_episode_options(parser, episodes=256, seed=VALIDATION_SEEDS.start)
    add_module_options(parser)
    parser.add_argument("--batch", type=positive, default=64, help="episodes that run at the same time")
    add_cluster_options(parser)
    parser.add_argument("--graph", action="store_true", help="play through the ROS graph instead")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the report there instead of printing it")
    arguments = parser.parse_args(command_line)
    if arguments.graph and arguments.cluster:
        parser.error("--graph --cluster: expected one of the two, since the graph plays on this machine")
    import_from_here()
    episodes, stack = episodes_from(arguments), stack_from(arguments)
    from mujoban_rl.weights import provenance

    set_threads(arguments.threads)
    if arguments.graph:
        from bringup.stack import PlayOptions, play

        options = PlayOptions(world=arguments.world, time_limit=arguments.time_limit)
        with SolvedBar(len(episodes)) as bar:
            outcome = play(
                stack, episodes, options, on_refresh=lambda _, results: bar.show(results), refresh_period=1.0
            )
        content = report(
            outcome.results,
            stack.identities(),
            body=arguments.body,
            world=arguments.world,
            ticks_per_second=outcome.ticks_per_second,
        )
    elif arguments.cluster:
        with SolvedBar(len(episodes)) as bar:
            results = evaluate_on_cluster(
                stack, episodes, arguments.cluster, num_actors=arguments.num_actors, body=arguments.body,
                world=arguments.world, batch=arguments.batch, time_limit=arguments.time_limit, on_results=bar.show,
            )  # fmt: skip
        content = report(results, stack.identities(), body=arguments.body, world=arguments.world)
    else:
        results = evaluate(
            stack.policy(),
            episodes,
            body=arguments.body,
            world=arguments.world,
            batch=arguments.batch,
            time_limit=arguments.time_limit,
            threads=arguments.threads,
            progress=True,
        )
        content = report(results, stack.identities(), body=arguments.body, world=arguments.world)
    if arguments.levels is None and seed_range(arguments.seed, len(episodes)) == "test":
        content["test_uses"] = [use_of_test_levels(content, provenance()["commit"])]
    if arguments.json is None:
        print(json.dumps(content, indent=2))
    else:
        write_report(content, arguments.json)
    return 0


if __name__ == "__main__":
    run_command(PROG, main)
