"""The report of a run of `bringup.train_all`: what each stage took, learned and came from, with its curves."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt

from bringup import keep
from bringup.model_card import Place, Score, card
from bringup.pipeline import Entry, Pipeline, Stage
from bringup.stage_sections import Measured, sections
from mujoban_core.files import brief, write_atomically
from mujoban_core.text import readable
from mujoban_planner.deliberation import LOOK_AHEAD
from mujoban_rl.metrics import METRICS, read_metrics
from mujoban_sokoban.generator import FRESH_SEEDS

_PREFIX = "evaluation/"
_RATES: Final = (
    "success_rate", "agent_accuracy", "boxes_all_right_if_seen", "termination_on_time", "termination_precision",
    "termination_recall",
)  # fmt: skip
"""Scores that are drawn, of all that start so; the table has steps as well."""
_ACTING: Final = ("teacher", "controller_")
"""How the stages are named whose samples are steps in the environment."""
_COLUMNS: Final = 4
"""Panels side by side in the figure of curves."""
_RECORDED: Final = re.compile(r"^(\d+) ticks of ", re.MULTILINE)
"""What `bringup.record` says at its end."""


class Evaluation(NamedTuple):
    """How all four modules play together at the end of a run."""

    title: str
    options: tuple[str, ...] = ()


EVALUATIONS: Final = {
    "evaluation": Evaluation("all four modules, the planner's policy alone", ("--look-ahead", "0")),
    "evaluation_ahead": Evaluation(
        f"all four modules, with a search ahead of {LOOK_AHEAD} evaluations", ("--look-ahead", str(LOOK_AHEAD))
    ),
}
"""By the name of the stage."""
_PLACE = Place("python -m bringup.train_all", None, "levels for validation by which nothing was chosen")


def write_report(run: Path, pipeline: Pipeline, weights: Mapping[str, str]) -> Path:
    """Collect weights and model cards in `weights/`, draw the curves, and write `report.md`; return its path."""
    found = {name: file for name in EVALUATIONS if (file := run / f"{name}.json").exists()}
    evaluations = {name: json.loads(file.read_text()) for name, file in found.items()}
    scores = [_score(name, report) for name, report in evaluations.items()]
    for role, name in weights.items():
        for source in ((run / name), (run / name).with_suffix(".json")):
            target = run / "weights" / f"{role}{source.suffix}"
            target.parent.mkdir(exist_ok=True)
            shutil.copyfile(source, target)
        text = card(target, f"weights/{role}.safetensors", _PLACE, scores)
        write_atomically(target.with_suffix(".md"), text.encode())
    titles = {stage.name: _title(stage.name, pipeline) for stage in pipeline.stages}
    measured = _measured(run, titles)
    figure = draw_curves(measured, titles, run / "curves.png")
    lines = [*_summary(run, evaluations, pipeline, measured), *_stages(run, pipeline), *_origins(pipeline)]
    if figure:
        lines += ["", "![Validation scores against CPU seconds](curves.png)"]
    lines += ["", "## Metrics and curves of each stage", *sections(run, titles, measured)]
    path = run / "report.md"
    write_atomically(path, ("\n".join(lines) + "\n").encode())
    return path


def _measured(run: Path, stages: Iterable[str]) -> Measured:
    """Return what those of some stages have measured that measure anything."""
    return {name: read_metrics(run / name) for name in stages if (run / name / METRICS).exists()}


def draw_curves(measured: Measured, titles: Mapping[str, str], path: Path) -> bool:
    """Draw the validation curves of all trainings, one panel each; return whether there are any.

    Args:
        measured: By the trainings.
        titles: Of the panels, by the names of the stages.
        path: The picture.
    """
    found = {title: curves for name, title in titles.items() if (curves := _rates(measured.get(name, [])))}
    if not found:
        return False
    columns = min(len(found), _COLUMNS)
    rows = -(-len(found) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(3.6 * columns, 3.0 * rows), squeeze=False)
    for axis in axes.flat[len(found) :]:
        axis.remove()
    for axis, (title, curves) in zip(axes.flat, found.items(), strict=False):
        for label, points in curves.items():
            axis.plot(*zip(*points, strict=True), label=label.replace("_", " ").replace("/", ", "), marker=".")
        axis.set(title=title, xlabel="CPU seconds of all processes", ylim=(0.0, 1.02))
        axis.legend(fontsize=8)
    for row in axes:
        row[0].set_ylabel("rate on validation levels")
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return True


def _rates(lines: Iterable[Mapping[str, Any]]) -> dict[str, list[tuple[float, float]]]:
    """Return the curves of a training that are drawn: pairs of CPU seconds and score, by the score's name."""
    curves: dict[str, list[tuple[float, float]]] = {}
    for line in lines:
        for metric, value in line.items():
            name = metric.removeprefix(_PREFIX)
            if metric != name and name.startswith(_RATES) and value is not None:
                curves.setdefault(name, []).append((line["cpu_seconds"], value))
    return curves


def cost(run: Path) -> dict[str, float]:
    """Return environment steps, CPU seconds and seconds by the clock of a run whose stages have all ended.

    Raises:
        PipelineError: If its record is damaged.
    """
    pipeline = Pipeline.read(run)
    return _cost(run, pipeline, _measured(run, filter(_acts, pipeline.entries)))


