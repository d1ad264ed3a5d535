"""Make the weights of all four modules from nothing: `python -m bringup.train_all --hours 8 --run runs/all`.

Bottom-up, as in the paper (section 2, Training): the controller (a teacher by reward, its camera policy by
distillation, then by MPO) beside the planner; bags of both with perfect sense; estimator and termination from these
bags; bags of all four, and estimator and termination again from both. No weight that ships is read. Stop it at any
time: the same command goes on. At the end stand `weights/` and `report.md` in the run's directory. With `--continue`
another run takes up all modules where a finished one has left them, and with `--keep` those that are not named.
"""

from __future__ import annotations

if __name__ == "__main__":
    from mujoban_core.early import end_at_once

    end_at_once()

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from bringup import keep
from bringup.pipeline import Pipeline, Stage
from bringup.training_display import run_shown
from bringup.training_options import BAGS, PRODUCTS, WEIGHTS, Options
from bringup.training_report import EVALUATIONS, write_report
from bringup.training_sizes import goes_on_between
from mujoban_core.bodies import BALL, get_body
from mujoban_core.program import read_options, run_command
from mujoban_sokoban.generator import FRESH_SEEDS, SENSES_SEEDS, TRAIN_SEEDS

PROG = "bringup.train_all"
_RECORDER: Final = "bringup.record"
SHARES: Final = {
    "teacher": 0.09,
    "controller_distil": 0.31,
    "planner": 0.50,
    "controller_mpo": 0.10,
    "bags_first": 0.03,
    "bags_validation": 0.01,
    "estimator_first": 0.12,
    "bags_second": 0.03,
    "estimator_second": 0.22,
    "evaluation": 0.08,
    "evaluation_ahead": 0.08,
}
"""Share of the hours that each stage gets, in their order. The controller's trainings have one core and the planner's
the other; the senses then have all, for each a shard of the batch. More threads to a shard bring nothing, and cost six
times as much where they must share a core."""
_STEPS: Final = 10**12
"""More than any budget of time lets a trainer take."""
_SAVED: Final = 0.92
"""Of a stage's share goes into training; the rest into starting, judging and saving."""
_EPISODES_PER_HOUR: Final = 90
"""Recorded in each round, per hour of the whole run."""
_RECORDED_STEPS: Final = 900
"""Longest recorded episode of the ball; a body that has more time for a level has more here."""
_EVALUATED_STEPS: Final = 125_000
"""Environment steps of the controller's training between two evaluations, per hour of the whole run, from one hour on
up to four. No budget counts them, and those of what has hardly learned yet take long."""
_PLANNER_EVALUATIONS: Final = 5
"""Of the training of the planner."""
_SENSES_EVALUATIONS: Final = 500
"""Updates between two evaluations of the senses, per hour of the whole run."""
_JUDGED_PER_HOUR: Final = 16
"""Validation levels of each such evaluation, per hour of the whole run; at most 64."""
_STUDENT: Final = (
    "--task.retry", "0.25", "--task.instructions.stay", "0.1", "--distil.infeasible-weight", "0.25",
)  # fmt: skip
"""The student sees more of instructions that failed before, and of STAYs, which the stack asks for often; what it is to
do under pushes that are not possible weighs less, so that it tries those where it can't tell."""
_TEACHER: Final = ("--algorithm", "mpo")
_FREED: Final = ("--mpo.steady", "0.25", "--task.retry", "0.25")
"""And, once it drives, in part without noise, and more of what fails then: noise frees robots that pegs hold up."""
_TURNING_TEACHER: Final = (
    "--algorithm", "ppo", "--task.planned", "0.7", "--task.retry", "0.25",
    "--task.instructions.stay", "0.2", "--task.instructions.stays-on", "0.985", "--task.reward.heading", "0.15",
)  # fmt: skip
"""Of a body that no single action turns: it is told to stay, where it turns, often enough to learn to. PPO is what has
taught such a body (docs/research/controller.md); it leaves no critic for the student's MPO to begin with."""
_VIEWS: Final = ("--noise", "0.05", "--hidden", "0.1")
"""Shares of the planner's samples that are blurred as estimates are, and that hide what the robot has not seen."""
_MINED: Final = ("--mined", "0.25", "--led", "1", "--evaluations", "3")
"""Of a planner that goes on, a quarter of the levels are such as it lost: of others it wins most, and learns nothing.
In whatever it loses it is sought which push did it; and its own play, which has become rare to lose, gets more time."""
_GENTLY: Final = ("--learning-rate", "4e-4")
"""And it keeps what it knows: at a rate for weights as drawn it is worse until the rate falls again."""
_LEVELS: Final = {"bags_first": 1, "bags_second": 2}
"""Each recording draws levels of its own, so many billion seeds into those for training; another `seed`, others."""
_VALIDATION_PER_HOUR: Final = 6
"""Episodes of them, per hour of the whole run; at most 32."""


