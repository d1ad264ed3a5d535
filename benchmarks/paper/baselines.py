"""The other rows of Table 1 and curves of Figure 2: agents without modules, from the runs that trained them.

    python -m benchmarks.paper.baselines mpo_easy=runs/baselines/mpo_easy ...     # note what a run cost, and its curve
    python -m benchmarks.paper.runs --only mpo_easy_1 mpo_easy_5                  # evaluate its weights

The first writes `baseline_<name>.jsonl`, an object a line with `step`, `cpu_seconds`, `seconds` of wall-clock, and
`solved` and `return` of the episodes that were played in training and their number, `episodes`, by difficulty. What
ended before each robot had played for the longest episode says nothing of the others, and is left out.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import tyro

from benchmarks.paper import runs as sources
from benchmarks.paper.curves import read_metrics
from benchmarks.paper.runs import ROOT, ResultError, Run
from bringup.training_report import cost
from mujoban_baselines.task import TaskConfig
from mujoban_core.files import write_atomically
from mujoban_core.grid import DIFFICULTIES
from mujoban_core.plugins import PRIVILEGED, ROLES
from mujoban_core.program import read_options, run_command
from mujoban_core.stats import wilson_interval
from mujoban_rl.metrics import mean_of
from mujoban_sim.presets import DEFAULT_WORLD

PROG: Final = "benchmarks.paper.baselines"
_MOST: Final = 20
"""Points of a curve, each of which is to be the mean of many episodes; more are averaged."""
KINDS: Final = ("solved", "return")
"""What a curve tells of the episodes of each difficulty, in the mean."""
_EPISODES: Final = "episodes"
_ENOUGH: Final = 20
"""Episodes of which a point of a drawn curve is the mean, at least."""
ORIGINS: Final = "origins"
"""In the last point of a row that began with weights of modules: the digest of each, by its role."""
_REFUSED: Final = 0.01
"""Share of a run's updates that may be refused; one that lost more has not had the row's budget."""


HOURS: Final = 1.0
"""Of wall-clock on two cores that every row may take, the modular stack's as well."""
_STEPS: Final = round(1_250_000 * HOURS)
"""Environment steps of every row until those of the modular one are known: an hour's share of what two hours took."""
_CLONED: Final = 1 / 3
"""Share of a row's budget that its cloning takes, where it learns by itself after that."""
_START: Final = "_start"
"""Ends the run directory of such a cloning."""
_WHOLE: Final = "bringup.train_all"
"""Trains the whole stack, within hours."""
RECORDING: Final = (
    "python bringup/record.py --out bags/stack --undisturbed --advanced 0 --time-limit 0 --episodes 512"
)
"""Records what is cloned: whole episodes, since hardly one of difficulty 5 ends within the default's 30 s; without
`--undisturbed` the disturbances would be cloned too."""


