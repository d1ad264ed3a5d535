"""Processes that are started with an environment of their own."""

import os

import pytest

from mujoban_core import children


@pytest.mark.parametrize("own", [None, "glibc.malloc.arena_max=2"])
def test_settings_of_the_c_library_are_as_before(monkeypatch: pytest.MonkeyPatch, own: str | None) -> None:
    monkeypatch.delenv("GLIBC_TUNABLES", raising=False)
    if own is not None:
        monkeypatch.setenv("GLIBC_TUNABLES", own)
    with pytest.raises(OSError), children.large_pages():
        assert os.environ["GLIBC_TUNABLES"] == (own or "glibc.malloc.hugetlb=1")
        raise OSError
    assert os.environ.get("GLIBC_TUNABLES") == own
