import json
import math
import os
import signal
from dataclasses import replace
from multiprocessing import get_context

import numpy as np
import pytest
import torch
from torch import nn

from mujoban_core.files import InUseError
from mujoban_core.signals import Interrupted
from mujoban_rl.engine import CARRIED, Budget, Cadence, Learner, Source, State, Trainer
from mujoban_rl.limits import NaNGuard
from mujoban_rl.optimise import ProgressSchedule, guarded_step, moving_average, warm_up_cosine
from mujoban_rl.run_directory import RunDirectory, RunError, copy_light

CADENCE = Cadence(log_updates=2, evaluate_samples=40, save_seconds=math.inf)


class Regression(Learner[torch.Tensor]):
    """Learns to predict the first column from the others; its own randomness drops inputs."""

    def __init__(self):
        torch.manual_seed(0)
        self.net = nn.Linear(3, 1)
        self.duals = nn.Linear(1, 1, bias=False)
        self.adam = torch.optim.Adam(self.net.parameters(), 1e-2)
        self.dual_adam = torch.optim.Adam(self.duals.parameters(), 1e-2)
        self.schedule = ProgressSchedule(self.adam, warm_up_cosine(0.1))
        self.average = moving_average(self.net, 0.9)
        self.generator = torch.Generator().manual_seed(1)

    @property
    def modules(self):
        return {"net": self.net, "duals": self.duals, "average": self.average}

    @property
    def optimisers(self):
        return {"adam": self.adam, "duals": self.dual_adam}

    def state(self):
        return State(tensors={"generator": self.generator.get_state()})

    def restore(self, state):
        self.generator.set_state(state.tensors["generator"])

    def update(self, batch, progress, guard):
        self.schedule.follow(progress)
        kept = torch.rand(batch[:, 1:].shape, generator=self.generator) < 0.9
        loss = (self.duals(self.net(batch[:, 1:] * kept)) - batch[:, :1]).square().mean()
        if guarded_step(loss, [self.adam, self.dual_adam], guard, clip=1.0) is not None:
            self.average.update_parameters(self.net)
        return {"loss": loss.item()}

    def evaluate(self):
        return {"weight": float(self.net.weight.detach().abs().sum())}

    def export(self, directory, record):
        (directory.path / "record.json").write_text(json.dumps(record))


class Noise(Source[torch.Tensor]):
    def __init__(self, poison=(), on_batch=None, end=None):
        self.rng = np.random.default_rng(7)
        self.poison, self.on_batch, self.end = poison, on_batch, end
        self.batches, self.published, self.closed = 0, [], False

    def next_batch(self):
        if self.batches == self.end:
            return None
        self.batches += 1
        self.samples += 4
        if self.on_batch:
            self.on_batch(self.batches)
        batch = torch.from_numpy(self.rng.normal(size=(4, 4)).astype(np.float32))
        return batch * math.nan if self.batches in self.poison else batch

    def publish(self, weights, version):
        self.published.append(version)

    def state(self):
        return State({"rng": self.rng.bit_generator.state, "batches": self.batches})

    def restore(self, state):
        self.rng.bit_generator.state = state.values["rng"]
        self.batches = state.values["batches"]

    def close(self):
        self.closed = True


def trainer(path, source=None, samples=200, cadence=CADENCE, **record):
    learner, budget = Regression(), Budget(samples=samples)
    return Trainer(RunDirectory(path, {}), learner, source or Noise(), budget, cadence, record=record)


def weights(run):
    return {
        f"{name}.{k}": v.clone() for name, module in run.learner.modules.items() for k, v in module.state_dict().items()
    }


def same(a, b):
    return a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)


@pytest.mark.parametrize("last", [0.0, 0.1])
def test_a_rate_rises_and_falls_to_what_is_to_be_left_of_it(last):
    rate = warm_up_cosine(0.1, last)
    assert rate(0.0) == 0.0 and rate(0.1) == pytest.approx(1.0, abs=0.03) and rate(1.0) == pytest.approx(last)
    assert rate(0.05) < rate(0.1) > rate(0.5) > rate(0.9)