@dataclass(frozen=True)
class Baseline:
    """A row of Table 1."""

    name: str
    title: str
    sees: str
    levels: str
    """What it is trained on."""
    method: str
    """Arguments of the program that trains it, but for budget and run directory."""
    paper: str
    """How long the paper trained it, with how many actors."""
    roles: tuple[str, ...] = ()
    """Modules that it leaves, in the place of an agent; they play with those that ship, without a search ahead."""
    program: str = "mujoban_baselines.train"
    """Trains it; empty: it plays without having been trained."""
    cloning: str = ""
    """Arguments of a cloning of whose weights it begins, which takes `_CLONED` of its budget."""
    weights: str = ""
    """Folder of its run that holds the weights."""
    seed: int = 0
    """Of the run; with another one, the same is trained once more."""
    agent: str = ""
    """Name of the agent that plays, where it is not the weights of its run that do."""
    guide: str = ""
    """Page that says how it is trained, seen from that of the results."""

    @property
    def label(self) -> str:
        """What a legend says of it."""
        return f"{self.title} ({self.levels})"

    @property
    def folder(self) -> Path:
        """Where its run is expected."""
        return ROOT / "runs" / "baselines" / self.name

    @property
    def commands(self) -> tuple[str, ...]:
        """The commands that train it, one after the other."""
        if not self.program:
            return ()
        run = f"runs/baselines/{self.name}"
        if self.program == _WHOLE:
            return (f"python -m {self.program} {self.method} --hours {HOURS:g} --run {run}",)
        if not self.cloning:
            return (self._trains(self.method, 1.0, run),)
        start = f"{self.method} --start {run}{_START}/agent.safetensors"
        return self._trains(self.cloning, _CLONED, run + _START), self._trains(start, 1.0 - _CLONED, run)

    def _trains(self, method: str, share: float, run: str) -> str:
        """Return the command of a training with a share of the budget, whichever part of which is spent first."""
        seed = f" --seed {self.seed}" if self.seed else ""
        # The learner and the robots each have a core, as the stages of the modular row have both.
        actors = "" if method.startswith("clone") else " --actors processes --num-actors 1"
        budget = f"--steps {steps() * share:.0f} --cpu-seconds {2 * 3600 * HOURS * share:.0f}"
        return " ".join(f"python -m {self.program} {method}{seed} {budget}{actors} --run {run}".split())

    def again(self, seed: int) -> Baseline:
        """Return the same row with another seed."""
        return replace(self, name=f"{self.name}_seed{seed}", title=f"{self.title}, seed {seed}", seed=seed)

    @property
    def curve(self) -> Path:
        """Where its learning curve lies."""
        return sources.JSON / f"baseline_{self.name}.jsonl"

    def run(self, difficulty: int) -> Run:
        """Return its evaluation at a difficulty."""
        run = Run(f"{self.name}_{difficulty}", self.title, difficulty)
        folder = self.folder / self.weights
        if self.agent:
            trained = folder / "agent.safetensors" if self.program else None
            return replace(run, further=("--agent", self.agent), trained=trained)
        if not self.roles:
            return replace(run, agent=folder / "agent.safetensors")
        modules = tuple((role, folder / f"{role}.safetensors") for role in self.roles)
        return replace(run, modules=modules, further=sources.ALONE)


def steps() -> int:
    """Return the environment steps of every row: those that the modular one took, once that is measured.

    Raises:
        ResultError: If its file is not what this program writes.
    """
    measured = points_of(MODULAR)
    return measured[-1]["step"] if measured else _STEPS


_ROBOT, _ABOVE = "o_cam, o_pr, o_pos", "o_top, o_pr"
_PARTIAL, _FULL, _NOT = "5 days, 256 actors", "21 days, 1,000 actors", "not there"
_MPO: Final = "monolithic-mpo --repeat 4 --mpo.reuse 4 --draws pink"
"""What solves most of difficulty 1 (docs/research/baselines.md); what goes on from a clone acts as that does."""
_VTRACE: Final = (
    "--repeat 4 --draws pink --vtrace.exploration pink --vtrace.rate 1e-3 --vtrace.loss.entropy-weight 1e-5"
)
"""The same for V-trace, whose own noise is white, and whose bonus for entropy outweighs so rare rewards."""
MODULAR: Final = Baseline(
    "modular", "modular", _ROBOT, "all difficulties, bottom-up", f"--world {DEFAULT_WORLD}",
    "7 days, 200 to 1,000 actors a module", tuple(ROLES), _WHOLE, weights="weights",
    guide="../weights.md",
)  # fmt: skip
"""The stack, from nothing within the same hours."""
BASELINES: Final = (
    MODULAR,
    Baseline("random", "even torques, each tick anew", "nothing", "nothing", "", _NOT, program="", agent="random"),
    Baseline(
        "untrained", "MPO untrained: its noise, pink, held for 4 ticks", _ROBOT, "nothing", "", _NOT, program="",
        agent="mujoban_baselines.agents:untrained",
    ),
    Baseline("mpo_hard", "MPO, asym.", _ROBOT, "hard", _MPO, _PARTIAL),
    Baseline("mpo_hard_sym", "MPO, sym.", _ROBOT, "hard", f"{_MPO} --critic symmetric", _PARTIAL),
    Baseline("mpo_curriculum", "MPO, asym.", _ROBOT, "curriculum", f"{_MPO} --levels curriculum", _PARTIAL),
    Baseline("mpo_easy", "MPO, asym.", _ROBOT, "easy", f"{_MPO} --levels easy", _PARTIAL),
    Baseline(
        "mpo_cloned", "MPO, asym., after cloning the stack", _ROBOT, "curriculum; the clone's bags",
        "monolithic-mpo --levels curriculum --mpo.critic-first 1000", _NOT, cloning="clone --bags bags/stack",
    ),
    Baseline("clone", "cloning of the stack alone", _ROBOT, "bags", "clone --bags bags/stack", _NOT),
    Baseline("vtrace", f"V-trace{PRIVILEGED}", _ABOVE, "curriculum", f"monolithic-vtrace {_VTRACE}", _FULL),
    Baseline(
        "structured", f"structured V-trace{PRIVILEGED}", f"{_ABOVE}, s_abst", "curriculum",
        f"structured-vtrace {_VTRACE}", _FULL,
    ),
    Baseline(
        "joint", "modular, fine-tuned as a whole", _ROBOT, "hard, from the row as it ships", "joint", _NOT,
        ("controller", "planner"),
    ),
)  # fmt: skip
"""The stack, what nobody has trained, the agents of appendix D, a monolithic one that may copy, and the stack
fine-tuned for the task's reward."""
JOINT: Final = next(row for row in BASELINES if row.name == "joint")
"""The stack, fine-tuned as a whole."""
AGAIN: Final = tuple(baseline.again(1) for baseline in BASELINES[1:] if baseline.program and not baseline.agent)
"""The agents once more, with another seed; they are shown where they were measured."""
RUNS: Final = tuple(baseline.run(d) for baseline in (*BASELINES, *AGAIN) for d in DIFFICULTIES)
"""Their evaluations."""


