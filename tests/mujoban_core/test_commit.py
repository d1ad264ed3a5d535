"""What records name as the code that made them."""

import os
import subprocess
from pathlib import Path

import pytest

from mujoban_core import commit


def test_code_that_was_changed_since_its_commit_is_marked_and_pages_are_no_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = {f"GIT_{who}_{what}": "a" for who in ("AUTHOR", "COMMITTER") for what in ("NAME", "EMAIL")}
    environment = {"GIT_CONFIG_GLOBAL": os.devnull, **names, **os.environ}

    def git(*command: str) -> str:
        ran = subprocess.run(
            ["git", *command], cwd=tmp_path, env=environment, check=True, capture_output=True, text=True
        )
        return ran.stdout.strip()

    def found() -> str | None:
        monkeypatch.setattr(commit, "_found", {})  # as in a process of its own
        return commit.commit_of(file)

    file, page, other = (tmp_path / "code" / "a.py", tmp_path / "docs" / "a.md", tmp_path / "code" / "b.py")
    for path in (file, page, other):
        path.parent.mkdir(exist_ok=True)
        path.touch()
    git("init", "-q")
    git("add", ".")
    git("commit", "-q", "-m", "all")
    clean = git("rev-parse", "HEAD")
    assert found() == clean
    page.write_text("results, written by the code")
    (tmp_path / "notes.txt").touch()
    assert found() == clean
    other.write_text("changed = True")
    assert commit.commit_of(file) == clean, "it is asked for once in a process"
    assert found() == f"{clean}-dirty"
    git("commit", "-q", "-a", "-m", "changed")
    assert found() == git("rev-parse", "HEAD") != clean
