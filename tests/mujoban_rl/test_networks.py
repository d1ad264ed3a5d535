"""Distributions over torques that the world limits, and the precision and width in which frames are encoded."""

import math

import pytest
import torch

from mujoban_rl.networks import Gaussian, encode_frames, frame_encoder


def test_torques_beyond_a_limit_have_the_probability_of_the_tail():
    policy = Gaussian(torch.tensor([0.5]), torch.tensor([0.25]))
    inside = policy.limited_log_prob(torch.tensor([0.75])).item()
    assert inside == pytest.approx(-0.5 - math.log(0.25 * math.sqrt(2 * math.pi)))
    above, far, below = (policy.limited_log_prob(torch.tensor([a])).item() for a in (1.0, 3.0, -1.5))
    # Of a normal distribution 2.275 % lie more than two deviations above its mean.
    assert above == far == pytest.approx(math.log(0.02275), rel=1e-3)
    assert below == pytest.approx(math.log(9.866e-10), rel=1e-3)
    both = Gaussian(torch.tensor([0.5, 0.5]), torch.tensor([0.25, 0.25]))
    assert both.limited_log_prob(torch.tensor([0.75, 3.0])).item() == pytest.approx(inside + above)


def test_what_the_world_does_not_see_teaches_a_mean_beyond_a_limit_nothing():
    """All draws are the same torque to the world, so noise in their rewards must not move the policy."""
    mean, scale = torch.tensor([3.0, -1e4]).requires_grad_(), torch.tensor([0.2, 1e-3]).requires_grad_()
    policy = Gaussian(mean, scale)
    drawn = torch.stack([policy.sample(torch.Generator().manual_seed(seed)) for seed in range(64)]).detach()
    gains = torch.randn(64, generator=torch.Generator().manual_seed(1))
    (gains * policy.limited_log_prob(drawn)).sum().backward()
    assert mean.grad is not None and scale.grad is not None
    assert mean.grad.abs().max() < 1e-6 and scale.grad.abs().max() < 1e-6


@pytest.mark.parametrize(("capability", "precision"), [("avx512_bf16", torch.bfloat16), ("avx2", torch.float32)])
def test_frames_are_encoded_in_bfloat16_only_where_the_processor_has_instructions_for_it(
    monkeypatch, capability, precision
):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {capability: True}, raising=False)
    computed = []
    encoder = torch.nn.Conv2d(3, 2, 3)
    encoder.register_forward_hook(lambda module, inputs, output: computed.append(output.dtype))
    frame = torch.zeros(1, 8, 8, 3, dtype=torch.uint8)
    features = encode_frames(encoder, frame, torch.float32, mixed_precision=True)
    assert computed == [precision] and features.dtype == torch.float32


@pytest.mark.parametrize("channels", [(8,), (4, 8), (8, 7, 8)])
def test_an_encoder_too_narrow_for_sound_gradients_is_refused(channels):
    with pytest.raises(ValueError, match=r"channels .*: expected .* each at least 8"):
        frame_encoder(channels, 16, 40)
