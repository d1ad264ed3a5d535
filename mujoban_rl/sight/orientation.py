"""Where a body that does not feel its heading faces.

The ball's steer joint is its heading. A body on a free root has a gyro alone, whose turns sum up to a heading since the
start of the episode; how that lies in the map only the frames tell. Lines of floor and walls, which are nearly always
in view, show it up to quarter turns; which of the four it is the skyline shows, the same in all episodes, wherever it
stands out above the walls (`skyline`). So a hand is kept for the lines, which turns four times as fast as the robot,
and beside it the odds of the four quarters, which each frame's skyline changes: two frames that leave two quarters each
may tell together which one it is.

Shapes: B robots, M ticks of any robots, F features of a frame, P proprioceptive values.
"""

from __future__ import annotations

import math
from typing import Final

import torch
from torch import Tensor, nn
from torch.nn import functional

from mujoban_core.bodies import Body
from mujoban_core.grid import CONTROL_PERIOD, turn_to_instruction
from mujoban_rl.sight.skyline import HEADINGS, Skyline, heading_loss, unit

_QUARTERS: Final = 4
NEEDLE: Final = _QUARTERS + 2
"""Components of the needle: log odds of the headings that are a quarter turn each from what the lines show, and the
hand of the lines, which turns four times as fast as the robot, so that quarter turns are alike."""
SIGHT: Final = HEADINGS + 2
"""What a frame shows of the heading: logits by the skyline, and the hand by the lines."""
_REMEMBERED: Final = 0.995
"""Share of the odds that stays from tick to tick: the skyline is out of view for long."""
_KEPT: Final = 0.9
"""The same for the hand, so that it settles within a second."""
_SURE: Final = 10.0
"""Log odds of the right quarter after a look around."""
_QUARTER: Final = math.tau / _QUARTERS
_SHORTEST: Final = 1e-3


class Compass(nn.Module):
    """The needle, and what reads the heading from a frame."""

    def __init__(self, body: Body, features: int) -> None:
        """Read F features."""
        super().__init__()
        self._part = body.proprio
        self.skyline = Skyline(body.camera)
        self.lines = nn.Linear(features, 2)

    def read(self, frame: Tensor, features: Tensor, proprio: Tensor) -> Tensor:
        """Return what frames show of the heading, [M, `SIGHT`].

        Args:
            frame: o_cam, [M, 64, 64, 3], up to 255.
            features: What the encoder made of it, [M, F].
            proprio: o_pr, [M, P].
        """
        return torch.cat([self.skyline(frame, proprio[:, self._part.up_axis]), self.lines(features)], -1)

    def forward(self, shown: Tensor, proprio: Tensor, needle: Tensor) -> Tensor:
        """Return the needle after one more tick, [B, `NEEDLE`].

        Args:
            shown: What the frame shows, [B, `SIGHT`].
            proprio: o_pr, [B, P].
            needle: Before the tick; zeros at an episode's start.
        """
        turned = CONTROL_PERIOD * self._part.turn_rate(proprio)
        odds, hand = needle.split((_QUARTERS, 2), -1)
        after = _KEPT * _turn(hand, _QUARTERS * turned) + shown[..., HEADINGS:]
        fine = _fine(after).detach()
        # The gyro's sum strays by ten degrees within 200 ticks; the lines hold it.
        passed = torch.round((_fine(hand) + turned - fine) / _QUARTER)
        odds = _REMEMBERED * _roll(odds, passed.long()) + _evidence(shown[..., :HEADINGS].detach(), fine)
        return torch.cat([odds, after], -1)


def needle_towards(heading: Tensor) -> Tensor:
    """Return needles that have come to point to headings in radians, [B] to [B, `NEEDLE`]."""
    hand = unit(_QUARTERS * heading)
    quarter = torch.round((heading - _fine(hand)) / _QUARTER).long() % _QUARTERS
    odds = _SURE * (functional.one_hot(quarter, _QUARTERS) - 1.0 / _QUARTERS)
    return torch.cat([odds, hand / (1.0 - _KEPT)], -1)


def sight_loss(shown: Tensor, heading: Tensor) -> Tensor:
    """Return how far what frames show, [..., `SIGHT`], is off headings in radians, [...]."""
    # Squares make the hand the mean of what may be: short where a frame shows little.
    lines = functional.mse_loss(shown[..., HEADINGS:], unit(_QUARTERS * heading))
    return lines + heading_loss(shown[..., :HEADINGS], heading)


def _turn(vector: Tensor, angle: Tensor) -> Tensor:
    """Return vectors [..., 2] turned to the left by angles [...]."""
    x, y = vector.unbind(-1)
    return torch.stack(turn_to_instruction(x, y, angle.cos(), -angle.sin()), -1)


def _fine(hand: Tensor) -> Tensor:
    """Return the heading that hands [..., 2] show, up to quarter turns, [...]; of none it is zero, with a slope."""
    near = _SHORTEST * (hand.detach().abs().sum(-1) < _SHORTEST)
    return torch.atan2(hand[..., 1], hand[..., 0] + near) / _QUARTERS


def _roll(odds: Tensor, passed: Tensor) -> Tensor:
    """Return odds [B, Q] after robots have passed so many quarters to the left, [B]."""
    quarters = torch.arange(_QUARTERS, device=odds.device)
    return odds.gather(-1, (quarters - passed[:, None]) % _QUARTERS)


def _evidence(logits: Tensor, fine: Tensor) -> Tensor:
    """Return the log odds, [B, Q], of quarters around `fine` and its turns, given what a skyline shows, [B, N]."""
    middle = torch.round(fine * (HEADINGS / math.tau)).long()
    every = torch.arange(HEADINGS, device=logits.device) - HEADINGS // (2 * _QUARTERS)
    around = logits.gather(-1, (middle[:, None] + every) % HEADINGS)
    shown = around.unflatten(-1, (_QUARTERS, -1)).logsumexp(-1)
    return shown - shown.mean(-1, keepdim=True)


def heading_of(needle: Tensor) -> Tensor:
    """Return the unit vectors in which needles point, [..., 2]: what the lines show, in the likeliest quarter."""
    odds, hand = needle.split((_QUARTERS, 2), -1)
    return unit(_fine(hand) + _QUARTER * odds.argmax(-1))
