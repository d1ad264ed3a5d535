"""Evaluate the stack, or an agent, on many levels in one vectorised rollout: `python bringup/evaluate.py`.

With `--graph` the same episodes run through the ROS graph, one after the other; with `--cluster` they are shared out
over the machines of a Ray cluster.
"""

from __future__ import annotations

if __name__ == "__main__":
    from mujoban_core.early import end_at_once

    end_at_once()

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Any, Final, NoReturn

from tyro.conf import arg

from bringup.command import Player, forget_command_line, import_from_here
from bringup.options import HERE, ClusterOptions, Count, EpisodeOptions, FilePath, PlayerOptions
from mujoban_core.bodies import BALL
from mujoban_core.files import check_file
from mujoban_core.program import called, read_options, run_command
from mujoban_core.threads import set_threads
from mujoban_sim.presets import DEFAULT_WORLD

if TYPE_CHECKING:
    from bringup.cluster import EveryNth
    from bringup.reporting import Reporting
    from bringup.results import EpisodeResult
    from bringup.rollout import Policy
    from mujoban_sokoban.episodes import Episodes

PROG = "evaluate.py"
_EPISODES: Final = 256
"""Generated levels that are played where no number is said."""


@dataclass(frozen=True)
class Options:
    """Evaluate the stack on many levels in one vectorised rollout; by default on levels for validation."""

    play: Annotated[EpisodeOptions, arg(name="")] = field(default_factory=EpisodeOptions)
    modules: Annotated[PlayerOptions, arg(name="")] = field(default_factory=PlayerOptions)
    batch: Count = 64
    """Episodes that run at the same time."""
    shared: Annotated[ClusterOptions, arg(name="")] = field(default_factory=ClusterOptions)
    first_number: Count = 1
    """Number of the first episode, where these are a part of a longer run: what modules draw at random follows from it,
    and would else be the same in every part."""
    graph: bool = False
    """Play through the ROS graph instead."""
    json: FilePath = None
    """Write the report there."""

    def __post_init__(self) -> None:
        """Reject what contradicts itself."""
        if self.graph and self.shared.cluster:
            raise ValueError("--graph --cluster: expected one of the two, since the graph plays on this machine")
        if self.graph and self.first_number != 1:
            raise ValueError(f"--first-number {self.first_number}: expected 1 with --graph, which counts from there")


def evaluate(
    policy: Policy,
    episodes: Episodes | EveryNth,
    *,
    body: str = BALL.name,
    world: str = DEFAULT_WORLD,
    batch: int = 64,
    time_limit: int | None = None,
    threads: int = 1,
    on_result: Callable[[int, EpisodeResult], None] | None = None,
) -> list[EpisodeResult]:
    """Play the episodes in one batched world and return their outcomes.

    Args:
        policy: The four modules, or an agent.
        episodes: Levels and seeds.
        body: The robot's body.
        world: The physical world, see `mujoban_sim.presets`.
        batch: Rows of the world.
        time_limit: Steps of an episode; None means that of the body.
        threads: Threads of the physics.
        on_result: Called with the index of an episode and its outcome as soon as it has ended.
    """
    from bringup.rollout import rollout
    from mujoban_sim.world import World

    robots = World(
        min(batch, len(episodes)),
        body=body,
        world=world,
        max_boxes=episodes.max_boxes,
        time_limit=time_limit,
        threads=threads,
    )
    return rollout(policy, robots, episodes, on_result=on_result)


def main(command_line: Sequence[str] | None = None) -> int:
    """Run the command."""
    options = read_options(Options, command_line, called(PROG), __doc__)
    forget_command_line(command_line)
    check_file("--json", options.json)
    import_from_here()
    from bringup.reporting import Reporting, played
    from mujoban_sokoban.generator import VALIDATION_SEEDS

    if options.play.episodes is None and options.play.levels is None:
        options = replace(options, play=replace(options.play, episodes=_EPISODES))
    play = options.play
    episodes = play.make(play.seed, VALIDATION_SEEDS)
    episodes.first_number = options.first_number
    stack = options.modules.player(play.body)
    set_threads(stack.threads)
    route, batch = ("graph", None) if options.graph else ("in process", options.batch)
    game = played(stack, episodes, play, route=route, batch=batch)
    reporting = Reporting(options.json, stack.identities(), episodes, game)
    with reporting:
        results, extra = _play(options, stack, episodes, reporting)
    reporting.finish(results, **extra)
    return 0


def _play(
    options: Options, stack: Player, episodes: Episodes, reporting: Reporting
) -> tuple[Sequence[EpisodeResult], dict[str, Any]]:
    """Play the episodes and return their outcomes, with further entries of the report."""
    from bringup.progress import SolvedBar

    play = options.play
    policy = None if options.graph or options.shared.cluster else stack.policy()
    with SolvedBar(len(episodes)) as bar:

        def show(results: Sequence[EpisodeResult]) -> None:
            reporting.results = results
            bar.show(results)

        if options.graph:
            from bringup.stack import PlayOptions
            from bringup.stack import play as play_graph

            # A result through the graph is one of messages that were sent.
            how = PlayOptions(world=play.world, time_limit=play.time_limit, intra_process=False)
            outcome = play_graph(
                stack, episodes, how, on_refresh=lambda _, ended: show(ended), refresh_period=1.0,
                on_break=reporting.note,
            )  # fmt: skip
            return outcome.results, outcome.figures()
        if policy is None:
            from bringup.cluster import evaluate_on_cluster

            return evaluate_on_cluster(
                stack, episodes, options.shared.cluster or HERE, num_actors=options.shared.num_actors,
                body=play.body, world=play.world, batch=options.batch, time_limit=play.time_limit, on_results=show,
            ), {}  # fmt: skip
        ended: list[EpisodeResult] = []
        show(ended)

        def on_result(_: int, result: EpisodeResult) -> None:
            ended.append(result)
            show(ended)

        return evaluate(
            policy, episodes, body=play.body, world=play.world, batch=options.batch,
            time_limit=play.time_limit, threads=stack.threads, on_result=on_result,
        ), {}  # fmt: skip


def run() -> NoReturn:
    """Run the command and end the process."""
    run_command(PROG, main)


if __name__ == "__main__":
    run()
