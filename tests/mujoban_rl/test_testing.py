"""The trainer of docs/rl.md, as it stands there, keeps what every trainer promises; trainers that do not are caught."""

import math
from pathlib import Path

import pytest
import torch

from mujoban_rl.testing import check_refusal, check_resuming

PAGE = Path(__file__).parents[2] / "docs" / "rl.md"


@pytest.fixture
def example():
    code = PAGE.read_text().split("```python\n")[1].split("```")[0]
    names = {"__name__": "example"}
    exec(compile(code, str(PAGE), "exec"), names)
    return names


def poison(batch):
    return batch[0] * math.nan, batch[1]


def test_the_documented_trainer_resumes_to_the_bit_and_refuses_nan(example, tmp_path):
    check_resuming(example["trainer"], tmp_path, stop_at=3, updates=6)
    check_refusal(example["trainer"](tmp_path / "nan"), poison)


def test_a_source_that_forgets_where_it_was_is_caught(example, tmp_path):
    example["Levels"].restore = lambda self, state: None
    with pytest.raises(AssertionError, match="differ"):
        check_resuming(example["trainer"], tmp_path, stop_at=3, updates=6)


def test_a_learner_that_steps_whatever_comes_is_caught(example, tmp_path):
    def update(self, batch, progress, guard):
        self.adam.zero_grad()
        loss = (self.net(batch[0])[:, 0] - batch[1]).square().mean()
        loss.backward()
        self.adam.step()
        guard.accept(loss.detach())
        return {}

    example["MoveCounter"].update = update
    torch.manual_seed(0)
    with pytest.raises(AssertionError, match="NaN changed"):
        check_refusal(example["trainer"](tmp_path), poison)
