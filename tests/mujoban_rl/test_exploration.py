"""Noise by which actors explore."""

import numpy as np
import pytest
import torch

from mujoban_rl.exploration import Noise


def noise(kind, seed=0, robots=64):
    return Noise(kind, robots, 2, torch.Generator().manual_seed(seed))


def played(of, ticks=2_000):
    return torch.stack([of.draw() for _ in range(ticks)])


@pytest.mark.parametrize("kind", ["pink", "white"])
def test_each_draw_is_standard_normal(kind):
    drawn = played(noise(kind))
    assert drawn.mean().abs() < 0.03 and (drawn.std() - 1.0).abs() < 0.03
    assert (drawn[0].std() - 1.0).abs() < 0.2, "from an episode's first tick on"
    assert ((drawn.abs() < 1.0).float().mean() - 0.683).abs() < 0.02


def alike(drawn, lag):
    return float((drawn[lag:] * drawn[:-lag]).mean())


def test_pink_noise_is_alike_over_ticks_and_seconds_and_white_noise_is_not():
    pink, white = played(noise("pink")), played(noise("white"))
    assert alike(pink, 1) > 0.8 and 0.3 < alike(pink, 20) < 0.5 and alike(pink, 600) < 0.1
    assert abs(alike(white, 1)) < 0.02


def test_the_power_of_pink_noise_falls_as_one_over_the_frequency():
    spectrum = np.abs(np.fft.rfft(played(noise("pink"), 4096).numpy(), axis=0)) ** 2
    frequency = np.fft.rfftfreq(4096)
    between = (frequency > 1 / 500) & (frequency < 1 / 10)
    slope = np.polyfit(np.log(frequency[between]), np.log(spectrum.mean((1, 2))[between]), 1)[0]
    assert -1.3 < slope < -0.8


def test_noise_that_is_drawn_now_and_then_fades_as_fast():
    seldom = Noise("pink", 64, 2, torch.Generator().manual_seed(1), ticks=4)
    assert abs(alike(played(seldom), 1) - alike(played(noise("pink")), 4)) < 0.05


def test_robots_and_motors_are_independent_and_a_new_episode_begins_anew():
    of = noise("pink", robots=512)
    before = of.draw()
    assert abs(float((before[:, 0] * before[:, 1]).mean())) < 0.15
    of.renew(np.arange(256))
    after = of.draw()
    assert abs(float((before * after)[:256].mean())) < 0.15 and float((before * after)[256:].mean()) > 0.6


def test_noise_goes_on_where_it_stopped():
    of, other = noise("pink"), noise("pink", seed=5)
    played(of, 3)
    other.restore(of.state())
    of._generator, other._generator = (torch.Generator().manual_seed(7) for _ in range(2))
    assert torch.equal(played(of, 3), played(other, 3))


def test_an_unknown_noise_is_named():
    with pytest.raises(ValueError, match="exploration 'brown': expected one of pink, white"):
        noise("brown")