def stages(options: Options) -> list[Stage]:
    """Return all stages of a run, each after what it needs.

    Raises:
        WeightsError: If the planner that is gone on from has no record.
    """
    makers = {"controller": _controller, "planner": _planner, "senses": _senses}
    found = [_evaluation(options, name) for name in EVALUATIONS]
    for module, make in makers.items():
        trained = make(options)
        found += _kept(options, trained) if module in options.keep else trained
    order = list(SHARES)
    return sorted(found, key=lambda stage: order.index(stage.name))


def _seconds(options: Options, name: str) -> float:
    return SHARES[name] * options.hours * 3600.0


def _physics(options: Options) -> tuple[str, ...]:
    return ("--world", options.physics.world, "--body", options.physics.body)


def _from_before(options: Options, option: str, product: str) -> tuple[str, ...]:
    """Return the option by which a training begins with weights of the run that is gone on from, if there is one."""
    return () if options.before is None else (option, str(options.before / PRODUCTS[product]))


def _sources(options: Options, *products: str) -> tuple[Path, ...]:
    """Return what a training takes from the run that is gone on from."""
    return () if options.before is None else tuple(options.before / PRODUCTS[product] for product in products)


def _trainer(
    options: Options, name: str, command: Sequence[str], product: str, *needs: str, beside: Sequence[str] = (),
    sources: Sequence[Path] = (), last: Sequence[str] = (),
) -> Stage:  # fmt: skip
    """Return a stage that trains for its share of the hours, which no limit of steps cuts short.

    Args:
        options: Of the whole run.
        name: Of the stage.
        command: Module and arguments.
        product: Its weights, a path in the run's directory.
        needs: Stages before it.
        beside: What it makes beside its product.
        sources: What it takes from elsewhere.
        last: Options that count against those of the machine.
    """
    seconds, machine = _seconds(options, name), options.machine
    arguments = ("-m", *command, "--run", str(options.run / name), *machine.budget(name, _SAVED * seconds))
    outputs = tuple(options.run / path for path in (product, *beside))
    return Stage(
        name, (*arguments, *machine.sizes(name), *last), outputs, needs, seconds, machine.cores_of(name),
        sources=tuple(sources),
    )  # fmt: skip


def _kept(options: Options, trained: Sequence[Stage]) -> list[Stage]:
    """Return stages that take over what the run that is gone on from has trained; nothing is recorded for them."""
    assert options.before is not None
    found = list[Stage]()
    for stage in trained:
        if stage.command[1] == _RECORDER:
            continue
        name = stage.name
        command = ("-m", keep.PROG, "--made", str(options.before / name), "--out", str(options.run / name))
        sources = tuple(options.before / path.relative_to(options.run) for path in stage.products)
        found.append(Stage(name, command, stage.products, seconds=1.0, resumes=False, sources=sources))
    return found