@dataclass(frozen=True)
class Options:
    """Note what runs cost, and their learning curves."""

    runs: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="NAME=RUN")]
    """Names of baselines and their run directories."""

    def __post_init__(self) -> None:
        """Reject nothing to note."""
        if not self.runs:
            raise ValueError("NAME=RUN is missing: expected rows of Table 1 with their run directories")


def read_curve(run: Path, *, cloned: bool = False) -> list[dict[str, Any]]:
    """Return at most `_MOST` points of a run, each the mean over a stretch of it; of the stack's, what it cost alone.

    Args:
        run: Its directory.
        cloned: Whether it began with the cloning in the directory beside it, whose name ends in `_start`. What that
            took counts as taken before the first step.

    Raises:
        ResultError: If it, or such a cloning, has no metrics, or too many of its updates were refused.
    """
    if (run / "pipeline.json").exists():
        return [cost(run) | {kind: {} for kind in (*KINDS, _EPISODES)}]
    lines, config = _lines(run), _config(run)
    before = _lines(run.with_name(run.name + _START))[-1] if cloned else {}
    points = []
    for part, whole in _stretches(lines, _episode_steps(config)):
        spent = ("step", "cpu_seconds", "seconds")
        point: dict[str, Any] = {kind: round((part[-1].get(kind) or 0) + before.get(kind, 0)) for kind in spent}
        for kind in KINDS:
            found = {str(d): mean_of(part if whole else (), [f"{kind}/{d}"]) for d in DIFFICULTIES}
            means = {d: mean for d, mean in found.items() if mean is not None}
            point[kind] = {d: round(mean, 4) for d, (mean, _) in means.items()}
            # Of every kind the same: an episode that ends has both.
            point[_EPISODES] = {d: round(count) for d, (_, count) in means.items()}
        points.append(point)
    if isinstance(start := config.get("origins"), dict):
        points[-1][ORIGINS] = start
    return points


def _config(run: Path) -> dict[str, Any]:
    """Return the configuration of a run; nothing where it is not there."""
    file = run / "config.json"
    return json.loads(file.read_text()) if file.exists() else {}


def _episode_steps(config: dict[str, Any]) -> int:
    """Return the environment steps in which each robot of a run has played its longest episode; 0: it plays none.

    A row of Table 1 has one actor, in whose robots all steps are taken.
    """
    if "task" not in config:
        return 0
    task = TaskConfig(**config["task"])
    return task.robots * task.steps


def _stretches(lines: Sequence[dict[str, Any]], longest: int) -> list[tuple[Sequence[dict[str, Any]], bool]]:
    """Return stretches of lines, at most `_MOST` and perhaps two more, and whether all episodes show in them alike.

    All robots begin at the same time, and those that time out go on doing so together: in what is shorter than the
    longest episode, or not a multiple of it, are too few of those that were not solved, or too many. So a stretch ends
    where each robot has come by a whole number of such episodes; the first, and what is left at the end, do not count.

    Args:
        lines: Of the metrics.
        longest: Steps of all robots together in which one episode after the other ends by its time limit; 0: any.
    """
    if not longest:
        parts = np.array_split(np.array(lines, object), min(len(lines), _MOST))
        return [(list(part), True) for part in parts]
    steps = np.array([line["step"] for line in lines])
    together = longest * max(1, math.ceil((steps[-1] / longest - 1) / _MOST))
    # The line in which an episode ends may be one of steps after it.
    edges = np.unique(np.searchsorted(steps, np.arange(longest, steps[-1] + 1, together)) + 1)
    parts = [part for part in np.split(np.array(lines, object), edges) if len(part)]
    return [(list(part), 0 < i < len(edges)) for i, part in enumerate(parts)]


