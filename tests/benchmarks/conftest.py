import pytest

from benchmarks.paper import parts, runs


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder in the place of that of the results, without any."""
    monkeypatch.setattr(runs, "JSON", tmp_path / "json")
    monkeypatch.setattr(parts, "PARTS", tmp_path / "parts")
    (tmp_path / "json").mkdir()
    return tmp_path
