"""A stack of oracles."""

import pytest

from bringup.command import Choice, Stack
from mujoban_core.plugins import ROLES


@pytest.fixture(scope="session")
def oracles():
    return Stack({role: Choice(role, "oracle") for role in ROLES})
