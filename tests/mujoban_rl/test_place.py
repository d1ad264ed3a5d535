"""How where in its cell a robot is, is kept."""

from __future__ import annotations

import math

import pytest
import torch

from mujoban_rl.sight.place import PLACE, Place, cells_off, phases, phases_along, place_loss, way_left

POSES = torch.tensor(
    [[1.5, -0.5, 0.3], [1.6, -0.7, 0.3], [-2.2, 3.35, 1.8], [0.9, 0.1, -1.4], [-3.3, -1.05, 3.0], [2.0, 2.0, -2.9]]
)
QUARTERS = torch.tensor([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])


def _heading(pose: torch.Tensor) -> torch.Tensor:
    return torch.stack([pose[:, 2].cos(), pose[:, 2].sin()], -1)


def _shown(pose: torch.Tensor) -> torch.Tensor:
    """Return what a frame shows to a robot at a pose, which sees it along the axis that it faces."""
    quarter = torch.round(pose[:, 2] / (math.pi / 2)) * (math.pi / 2)
    x, y = pose[:, :2].unbind(-1)
    ahead, left = x * quarter.cos() + y * quarter.sin(), y * quarter.cos() - x * quarter.sin()
    return phases(torch.stack([ahead, left], -1), 1.0)


def test_the_middle_of_every_cell_is_at_zero() -> None:
    middles = torch.tensor([[0.5, 2.5, 0.0], [-1.5, -0.5, 2.0]])
    torch.testing.assert_close(phases(middles, 1.0), torch.tensor([[1.0, 1.0, 0.0, 0.0]] * 2), atol=1e-5, rtol=0.0)
    torch.testing.assert_close(phases(3.0 * middles, 3.0), phases(middles, 1.0))


def test_what_is_seen_counts_along_the_axis_that_the_robot_faces() -> None:
    assert float(place_loss(_shown(POSES), POSES, 1.0)) == pytest.approx(0.0, abs=1e-9)
    place, heading = Place(8), _heading(POSES)
    needles = torch.zeros(len(POSES), PLACE)
    for _ in range(5):
        needles = place(_shown(POSES), heading, torch.zeros(len(POSES), 2), needles)
    assert cells_off(needles, POSES, 1.0).max() < 1e-5


def test_needles_go_with_the_robot_where_it_sees_nothing() -> None:
    place, pose = Place(8), POSES.clone()
    needles = place(_shown(pose), _heading(pose), torch.zeros(len(pose), 2), torch.zeros(len(pose), PLACE))
    moved = torch.tensor([[0.04, -0.07]]).expand(len(pose), 2)
    for _ in range(20):
        pose[:, :2] += moved
        needles = place(torch.zeros(len(pose), PLACE), _heading(pose), moved, needles)
    assert cells_off(needles, pose, 1.0).max() < 1e-4


@pytest.mark.parametrize("axis", QUARTERS)
def test_phases_along_an_instruction_are_those_of_the_place_turned_with_it(axis) -> None:
    x, y = POSES[:, 0], POSES[:, 1]
    turned = torch.stack([x * axis[0] + y * axis[1], y * axis[0] - x * axis[1]], -1)
    torch.testing.assert_close(phases_along(phases(POSES, 1.0), axis), phases(turned, 1.0), atol=1e-5, rtol=0.0)


@pytest.mark.parametrize("step", [[0.0, 0.0], [1.0, 0.0], [0.0, -1.0]])
def test_the_way_left_is_the_way_to_the_cell_beside_that_in_which_the_instruction_began(step) -> None:
    began, since = torch.tensor([[1.8, -0.1]]), torch.tensor([[0.55, -0.55], [-0.9, 0.3], [0.0, 0.0]])
    place = phases(began + since, 1.0).requires_grad_()
    way = way_left(place, since, torch.tensor([step]))
    torch.testing.assert_close(way, torch.tensor([[1.5, -0.5]]) + torch.tensor([step]) - began - since)
    assert not way.requires_grad
