import json
import os
import signal
import threading
import time

import pytest
import torch

from bringup import pipeline
from bringup.pipeline import Pipeline, PipelineError, Stage
from mujoban_core.files import InUseError, digest
from mujoban_core.signals import Interrupted

COPY = "import sys, pathlib; pathlib.Path(sys.argv[2]).write_text(pathlib.Path(sys.argv[1]).read_text() + 'b')"
# Counts its starts, ends well on SIGTERM as a trainer does, and is done at the second start.
TRAINER = """
import pathlib, signal, sys, time
signal.signal(signal.SIGTERM, lambda *_: sys.exit(0 if pathlib.Path(sys.argv[1]).exists() else 3))
starts = pathlib.Path(sys.argv[2])
starts.write_text((starts.read_text() if starts.exists() else '') + 'x')
if starts.read_text() == 'x':
    time.sleep(60)
pathlib.Path(sys.argv[1]).write_text('trained')
"""


def write(path, text):
    return ("-c", f"import pathlib; pathlib.Path({str(path)!r}).write_text({text!r})")


def stages(folder):
    a, b = folder / "a.txt", folder / "b.txt"
    return [
        Stage("first", write(a, "a"), (a,)),
        Stage("second", ("-c", COPY, str(a), str(b)), (b,), needs=("first",)),
    ]


def test_stages_run_in_the_order_of_their_needs_and_only_once(tmp_path):
    Pipeline(tmp_path, stages(tmp_path)).run()
    assert (tmp_path / "b.txt").read_text() == "ab"
    (tmp_path / "a.txt").write_text("changed")
    Pipeline(tmp_path, stages(tmp_path)).run()
    assert (tmp_path / "b.txt").read_text() == "ab"


def test_the_record_holds_the_digests_of_what_each_stage_came_from(tmp_path):
    Pipeline(tmp_path, stages(tmp_path)).run()
    record = json.loads((tmp_path / "pipeline.json").read_text())
    assert record["second"]["inputs"] == {"a.txt": digest(tmp_path / "a.txt")} == record["first"]["outputs"]


def test_what_comes_from_elsewhere_is_recorded_too(tmp_path):
    weights = tmp_path / "elsewhere" / "weights"
    weights.parent.mkdir()
    weights.write_text("trained before")
    product = tmp_path / "run" / "x"
    Pipeline(tmp_path / "run", [Stage("train", write(product, "a"), (product,), sources=(weights,))]).run()
    entry = json.loads((tmp_path / "run" / "pipeline.json").read_text())["train"]
    assert entry["inputs"] == {str(weights): digest(weights)}


def test_time_is_counted_by_the_clock_and_of_the_processor(tmp_path):
    """Two stages that run side by side take the time of one by the clock, and of the processor what each used."""
    busy = "import time\nwhile time.process_time() < {seconds}: pass"
    names = {"long": 1.0, "short": 0.3}
    for name in names:
        (tmp_path / name).touch()
    found = [Stage(n, ("-c", busy.format(seconds=t)), (tmp_path / n,)) for n, t in names.items()]
    run = Pipeline(tmp_path, found)
    run.run()
    for name, seconds in names.items():
        assert seconds <= run.entries[name].cpu_seconds < seconds + 0.25
    assert max(e.seconds for e in run.entries.values()) <= run.seconds() + 1e-6 < sum(
        e.seconds for e in run.entries.values()
    )
    assert Pipeline(tmp_path, found).seconds() == pytest.approx(run.seconds())


def test_the_expected_end_follows_from_what_runs_beside_what(tmp_path):
    def stage(name, seconds, *needs, cores=1):
        return Stage(name, (), (), needs, seconds, cores)

    found = [stage("a", 10), stage("b", 4), stage("c", 5, "b"), stage("d", 3, "a", "c", cores=2), stage("e", 2, "a")]
    # a beside b, then c: 10; d wants both cores, so that e waits.
    assert Pipeline(tmp_path, found).remaining() == 15
    assert Pipeline(tmp_path / "one", found, cores=1).remaining() == 24
    done = Pipeline(tmp_path / "done", found)
    done.entries["a"].done = done.entries["b"].done = True
    done.entries["c"].seconds = 4.0
    # One second of c is left, beside e, behind which d must wait.
    assert done.remaining() == 5


def test_the_expected_end_of_a_stage_that_takes_longer_has_never_passed(tmp_path):
    late = Pipeline(tmp_path, [Stage("a", (), (), seconds=10.0), Stage("b", (), (), ("a",), seconds=5.0)])
    for taken in (10.0, 40.0):
        late.entries["a"].seconds = taken
        assert late.remaining() == pytest.approx(5.0 + taken / 10)