def test_a_run_interrupted_by_a_signal_and_resumed_equals_one_that_never_stopped(tmp_path, capsys):
    whole = trainer(tmp_path / "whole")
    assert whole.run()
    kill = Noise(on_batch=lambda n: os.kill(os.getpid(), signal.SIGTERM) if n == 17 else None)
    first = trainer(tmp_path / "parts", kill)
    with pytest.raises(Interrupted) as stopped:
        first.run()
    assert stopped.value.status == 143 and first.progress.updates == 17 and kill.closed
    said = capsys.readouterr().err
    assert said.index("parts: stopping after this update") < said.index("parts: interrupted after")
    second = trainer(tmp_path / "parts")
    assert second.progress.updates == 17 and second.run()
    assert same(weights(whole), weights(second))
    assert whole.metrics == second.metrics


def test_a_signal_cuts_an_evaluation_short_which_comes_first_when_the_run_goes_on(tmp_path):
    def judged(run):
        judge = run.learner.evaluate
        run.learner.evaluate = lambda: (evaluated.append(run.progress.updates), judge())[1]
        return run

    evaluated, finished = [], []
    whole = judged(trainer(tmp_path / "whole"))
    assert whole.run()
    expected, evaluated = evaluated, []
    first = judged(trainer(tmp_path / "parts"))
    judge = first.learner.evaluate

    def interrupted():
        scores = judge()
        if first.progress.updates == expected[1]:
            os.kill(os.getpid(), signal.SIGTERM)
            finished.append("an evaluation that was to be cut short")
        return scores

    first.learner.evaluate = interrupted
    with pytest.raises(Interrupted):
        first.run()
    assert not finished and first.metrics != {} and first.progress.updates == expected[1]
    second = judged(trainer(tmp_path / "parts"))
    assert second.run() and evaluated == [*expected[:2], *expected[1:]]
    assert same(weights(whole), weights(second)) and whole.metrics == second.metrics


def test_a_killed_learner_goes_on_from_its_last_checkpoint_as_if_nothing_had_happened(tmp_path):
    def learn():
        kill = Noise(on_batch=lambda n: os.kill(os.getpid(), signal.SIGKILL) if n == 17 else None)
        trainer(tmp_path / "parts", kill, cadence=replace(CADENCE, save_seconds=0.0)).run()

    whole = trainer(tmp_path / "whole")
    assert whole.run()
    process = get_context("fork").Process(target=learn)
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    second = trainer(tmp_path / "parts")
    assert second.progress.updates == 16 and second.run()
    assert same(weights(whole), weights(second))


def test_a_batch_that_is_not_finite_changes_no_weight_and_no_optimiser(tmp_path):
    run = trainer(tmp_path, Noise(poison={3}, end=2))
    run.run()
    before = weights(run)
    moments = {k: v.clone() for k, v in run.learner.adam.state_dict()["state"][0].items()}
    again = trainer(tmp_path, Noise(poison={3}, end=3))
    again.run()
    assert same(before, weights(again))
    after = again.learner.adam.state_dict()["state"][0]
    assert all(torch.equal(after[k], v) for k, v in moments.items())
    assert again.progress.updates == 3


def test_learning_curve_evaluations_and_published_versions_follow_the_cadence(tmp_path):
    source = Noise()
    trainer(tmp_path, source, samples=80, cadence=Cadence(log_updates=5, publish_updates=4, evaluate_samples=40)).run()
    lines = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines if "loss" in line] == [20, 40, 60, 80]
    assert [line["step"] for line in lines if "evaluation/weight" in line] == [40, 80]
    assert source.published == [0, 4, 8, 12, 16, 20]
    assert all("cpu_seconds" in line for line in lines)


def test_a_run_that_ends_says_how_and_where_its_weights_are(tmp_path, capsys):
    def said(**limits):
        trainer(tmp_path / "run").run(**limits)
        return capsys.readouterr().err.splitlines()[-1]

    assert said(limit_seconds=0.0).endswith("run: stopped after 0 samples; the same command goes on from there")
    assert said(limit_updates=2).endswith("run: stopped after 8 samples")
    assert said().endswith(f"run: complete after 200 samples: weights in {tmp_path / 'run'}")
    assert said().endswith("run: complete after 200 samples; nothing is left to do")


def test_a_bit_that_ends_says_before_it_judges_what_it_learned(tmp_path, capsys):
    run = trainer(tmp_path / "run")
    judge, said = run.learner.evaluate, []

    def evaluate():
        said.extend(capsys.readouterr().err.splitlines())
        return judge()

    run.learner.evaluate = evaluate
    run.run(limit_updates=3)
    assert said[-1].endswith("run: judging what was learned; Ctrl-C puts it off")


