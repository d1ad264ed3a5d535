"""The evaluations behind the paper's tables and figures, and where their JSON lies.

`python -m benchmarks.paper.runs` reruns them (hours on two cores), `--only NAME` one of them. It can be ended at any
time: the same command goes on where it stopped, and leaves out what has been measured with the weights that ship.
Rebuilding tables and figures from the JSON takes seconds: `make results`.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from mujoban_core.bodies import BALL
from mujoban_core.files import digest
from mujoban_core.plugins import AGENT, PRIVILEGED, ROLES, SCOUT, shipped_weights
from mujoban_core.program import read_options, run_command
from mujoban_sim.presets import DEFAULT_WORLD

ROOT: Final = Path(__file__).resolve().parents[2]
RESULTS: Final = ROOT / "docs" / "results"
JSON: Final = RESULTS / "json"
SEED: Final = 4_000_000
"""Seed of the first of the 512 levels that no training saw (paper C.5): test seeds."""
EPISODES: Final = 512
"""Levels of an evaluation (paper C.5)."""
DIGEST_LENGTH: Final = 64
"""Characters of a digest of weights; what is shorter names a class that stands in."""
TRAINED: Final = "trained"
"""In a report: digest of the weights that an agent which was given by its name had loaded by itself."""
EXPLORING: Final = "python -m mujoban_planner.train explorer --run runs/explorer"
"""Trains the scout that says where to look."""
SCOUT_FOLDER: Final = "docs/research/explorer"
"""Where its weights lie, which do not ship."""


class ResultError(ValueError):
    """A source of a table or figure is missing or not what its command writes."""


@dataclass(frozen=True)
class Run:
    """One evaluation of the stack and the paper's value for it."""

    name: str
    title: str
    difficulty: int = 5
    oracle: tuple[str, ...] = ()
    paper_success: float | None = None
    """Success rate in the paper's Table 1 or 2."""
    paper_reward: float | None = None
    agent: Path | None = None
    """Weights of an agent that plays in the place of the stack."""
    body: str = BALL.name
    world: str = DEFAULT_WORLD
    modules: tuple[tuple[str, Path], ...] = ()
    """Roles of modules, and weights other than those that ship which play them."""
    further: tuple[str, ...] = ()
    """Further options of `bringup/evaluate.py`."""
    trained: Path | None = None
    """Weights that an agent which is given by its name loads by itself."""
    training: str = ""
    """Command that trains the weights that do not ship; of agents, Table 1's page has it."""

    @property
    def file(self) -> Path:
        """Where the evaluation's JSON lies."""
        return JSON / f"{self.name}.json"

    @property
    def rerun(self) -> str:
        """The command that reruns the evaluation."""
        return f"python -m benchmarks.paper.runs --only {self.name}"

    def missing_weights(self) -> Path | None:
        """Return where weights that are trained apart from the stack's should be and are not."""
        apart = (*self.own.values(), *filter(None, [self.trained]))
        return next((path for path in apart if not path.is_file()), None)

    @property
    def own(self) -> dict[str, Path]:
        """Weights other than those that ship, by the role that they play."""
        return ({} if self.agent is None else {AGENT: self.agent}) | dict(self.modules)

    def options(self) -> list[str]:
        """Return the options of `bringup/evaluate.py` but for levels, seed and report."""
        oracle = ["--oracle", ",".join(self.oracle)] if self.oracle else []
        body = [] if self.body == BALL.name else ["--body", self.body]
        world = [] if self.world == DEFAULT_WORLD else ["--world", self.world]
        own = [text for role, path in self.own.items() for text in (f"--{role}", str(path))]
        return ["--difficulty", str(self.difficulty), *oracle, *body, *world, *own, *self.further]


SENSE: Final = ("estimator", "termination")
CONFIGURATIONS: Final = (
    Run("default", "default", paper_success=0.787, paper_reward=11.42),
    Run("planner_controller", "planner + controller only", oracle=SENSE, paper_success=0.818, paper_reward=11.83),
    Run("controller", "controller only", oracle=(*SENSE, "planner"), paper_success=0.943, paper_reward=13.33),
)
"""The rows of Table 2; the first is also Table 1's modular row."""
ALONE: Final = ("--look-ahead", "0")
"""The planner's policy without its search."""
POLICY_ALONE: Final = (
    replace(CONFIGURATIONS[0], name="default_alone", title="default, the planner's policy alone", further=ALONE),
    replace(
        CONFIGURATIONS[1], name="planner_controller_alone", title="planner + controller only, the policy alone",
        further=ALONE,
    ),
)  # fmt: skip
"""Without the search ahead, which the paper's planner does not have either, beside rows of Table 2."""
DIFFICULTY: Final = (
    *(Run(f"difficulty_{d}", f"difficulty {d}, the policy alone", d, further=ALONE) for d in range(1, 5)),
    POLICY_ALONE[0],
)
"""The points of Figure 2, difficulty 1 to 5, by the planner's policy alone."""
AHEAD: Final = (*(Run(f"default_{d}", f"difficulty {d}", d) for d in range(1, 5)), CONFIGURATIONS[0])
"""The same as by default, with its search ahead."""
GRAPH: Final = Run("graph", "default, through the ROS graph", further=("--graph",))
"""The headline row as users run it."""
LOOKING_AROUND: Final = (
    Run("look_around_none", "no looking around", further=("--look-around", "0")),
    CONFIGURATIONS[0],
    Run(
        "look_around_learned", "a learned scout", modules=((SCOUT, ROOT / SCOUT_FOLDER / "explorer.safetensors"),),
        training=EXPLORING,
    ),
)
"""What says where to look before pushing: nothing, the rule that ships, a network that does not ship."""
ALL: Final = (
    *CONFIGURATIONS, *POLICY_ALONE, *AHEAD[:-1], *DIFFICULTY[:-1], GRAPH,
    *(run for run in LOOKING_AROUND if run is not CONFIGURATIONS[0]),
)  # fmt: skip