def _controller(options: Options) -> list[Stage]:
    run, teacher, student = options.run, PRODUCTS["teacher"], PRODUCTS["student"]
    common = ("--seed", str(options.stream), "--task.world", options.physics.world)
    common += ("--task.body", options.physics.body)
    judged = max(4, min(64, round(_JUDGED_PER_HOUR * options.hours)))
    every = round(min(max(1.0, options.hours), 4.0) * _EVALUATED_STEPS)
    common += ("--steps", str(_STEPS), "--evaluate-every", str(every), "--evaluation-episodes", str(judged))
    train, body = "mujoban_controller.train", get_body(options.physics.body)
    method = _TEACHER if options.has_critic else _TURNING_TEACHER
    method += _FREED if options.has_critic and options.before is not None else ()
    made = {"--initial": "teacher"} | ({"--critic": "critic"} if options.has_critic else {})
    begun = [x for option, product in made.items() for x in _from_before(options, option, product)]
    taught = ("--critic", str(run / PRODUCTS["critic"])) if options.has_critic else ()
    # Who finds the heading by sight looks around first, as in the stack.
    look = ("--task.look", str(body.seeking_ticks)) if body.seeking_ticks else ()
    return [
        _trainer(
            options, "teacher", (train, "--stage", "teacher", *common, *method, *begun), teacher,
            beside=[PRODUCTS["critic"]] if options.has_critic else [], sources=_sources(options, *made.values()),
        ),
        _trainer(
            options, "controller_distil", (train, "--stage", "distil", "--teacher", str(run / teacher), *common,
            *_STUDENT, *look, *_from_before(options, "--initial", "controller")), student, "teacher",
            sources=_sources(options, "controller"),
        ),
        _trainer(
            options, "controller_mpo",
            (train, "--stage", "mpo", "--initial", str(run / student), *taught, *common, *look),
            WEIGHTS["controller"], "teacher", "controller_distil",
        ),
    ]  # fmt: skip


def _planner(options: Options) -> list[Stage]:
    """Return the training of the planner, on boards in full view and as an estimator sees them."""
    product = WEIGHTS["planner"]
    every = max(1, round(_seconds(options, "planner") / _PLANNER_EVALUATIONS))
    command = ("mujoban_planner.train", "expert-iteration", "--seed", str(options.stream))
    command += ("--evaluate-every", str(every))
    begun, last = (), ()
    if options.before is not None:
        begun = (*_from_before(options, "--init", "planner"), *_MINED)
        before = options.before / product
        last = (*options.machine.begun_with(before), *_GENTLY, *goes_on_between(before))
    return [
        _trainer(
            options, "planner", (*command, *begun, *_VIEWS), product, sources=_sources(options, "planner"),
            last=last,
        )
    ]  # fmt: skip


def _senses(options: Options) -> list[Stage]:
    validation = _validation(options)
    found = [validation]
    bags = list[Path]()
    start = first = None if options.before is None else (options.before / PRODUCTS["estimator"]).parent
    needs = [validation.name]
    for round_ in BAGS:
        recording = f"bags_{round_}"
        found.append(_recording(options, recording))
        bags.append(options.run / recording)
        name = f"estimator_{round_}"
        earlier = _earlier_bags(options, name)
        out = options.run / name / "weights"
        command = ["mujoban_estimator.train", "--bags", *map(str, [*earlier, *bags]), "--out", str(out)]
        command += ["--validation", str(validation.products[0])]
        every = max(1, round(_SENSES_EVALUATIONS * options.hours))
        command += ["--evaluate-every", str(every), "--seed", str(options.stream), "--steps", str(_STEPS)]
        for part in ("estimator", "termination"):
            command += [f"--learner.{part}.body", options.physics.body]
        if start is not None:
            command += ["--start", str(start)]
        start = out
        needs.append(recording)
        sources = [] if first is None else [first, *earlier]
        found.append(_trainer(options, name, command, f"{name}/weights", *needs, sources=sources))
        needs.append(name)
    return found