def _cost(run: Path, pipeline: Pipeline, measured: Measured) -> dict[str, float]:
    spent = sum(entry.cpu_seconds for entry in pipeline.entries.values())
    return {"step": _steps(run, pipeline, measured), "cpu_seconds": round(spent), "seconds": round(pipeline.seconds())}


def _steps(run: Path, pipeline: Pipeline, measured: Measured) -> int:
    """Return the environment steps of the controller's trainings and of what was recorded."""
    logs = (run / "logs").glob("bags_*.txt")
    recorded = sum(int(ticks) for log in logs for ticks in _RECORDED.findall(log.read_text()))
    # What was kept of another run was taken there.
    acted = (name for name, entry in pipeline.entries.items() if _acts(name) and not _is_kept(entry))
    lines = (measured.get(name, []) for name in acted)
    return recorded + sum(stage[-1]["step"] for stage in lines if stage)


def _acts(name: str) -> bool:
    """Return whether a stage's samples are steps in the environment."""
    return name.startswith(_ACTING)


def _is_kept(entry: Entry) -> bool:
    """Return whether a stage took over what another run had made."""
    return entry.command[1:2] == [keep.PROG]


def _title(name: str, pipeline: Pipeline) -> str:
    """Return how a stage is headed; curves of one that was kept are of the run that made it."""
    return name.replace("_", " ") + (" (kept)" if _is_kept(pipeline.entries[name]) else "")


def _score(name: str, report: Mapping[str, Any]) -> Score:
    levels = len(report["episodes"])
    return Score(EVALUATIONS[name].title, "none", levels, report["success_rate"], report["success_interval"])


def _summary(
    run: Path, evaluations: Mapping[str, Mapping[str, Any]], pipeline: Pipeline, measured: Measured
) -> Iterator[str]:
    spent = _cost(run, pipeline, measured)
    yield "# Weights from nothing"
    yield ""
    yield (
        f"All stages together took {spent['seconds'] / 3600:.2f} hours by the clock, some of them side by side on "
        f"{pipeline.cores} cores, {spent['cpu_seconds'] / 3600:.2f} hours of the processor, and "
        f"{readable(spent['step'])} environment steps."
    )
    if not evaluations:
        return
    yield ""
    yield (
        f"Solved of validation levels of difficulty 5, seeds from {FRESH_SEEDS.start}, by which no stage chooses what "
        "it keeps:"
    )
    yield ""
    yield "| | levels | solved | 95 % interval | mean return | failures |"
    yield "|---|---|---|---|---|---|"
    for name, report in evaluations.items():
        interval = " to ".join(f"{limit:.1%}" for limit in report["success_interval"])
        failures = ", ".join(f"{v} {k}" for k, v in report["failures"].items()) or "none"
        rate, mean = f"**{report['success_rate']:.1%}**", f"{report['mean_return']:.2f}"
        yield f"| {EVALUATIONS[name].title} | {len(report['episodes'])} | {rate} | {interval} | {mean} | {failures} |"


def _stages(run: Path, pipeline: Pipeline) -> Iterator[str]:
    yield ""
    yield "| stage | minutes | CPU minutes | samples | updates | last validation, or what came of it |"
    yield "|---|---|---|---|---|---|"
    for stage in pipeline.stages:
        record = _record(stage.products)
        metrics = record.get("metrics", {})
        scores = ", ".join(f"{k} {readable(v)}" for k, v in metrics.items() if k.startswith((*_RATES, "steps")))
        scores = scores or _outcome(run, stage)
        done = (readable(record[kind]) if kind in record else "" for kind in ("samples", "updates"))
        entry = pipeline.entries[stage.name]
        minutes = (readable(seconds / 60) for seconds in (entry.seconds, entry.cpu_seconds))
        name = f"{stage.name} (kept: what it once took is not counted)" if _is_kept(entry) else stage.name
        cells = (name, *minutes, *done, scores)
        yield f"| {' | '.join(cells)} |"


def _outcome(run: Path, stage: Stage) -> str:
    """Return what a recording or an evaluation came to; nothing of other stages."""
    log = run / "logs" / f"{stage.name}.txt"
    if stage.name.startswith("bags_") and log.exists():
        return next((line for line in reversed(log.read_text().splitlines()) if _RECORDED.match(line)), "")
    file = run / f"{stage.name}.json"
    if stage.name not in EVALUATIONS or not file.exists():
        return ""
    report = json.loads(file.read_text())
    return f"{report['success_rate']:.1%} of {len(report['episodes'])} levels solved"


def _record(products: tuple[Path, ...]) -> dict[str, Any]:
    """Return the record of the weights that a stage made, if it made weights."""
    for product in products:
        records = sorted(product.glob("*.json")) if product.is_dir() else [product.with_suffix(".json")]
        for file in records:
            if file.exists() and file.with_suffix(".safetensors").exists():
                return json.loads(file.read_text())
    return {}


def _origins(pipeline: Pipeline) -> Iterator[str]:
    yield ""
    yield "## Commands, and what each came from"
    for stage in pipeline.stages:
        entry = pipeline.entries[stage.name]
        yield ""
        yield f"- **{stage.name}**: `python {' '.join(entry.command)}`"
        for told in entry.ran_with:
            cores = f"{told['cores']} of {told['machine_cores']} cores"
            yield f"  - by commit {told['commit'] or 'unknown'}, torch {told['torch']}, {cores}"
        for direction, digests in (("from", entry.inputs), ("made", entry.outputs)):
            for name, digest in digests.items():
                yield f"  - {direction} `{name}`, SHA-256 {brief(digest)}"