def distinct(runs: Iterable[Run]) -> list[Run]:
    """Return evaluations without those that come twice: one row of Table 2 is a point of Figure 5, too."""
    return list({run.name: run for run in runs}.values())


def load(run: Run) -> dict[str, Any] | None:
    """Return the evaluation's JSON, or None when it has not been run.

    Raises:
        ResultError: If the file is no JSON or lacks a key.
    """
    if not run.file.exists():
        return None
    return read_source(
        run.file, ("success_rate", "success_interval", "mean_return", "failures", "episodes", "weights"), run.rerun
    )


def read_source(file: Path, keys: tuple[str, ...], rerun: str) -> dict[str, Any]:
    """Return a JSON object that has the given keys.

    Raises:
        ResultError: If it is no such object; `rerun` is the command that writes a new one.
    """
    try:
        content = json.loads(file.read_text())
    except json.JSONDecodeError as error:
        raise ResultError(f"{file}: no JSON ({error}); rerun {rerun}") from error
    missing = set(keys) - content.keys() if isinstance(content, dict) else set(keys)
    if missing:
        raise ResultError(f"{file}: lacks {', '.join(sorted(missing))}; rerun {rerun}")
    return content


def is_stale(report: dict[str, Any], run: Run | None = None) -> bool:
    """Tell whether what played in an evaluation, of a run, had other weights than are to play there now.

    What is to play and is not on this machine counts as what played: the weights of agents do not ship.
    """
    body, own = (None, {}) if run is None else (run.body, run.own)
    current = {role: shipped_weights(role, body) for role in ROLES} | own
    trained = None if run is None else run.trained
    if trained is not None and trained.is_file() and report.get(TRAINED) != digest(trained):
        return True
    told = {role: name.removesuffix(PRIVILEGED) for role, name in report["weights"].items() if role in current}
    return any(
        len(name) == DIGEST_LENGTH and current[role].is_file() and name != digest(current[role])
        for role, name in told.items()
    )


def is_current(run: Run, episodes: int) -> bool:
    """Tell whether the evaluation's JSON has so many levels and comes from the weights that ship now."""
    try:
        report = load(run)
    except ResultError:
        return False
    return report is not None and len(report["episodes"]) == episodes and not is_stale(report, run)


PROG: Final = "benchmarks.paper.runs"


@dataclass(frozen=True)
class Options:
    """Rerun the evaluations behind tables and figures."""

    only: tuple[str, ...] = ()
    """Names of the evaluations to rerun; all of them by default. `film_strip` is the episode of Figure 3,
    `film_strip_ant` one of the ant."""
    episodes: int = EPISODES
    """Levels of an evaluation (paper C.5: 512)."""
    processes: int = 2
    """Evaluations of different levels that run at the same time."""
    part: int = 128
    """Levels that one process plays; what is measured is kept when such a part has ended. At its end a few robots
    play on alone up to the time limit: the last eight of 64 took a quarter of the part's time."""
    again: bool = False
    """Rerun also what has been measured with the weights that ship now."""


def rerun(options: Options) -> None:
    """Rerun the evaluations."""
    # Imported here: both need the definitions above.
    from benchmarks.paper import baselines, bodies, film, parts

    every = distinct((*bodies.RUNS, *ALL, *baselines.RUNS))
    films = {kept.name: kept for kept in film.FILMS.values()}
    names = [*(run.name for run in every), *films]
    unknown = set(options.only) - set(names)
    if unknown:
        raise ValueError(f"--only {', '.join(sorted(unknown))}: expected some of {', '.join(names)}")
    JSON.mkdir(parents=True, exist_ok=True)
    chosen = options.only or tuple(names)
    for run in every:
        if run.name not in chosen:
            continue
        if (missing := run.missing_weights()) is not None:
            how = f": {run.training}" if run.training else ""
            print(f"{run.name}: no weights at {missing} yet{how}", flush=True)
            continue
        if is_current(run, options.episodes) and not options.again:
            print(f"{run.name}: measured already with these weights (--again measures anew)", flush=True)
            continue
        parts.evaluate(run, options)
    for name, kept in films.items():
        if name in chosen:
            film.record(kept)


def main(command_line: Sequence[str] | None = None) -> int:
    """Run the command."""
    rerun(read_options(Options, command_line, PROG, __doc__))
    return 0


if __name__ == "__main__":
    run_command(PROG, main)