def joined(points: Sequence[dict[str, Any]], kind: str, difficulty: int) -> list[tuple[int, float]]:
    """Return steps and means of a curve for a difficulty, points of few episodes joined with those that follow.

    Episodes at the end that are too few for a point are left out.

    Args:
        points: As `points_of` returns them.
        kind: One of `KINDS`.
        difficulty: 1 to 5.
    """
    return [(step, mean) for step, mean, _ in _joined(points, kind, difficulty)]


def solved_margins(points: Sequence[dict[str, Any]], difficulty: int) -> list[tuple[float, float]]:
    """Return how far the 95 % Wilson intervals of what `joined` says of `solved` reach below and above each point."""
    margins = []
    for _, mean, count in _joined(points, "solved", difficulty):
        low, high = wilson_interval(round(mean * count), count)
        # Means are noted with four digits.
        margins.append((max(mean - low, 0.0), max(high - mean, 0.0)))
    return margins


def solved_in_training(points: Sequence[dict[str, Any]], difficulty: int) -> tuple[int, int]:
    """Return how many episodes of a difficulty were solved of those that count in a curve, and how many these are."""
    d = str(difficulty)
    counts = [(point[_EPISODES].get(d, 0), point["solved"].get(d, 0.0)) for point in points]
    return round(sum(count * mean for count, mean in counts)), sum(count for count, _ in counts)


def _joined(points: Sequence[dict[str, Any]], kind: str, difficulty: int) -> list[tuple[int, float, int]]:
    """Return steps, means and numbers of episodes."""
    d = str(difficulty)
    curve: list[tuple[int, float, int]] = []
    total, episodes = 0.0, 0
    for point in points:
        count = point[_EPISODES].get(d, 0)
        total += count * point[kind].get(d, 0.0)
        episodes += count
        if episodes >= _ENOUGH:
            curve.append((point["step"], total / episodes, episodes))
            total, episodes = 0.0, 0
    return curve


def _lines(run: Path) -> list[dict[str, Any]]:
    lines = read_metrics(run)
    if not lines:
        raise ResultError(f"{run}: its metrics are empty")
    refused, updates = (lines[-1].get(kind) or 0.0 for kind in ("refused_updates", "updates"))
    if refused > _REFUSED * updates:
        raise ResultError(
            f"{run}: {refused:,.0f} of {updates:,.0f} updates were refused, as numbers in them were not finite: "
            f"expected at most {_REFUSED:.0%} of a run that is a row"
        )
    return lines


def points_of(baseline: Baseline) -> list[dict[str, Any]]:
    """Return the points of a baseline's learning curve; none where there is no file.

    Raises:
        ResultError: If the file is not what this program writes.
    """
    if not baseline.curve.exists():
        return []
    try:
        points = [json.loads(line) for line in baseline.curve.read_text().splitlines()]
        if any({"step", "cpu_seconds", "seconds", *KINDS, _EPISODES} - point.keys() for point in points):
            raise ValueError("a point lacks a value")
    except ValueError as error:
        again = f"python -m {PROG} {baseline.name}=runs/baselines/{baseline.name}"
        raise ResultError(f"{baseline.curve}: {error}; rerun {again}") from error
    return points


def note(given: Sequence[str]) -> None:
    """Write the curves of runs, given as NAME=RUN."""
    known = {baseline.name: baseline for baseline in (*BASELINES, *AGAIN) if baseline.program}
    for text in given:
        name, equals, run = text.partition("=")
        if not equals or name not in known:
            raise ValueError(f"{text}: expected NAME=RUN with a name among {', '.join(known)}")
        points = read_curve(Path(run), cloned=bool(known[name].cloning))
        write_atomically(known[name].curve, "".join(json.dumps(point) + "\n" for point in points).encode())
        print(f"{known[name].curve.name}: {len(points)} points, {points[-1]['step']} steps")


def main(command_line: Sequence[str] | None = None) -> int:
    """Run the command."""
    note(read_options(Options, command_line, PROG, __doc__).runs)
    return 0


if __name__ == "__main__":
    run_command(PROG, main)