def test_a_stopped_run_ends_its_commands_and_goes_on_where_it_was(tmp_path):
    product, starts = tmp_path / "weights", tmp_path / "starts"
    stage = Stage("train", ("-c", TRAINER, str(product), str(starts)), (product,))

    def interrupt():
        while not starts.exists():
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=interrupt).start()
    run = Pipeline(tmp_path, [stage])
    with pytest.raises(Interrupted):
        run.run()
    assert not run.running() and not run.done
    again = Pipeline(tmp_path, [stage])
    again.run()
    assert again.done and starts.read_text() == "xx"
    assert again.entries["train"].seconds > run.entries["train"].seconds > 0


def test_a_trainer_that_is_stopped_alone_is_not_done(tmp_path):
    folder = tmp_path / "train"
    product, metrics = folder / "planner.safetensors", folder / "metrics.jsonl"
    small = "--channels 4 --blocks 1 --first-evaluations 128 --evaluations 1 --trees 16 --expansions 16 --batch-size 8"
    command = ("-m", "mujoban_planner.train", "expert-iteration", *small.split(), "--run", str(folder))
    run = Pipeline(tmp_path, [Stage("train", command, (product,))])

    told = []

    def stop_trainer(pipeline):
        for process, _ in pipeline._running.values():
            if metrics.exists() and not told:
                told.append(process)
                process.send_signal(signal.SIGTERM)

    with pytest.raises(PipelineError, match=r"(?s)stage train ended with 143; .*the same command goes on from there"):
        run.run(stop_trainer)
    assert product.exists() and not run.done


def test_a_failing_command_is_named_with_the_end_of_its_log(tmp_path):
    stage = Stage("broken", ("-c", "import sys; sys.exit('no bags here')"), (tmp_path / "x",))
    with pytest.raises(PipelineError, match=r"stage broken ended with 1; .*broken\.txt ends: no bags here"):
        Pipeline(tmp_path, [stage]).run()
    with pytest.raises(PipelineError, match="stage idle ended without"):
        Pipeline(tmp_path, [Stage("idle", ("-c", ""), (tmp_path / "x",))]).run()


def test_another_command_for_a_stage_that_began_is_refused(tmp_path):
    Pipeline(tmp_path, stages(tmp_path)[:1]).run()
    with pytest.raises(PipelineError, match="expected the options of before, or another directory"):
        Pipeline(tmp_path, [Stage("first", ("-c", "pass"), ())])


def test_a_stage_that_failed_may_be_tried_with_another_command(tmp_path):
    with pytest.raises(PipelineError, match="stage first ended with"):
        Pipeline(tmp_path, [Stage("first", ("-c", "unknown"), (tmp_path / "a.txt",))]).run()
    Pipeline(tmp_path, stages(tmp_path)).run()
    assert (tmp_path / "b.txt").read_text() == "ab"


def recording(bags, *, fails):
    """Make a folder with one file, and fail before it holds another."""
    code = f"import pathlib, sys; p = pathlib.Path({str(bags)!r}); p.mkdir(); (p / 'half').touch()\n"
    code += "sys.exit('no space')" if fails else "(p / 'whole').touch()"
    return Stage("record", ("-c", code), (bags,), resumes=False)


def test_what_a_stage_that_cannot_resume_had_made_is_removed_before_it_starts_again(tmp_path):
    bags = tmp_path / "bags"
    with pytest.raises(PipelineError, match="no space"):
        Pipeline(tmp_path, [recording(bags, fails=True)]).run()
    (bags / "of the first").touch()
    Pipeline(tmp_path, [recording(bags, fails=False)]).run()
    assert sorted(p.name for p in bags.iterdir()) == ["half", "whole"]


def test_what_somebody_else_has_made_is_not_removed(tmp_path):
    bags = tmp_path / "bags"
    bags.mkdir()
    (bags / "mine").touch()
    run = Pipeline(tmp_path / "run", [*stages(tmp_path), recording(bags, fails=False)])
    with pytest.raises(PipelineError, match=r"bags: is there already, but not of this run, whose stage record makes"):
        run.run()
    assert [p.name for p in bags.iterdir()] == ["mine"]
    assert not (tmp_path / "a.txt").exists(), "refused before hours were spent"


def test_a_stage_that_ended_well_is_done_though_another_failed_meanwhile(tmp_path):
    """Both end while nobody looks: the recording is not to be made again."""
    bags, failed = tmp_path / "bags", tmp_path / "failed"
    broken = Stage("broken", ("-c", f"import pathlib; pathlib.Path({str(failed)!r}).touch(); 1 / 0"), ())
    run = Pipeline(tmp_path, [broken, recording(bags, fails=False)])

    def wait(pipeline):
        for process, _ in pipeline._running.values():
            process.wait(30)

    with pytest.raises(PipelineError, match="stage broken ended with 1"):
        run.run(wait)
    assert run.entries["record"].done and run.entries["record"].outputs