def _earlier_bags(options: Options, name: str) -> list[Path]:
    """Return the bags of the run that is gone on from which a stage reads: those that there are, or were for it."""
    if options.before is None:
        return []
    folders = [options.before / PRODUCTS[round_] for round_ in BAGS]
    entry = Pipeline.read(options.run).entries.get(name)
    if entry is not None and entry.done:
        return [folder for folder in folders if str(folder) in entry.command]
    return [folder for folder in folders if folder.exists()]


def _validation(options: Options) -> Stage:
    """Return a stage that records the bags on which the senses are judged, as the stack will play.

    It looks around, and ends instructions late: of recordings that end with them nobody is told late.
    """
    name = "bags_validation"
    first, run = _recording(options, "bags_first"), options.run
    episodes = max(4, min(32, round(_VALIDATION_PER_HOUR * options.hours)))
    replaced = {"--out": str(run / name), "--episodes": str(episodes), "--seed": str(SENSES_SEEDS.start)}
    command = list(first.command)
    for option, value in replaced.items():
        command[command.index(option) + 1] = value
    look = str(get_body(options.physics.body).look_ticks)
    command += ["--allow-test-seeds", "--late-ends", "--look-around", look]
    return replace(
        first, name=name, command=tuple(command), products=(run / name,), seconds=_seconds(options, name)
    )  # fmt: skip


def _recording(options: Options, name: str) -> Stage:
    """Return a stage that records bags: the first of what has learned until then, with perfect sense, then of all."""
    run, first = options.run, name == "bags_first"
    cores = options.machine.cores_of(name)
    needs = ("controller_mpo", "planner") if first else ("controller_mpo", "planner", "estimator_first")
    roles = ("controller", "planner") if first else WEIGHTS
    acting = {role: WEIGHTS[role].replace("estimator_second", "estimator_first") for role in roles}
    sense = ("--oracle", "estimator,termination") if first else ()
    modules = tuple(x for role, path in acting.items() for x in (f"--{role}", str(run / path)))
    episodes = max(8, round(_EPISODES_PER_HOUR * options.hours * options.machine.episodes))
    limit = _RECORDED_STEPS * get_body(options.physics.body).time_limit // BALL.time_limit
    stream = len(_LEVELS) * options.stream + _LEVELS[name]
    seed = TRAIN_SEEDS.start + stream * 10**9
    command = (
        "-m", _RECORDER, "--out", str(run / name), "--episodes", str(episodes),
        "--seed", str(seed), "--run-seed", str(stream), "--time-limit", str(limit),
        "--processes", str(cores), *_physics(options), "--look-ahead", "0", *sense, *modules,
    )  # fmt: skip
    seconds = _seconds(options, name)
    return Stage(name, command, (run / name,), needs, seconds, cores, resumes=False)


def _evaluation(options: Options, name: str) -> Stage:
    """Return a stage that plays fresh levels with all four modules, as they are or with a search ahead."""
    run = options.run
    weights = tuple(x for role, path in WEIGHTS.items() for x in (f"--{role}", str(run / path)))
    report = run / f"{name}.json"
    command = (
        "-m", "bringup.evaluate", "--difficulty", "5", "--episodes", str(options.evaluation_episodes),
        "--seed", str(FRESH_SEEDS.start), *_physics(options), "--json", str(report),
        *weights, *EVALUATIONS[name].options,
    )  # fmt: skip
    needs = ("estimator_second", "planner", "controller_mpo")
    return Stage(name, command, (report,), needs, _seconds(options, name))


def train_all(options: Options) -> Path:
    """Run all stages that are not done yet, then write the report; return its path.

    Raises:
        PipelineError: If a stage fails.
        Interrupted: If a signal came.
    """
    pipeline = Pipeline(options.run, stages(options), cores=options.cores)
    run_shown(pipeline)
    return write_report(options.run, pipeline, WEIGHTS)


def main(command_line: Sequence[str] | None = None) -> int:
    """Run the command."""
    print(train_all(read_options(Options, command_line, PROG, __doc__)))
    return 0


if __name__ == "__main__":
    run_command(PROG, main)