def test_a_learner_that_judges_nothing_announces_nothing(tmp_path, capsys, monkeypatch):
    monkeypatch.delattr(Regression, "evaluate")
    trainer(tmp_path).run(limit_updates=3)
    assert "judging" not in capsys.readouterr().err


def test_what_came_since_the_last_line_is_logged_where_a_bit_ends(tmp_path):
    cadence = Cadence(log_updates=5)
    for updates in (7, 10):
        trainer(tmp_path, samples=80, cadence=cadence).run(limit_updates=updates)
    lines = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [line["updates"] for line in lines if "loss" in line] == [5, 7, 10]


def test_schedules_follow_the_budget_and_a_spent_budget_trains_no_more(tmp_path):
    run = trainer(tmp_path, samples=80)
    run.run()
    assert run.learner.adam.param_groups[0]["lr"] == pytest.approx(1e-2 * warm_up_cosine(0.1)(0.95))
    before = weights(run)
    again = trainer(tmp_path, samples=80)
    assert again.run() and same(before, weights(again))


def test_what_a_complete_run_has_made_keeps_its_record_whoever_calls_it_again(tmp_path):
    made = tmp_path / "record.json"
    trainer(tmp_path, commit="first").run()
    record, checkpoints = made.read_bytes(), sorted(tmp_path.glob("checkpoint-*"))
    written = [file.stat().st_mtime_ns for file in checkpoints]
    again = trainer(tmp_path, commit="second")
    again.learner.evaluate = lambda: pytest.fail("judged once more")
    assert again.run() and made.read_bytes() == record
    assert [file.stat().st_mtime_ns for file in checkpoints] == written
    # What is lost comes back.
    made.unlink()
    assert trainer(tmp_path, commit="second").run() and made.read_bytes() == record


def test_a_run_killed_while_it_is_judged_at_its_end_is_judged_when_it_is_called_again(tmp_path):
    def learn():
        run = trainer(tmp_path, samples=8, cadence=replace(CADENCE, save_seconds=0.0))
        run.learner.evaluate = lambda: os.kill(os.getpid(), signal.SIGKILL)
        run.run()

    process = get_context("fork").Process(target=learn)
    process.start()
    process.join()
    run = trainer(tmp_path, samples=8)
    assert run.complete and run.run() and run.metrics


def test_a_run_that_goes_on_with_other_bags_is_refused_unless_it_was_carried_without_them(tmp_path):
    def run(name, bags):
        return trainer(tmp_path / name, bags_digest=bags)

    run("run", "one").run(limit_updates=2)
    run("run", "one").run(limit_updates=3)
    for others in ("two", None):
        told = rf"run: other bags than the run's \(digest one there, {others or 'none'} now\): expected those, or"
        with pytest.raises(RunError, match=told):
            run("run", others)
    copy_light(tmp_path / "run", tmp_path / "light", CARRIED)
    run("light", "two").run(limit_updates=4)
    with pytest.raises(RunError, match="digest two there, one now"):
        run("light", "one")
    # A run of before there was this check is taken at its word.
    for file in (tmp_path / "run").glob("checkpoint-*.json"):
        content = json.loads(file.read_text())
        del content["extra"]["record"]
        file.write_text(json.dumps(content))
    assert run("run", "two").progress.updates == 3


def test_after_a_stop_actors_go_on_with_the_weights_that_they_had(tmp_path):
    class Acting(Noise):
        def publish(self, weights, version):
            self.bias = weights["bias"].clone()
            super().publish(weights, version)

        def next_batch(self):
            batch = super().next_batch()
            return None if batch is None else batch + self.bias

    class Publishing(Regression):
        def weights(self):
            return self.net.state_dict()

    def run(path, **limits):
        made = Trainer(RunDirectory(path, {}), Publishing(), Acting(), Budget(updates=20), Cadence(publish_updates=6))
        made.run(**limits)
        return made

    whole = run(tmp_path / "whole")
    run(tmp_path / "parts", limit_updates=5)
    run(tmp_path / "parts", limit_samples=36)
    resumed = run(tmp_path / "parts")
    assert same(weights(whole), weights(resumed))
    assert resumed.source.published == [6, 12, 18]