def test_a_stage_that_ended_well_is_done_though_the_run_is_stopped_meanwhile(tmp_path):
    run = Pipeline(tmp_path, [recording(tmp_path / "bags", fails=False)])

    def interrupt(pipeline):
        for process, _ in pipeline._running.values():
            process.wait(30)
        raise Interrupted(signal.SIGINT)

    with pytest.raises(Interrupted):
        run.run(interrupt)
    assert run.done


def test_stages_without_needs_run_side_by_side_up_to_the_cores(tmp_path):
    def waits_for(mine, other):
        code = f"import pathlib, time; pathlib.Path({str(mine)!r}).touch()\n"
        code += f"while not pathlib.Path({str(other)!r}).exists(): time.sleep(0.02)"
        return ("-c", code)

    a, b = tmp_path / "a", tmp_path / "b"
    Pipeline(tmp_path, [Stage("a", waits_for(a, b), (a,)), Stage("b", waits_for(b, a), (b,))], cores=2).run()
    assert a.exists() and b.exists()


@pytest.mark.parametrize("text", ["{", "[]", '{"first": {"unknown": 1}}', '{"first": 1}'])
def test_a_damaged_record_is_named(tmp_path, text):
    (tmp_path / "pipeline.json").write_text(text)
    with pytest.raises(PipelineError, match=r"pipeline\.json: .*expected the record of a run as it was written"):
        Pipeline(tmp_path, stages(tmp_path))


def test_two_runs_of_one_directory_are_refused(tmp_path):
    refused = []

    def run_again(pipeline):
        with pytest.raises(InUseError, match="another process is at work here, expected that it has ended, or another"):
            Pipeline(tmp_path, stages(tmp_path)).run()
        refused.append(pipeline.running())

    Pipeline(tmp_path, stages(tmp_path)).run(run_again)
    assert refused and (tmp_path / "b.txt").read_text() == "ab"
    Pipeline(tmp_path, stages(tmp_path)).run()


def test_a_need_that_is_no_earlier_stage_is_refused(tmp_path):
    with pytest.raises(PipelineError, match="stage second needs first"):
        Pipeline(tmp_path, stages(tmp_path)[1:])


def test_what_a_stage_is_yet_to_take_must_be_what_was_made(tmp_path):
    a, b = tmp_path / "a.txt", tmp_path / "b.txt"
    Pipeline(tmp_path, stages(tmp_path)[:1]).run()
    a.write_text("changed")
    refused = r"a\.txt: was changed since stage first made it: SHA-256 is \w{16}, expected \w{16}; or remove it, and it"
    with pytest.raises(PipelineError, match=refused):
        Pipeline(tmp_path, stages(tmp_path)).run()
    assert not b.exists()
    a.unlink()
    Pipeline(tmp_path, stages(tmp_path)).run()
    assert b.read_text() == "ab"


def test_the_record_names_the_code_and_the_machine_of_each_stage(tmp_path, monkeypatch):
    commits = iter(["one", "one", "two-dirty"])
    monkeypatch.setattr(pipeline, "commit_of", lambda file: next(commits))
    product = tmp_path / "x"
    for _ in range(2):
        with pytest.raises(PipelineError):
            Pipeline(tmp_path, [Stage("train", ("-c", "import sys; sys.exit(1)"), (product,), cores=2)]).run()
    Pipeline(tmp_path, [Stage("train", write(product, "a"), (product,), cores=2)]).run()
    starts = json.loads((tmp_path / "pipeline.json").read_text())["train"]["ran_with"]
    assert [start["commit"] for start in starts] == ["one", "two-dirty"]
    assert all(start["torch"] == torch.__version__ and start["cores"] == 2 for start in starts)
    assert all(start["machine_cores"] == len(os.sched_getaffinity(0)) for start in starts)


def test_what_is_gone_is_made_again_where_a_stage_needs_it_and_only_there(tmp_path):
    a, b = tmp_path / "a.txt", tmp_path / "b.txt"
    Pipeline(tmp_path, stages(tmp_path)).run()
    a.unlink()
    Pipeline(tmp_path, stages(tmp_path)).run()
    assert not a.exists() and b.read_text() == "ab"
    c = tmp_path / "c.txt"
    third = Stage("third", ("-c", COPY, str(b), str(c)), (c,), needs=("second",))
    b.unlink()
    Pipeline(tmp_path, [*stages(tmp_path), third]).run()
    assert c.read_text() == "abb" and a.exists()
