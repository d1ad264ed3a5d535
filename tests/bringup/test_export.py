import shutil
from functools import partial

import pytest

import mujoban_controller
import mujoban_planner
from bringup.export import export, main
from mujoban_core.program import exit_status
from mujoban_rl.weights import WeightsError


def test_a_module_is_told_by_its_record_and_its_graph_lies_beside(tmp_path, capsys, recwarn):
    weights = tmp_path / "controller.safetensors"
    for suffix in (".safetensors", ".json"):
        shutil.copy(mujoban_controller.SHIPPED.with_suffix(suffix), weights.with_suffix(suffix))
    assert main([str(weights)]) == 0
    assert capsys.readouterr().out.startswith(f"{weights.with_suffix('.onnx')}: 5.")
    assert mujoban_controller.load(weights).compiled is not None
    assert not [str(warning.message) for warning in recwarn]


def test_weights_that_have_no_graph_are_named():
    with pytest.raises(WeightsError, match=r"teacher_ball\.safetensors: weights of PrivilegedPolicy, expected one of "):
        export(mujoban_controller.teacher_weights("ball"))


def test_export_of_missing_weights_is_one_line(tmp_path, capsys):
    assert exit_status("export", partial(main, [str(tmp_path / "none.safetensors")])) == 2
    error = capsys.readouterr().err
    assert error.startswith("export: error: ") and "none" in error and error.count("\n") == 1


def test_without_its_library_the_error_says_how_to_get_it(monkeypatch):
    monkeypatch.setattr("mujoban_rl.export.find_spec", lambda name: None)
    with pytest.raises(ValueError, match="pip install onnxscript"):
        export(mujoban_planner.SHIPPED)
