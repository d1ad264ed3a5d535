"""Play Mujoban: start the graph, show what it does, sum up (`python bringup/run_stack.py`)."""

from __future__ import annotations

if __name__ == "__main__":
    from mujoban_core.early import end_at_once

    end_at_once()

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, NoReturn

from tyro.conf import arg

from bringup.command import forget_command_line, import_from_here, recorded_seeds
from bringup.options import INTERFACE, SPEED, Count, EpisodeOptions, FilePath, FolderPath, PlayerOptions
from mujoban_core.files import check_file, check_folder
from mujoban_core.program import called, read_options, run_command

if TYPE_CHECKING:
    from bringup.monitor import MonitorNode
    from bringup.results import EpisodeResult

PROG = "run_stack.py"


@dataclass(frozen=True)
class Options:
    """Play Mujoban through the ROS graph; without options, one hard episode."""

    play: Annotated[EpisodeOptions, arg(name="")] = field(default_factory=EpisodeOptions)
    modules: Annotated[PlayerOptions, arg(name="")] = field(default_factory=PlayerOptions)
    realtime: Annotated[float, SPEED] = 0.0
    """Pace the world by the clock, SPEED (1) times as fast as reality, instead of in lockstep."""
    processes: bool = False
    """Run each node in a process of its own."""
    intra_process: bool = True
    """Messages are handed over within the process while nobody outside reads their topic; with --no-intra-process the
    middleware sends them all."""
    headless: bool = False
    """Show in the terminal only how many episodes have ended, not what goes on."""
    record: FolderPath = None
    """Record all topics into a bag."""
    allow_test_seeds: bool = False
    """Record also levels that are not for training."""
    episodes_per_file: Count = 32
    """Episodes in one file of the bag."""
    video: FilePath = None
    """Write an .mp4 of the robot's view and from above."""
    view: Annotated[str | None, INTERFACE] = None
    """Serve a live view (Rerun) to the browser, on this machine alone or on the interface with this IP address
    (0.0.0.0: all)."""

    json: FilePath = None
    """Write the report there."""


def main(command_line: Sequence[str] | None = None) -> int:
    """Run the command."""
    options = read_options(Options, command_line, called(PROG))
    forget_command_line(command_line)
    play, stack = options.play, options.modules.player(options.play.body)
    import_from_here()
    seeds = None
    if options.record is not None:
        noted = options.json is not None or play.levels is not None
        seeds = recorded_seeds(play.seed, allow_test_seeds=options.allow_test_seeds, noted=noted)
    check_folder("--record", options.record)
    check_file("--video", options.video)
    check_file("--json", options.json)
    episodes = play.make(play.seed, seeds)

    from bringup.reporting import Reporting, played
    from bringup.stack import PlayOptions
    from bringup.stack import play as play_graph
    from bringup.view import summary

    how = PlayOptions(
        world=play.world,
        realtime=options.realtime,
        time_limit=play.time_limit,
        processes=options.processes,
        intra_process=options.intra_process,
        record=options.record,
        episodes_per_file=options.episodes_per_file,
        video=options.video,
        view=options.view,
    )
    weights = stack.identities()
    game = played(stack, episodes, play, route="graph", realtime=options.realtime)
    reporting = Reporting(options.json, weights, episodes, game)
    with reporting, _shown(len(episodes), None if options.headless else weights) as show:

        def on_refresh(monitor: MonitorNode, results: Sequence[EpisodeResult]) -> None:
            reporting.results = results
            show(monitor, results)

        outcome = play_graph(stack, episodes, how, on_refresh=on_refresh, on_break=reporting.note)
    table = None if options.headless else summary(outcome.results)
    reporting.finish(outcome.results, above=table, **outcome.figures())
    return 0


@contextmanager
def _shown(
    episodes: int, weights: Mapping[str, str] | None
) -> Iterator[Callable[[MonitorNode, Sequence[EpisodeResult]], None]]:
    """Return what shows how the run goes: the latest tick, played with these weights; None: a line of progress."""
    if weights is None:
        from bringup.progress import SolvedBar

        with SolvedBar(episodes) as bar:
            yield lambda _, results: bar.show(results)
    else:
        from rich.console import Console

        from bringup.view import on_terminal

        with on_terminal(Console(), weights) as show:
            yield show


def run() -> NoReturn:
    """Run the command and end the process."""
    run_command(PROG, main)


if __name__ == "__main__":
    run()