def test_gradients_that_stay_not_finite_end_the_run_though_losses_are_finite():
    weight = torch.nn.Parameter(torch.zeros(1))
    adam, guard = torch.optim.Adam([weight]), NaNGuard(patience=3)
    with pytest.raises(FloatingPointError, match="4 non-finite steps in a row"):
        for _ in range(4):
            guarded_step(weight.sqrt().sum(), [adam], guard)
    assert weight.item() == 0.0 and guard.skipped == 4


def test_an_average_that_warms_up_forgets_early_weights_soon():
    net = nn.Linear(1, 1)
    averages = [moving_average(net, 0.999, warm_up=warm_up) for warm_up in (True, False)]
    for step in range(30):
        nn.init.constant_(net.weight, float(step))
        for average in averages:
            average.update_parameters(net)
    warm, cold = (float(average.module.weight.detach()) for average in averages)
    assert warm > 20.0 and cold < 1.0


def test_a_source_without_more_ends_the_run(tmp_path):
    run = trainer(tmp_path, Noise(end=5))
    assert run.run() and run.progress.updates == 5


def test_two_processes_do_not_train_in_one_directory(tmp_path):
    def train_again(_):
        with pytest.raises(InUseError, match="another process is at work here, expected that it has ended, or another"):
            trainer(tmp_path).run()

    assert trainer(tmp_path, Noise(end=2, on_batch=train_again)).run()
    assert trainer(tmp_path, Noise(end=2)).run()


@pytest.mark.parametrize("seconds", [-1.0, math.nan])
def test_a_limit_that_is_no_time_is_refused(tmp_path, seconds):
    with pytest.raises(ValueError, match=f"a limit of {seconds:g} seconds: expected 0 or more"):
        trainer(tmp_path).run(limit_seconds=seconds)


def test_a_budget_that_is_no_amount_is_refused():
    with pytest.raises(ValueError, match="0 samples: expected a positive number"):
        Budget(samples=0)


@pytest.mark.parametrize(
    ("option", "value"),
    [("log_updates", 0), ("publish_updates", -1), ("evaluate_samples", math.nan), ("evaluate_seconds", -1.0),
     ("save_seconds", math.nan)],
)  # fmt: skip
def test_a_cadence_that_is_no_distance_is_refused(option, value):
    verb, unit = option.split("_")
    with pytest.raises(ValueError, match=f"{verb} every {value} {unit}: expected a (positive )?number"):
        Cadence(**{option: value})


def test_a_run_goes_on_elsewhere_from_a_light_copy_with_its_networks_and_what_it_has_spent(tmp_path):
    here = trainer(tmp_path / "here")
    here.run(limit_samples=120)
    copy_light(tmp_path / "here", tmp_path / "there", CARRIED)
    there = trainer(tmp_path / "there")
    assert vars(there.progress) == vars(here.progress)
    for name, tensor in weights(here).items():
        torch.testing.assert_close(weights(there)[name], tensor, rtol=1e-3, atol=1e-6)
    assert not there.learner.adam.state and there.source.batches == 0
    assert there.run() and there.progress.samples == 200


def test_a_light_copy_keeps_the_best_product_so_far(tmp_path):
    class Keeping(Regression):
        best = torch.zeros(1)

        def state(self):
            return State.of({"own": super().state(), "best": State({"score": 0.5}, {"weight": self.best})})

        def restore_best(self, state):
            self.best, self.score = state.tensors["weight"], state.values["score"]

    def run(name):
        return Trainer(RunDirectory(tmp_path / name, {}), Keeping(), Noise(), Budget(samples=200), CADENCE)

    here = run("here")
    here.learner.best = torch.ones(1)
    here.run(limit_samples=40)
    copy_light(tmp_path / "here", tmp_path / "there", CARRIED)
    there = run("there")
    assert there.learner.best == 1.0 and there.learner.score == 0.5


def test_a_light_copy_of_what_is_not_intact_is_refused(tmp_path):
    trainer(tmp_path / "run").run(limit_samples=40)
    for file in (tmp_path / "run").glob("checkpoint-*.safetensors"):
        file.write_bytes(b"half")
    with pytest.raises(RunError, match="none of 1 checkpoints is intact"):
        copy_light(tmp_path / "run", tmp_path / "copy", CARRIED)
    assert copy_light(tmp_path / "empty", tmp_path / "copy", CARRIED) is None
