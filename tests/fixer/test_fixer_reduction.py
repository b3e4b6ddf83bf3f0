"""A network that looks at reduced views: what it corrects and copies comes back at full size."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from pydantic import ValidationError

from genre_tasks.config import FnetConfig
from genre_tasks.fixer.architectures import build_fnet, small_architecture
from genre_tasks.fixer.conditioning import build_conditions
from genre_tasks.fixer.inference import draw_noise, encode_reference, find_reduction, fix, reduce_images
from tests.fixer.conftest import random_views, toy


def test_an_untrained_fixer_returns_the_filled_render_at_full_size():
    fnet, views = toy(trained=False), random_views(2, 70, 101)
    out = fix(fnet, views, draw_noise(fnet, 0, range(2), 70, 101, reduction=3), reduction=3)
    torch.testing.assert_close(out, build_conditions(views).render, rtol=0, atol=1e-6)


def test_a_copied_source_stays_as_sharp_as_it_is(monkeypatch):
    """With a gate of 1 the image is the LiDAR map at full size, whatever the network sees."""
    opaque = torch.ones(1, 1, 64, 96)
    fnet, views = toy(), replace(random_views(1, 64, 96), alpha=opaque, lidar_alpha=opaque)
    # The mean colour may not drift, so that a source of the render's mean is copied.
    mean = build_conditions(views).render.mean((2, 3), keepdim=True)
    source = (mean + 0.2 * (torch.rand(1, 3, 64, 96) - 0.5)).clamp(0, 1)
    views = replace(views, lidar_color=source)

    def open_first_gate(inputs, noise, reference=None):
        output = torch.zeros(1, 6, *inputs.render.shape[-2:])
        output[:, 3] = 1
        return output

    monkeypatch.setattr(fnet, "predict", open_first_gate)
    out = fix(fnet, views, draw_noise(fnet, 0, range(1), 64, 96, reduction=2), reduction=2)
    assert (out - source).abs().max() < 0.03  # the bound on the mean colour moves all pixels alike


def test_the_network_sees_means_of_blocks(monkeypatch):
    fnet, views = toy(), random_views(1, 64, 96)
    seen = []
    predict = fnet.predict
    monkeypatch.setattr(fnet, "predict", lambda *args: seen.append(args[0]) or predict(*args))
    reference = encode_reference(fnet, views.reference[0], 2)
    out = fix(fnet, views, draw_noise(fnet, 0, range(1), 64, 96, reduction=2), reference, reduction=2)
    assert out.shape == (1, 3, 64, 96)
    small = build_conditions(views.map(lambda x: F.avg_pool2d(x, 2)))
    torch.testing.assert_close(seen[0].hints[..., :32, :48], small.hints)
    assert reference.latent.shape == draw_noise(fnet, 0, range(1), 64, 96, reduction=2).shape


def test_blocks_at_the_edge_repeat_it():
    image = torch.arange(15.0).reshape(1, 1, 3, 5)
    assert reduce_images(image, 2).tolist() == [[[[3, 5, 6.5], [10.5, 12.5, 14]]]]
    assert torch.equal(reduce_images(image, 1), image)
    assert find_reduction(640, 721, 1281) == 3


def test_a_network_that_draws_the_whole_image_is_not_reduced():
    architecture = replace(small_architecture((8, 8, 16, 16), 4, (16, 16)), residual=False)
    fnet = build_fnet(architecture).eval()
    with pytest.raises(ValueError, match="residual"):
        fix(fnet, random_views(1, 64, 96), draw_noise(fnet, 0, range(1), 64, 96, reduction=2), reduction=2)
    with pytest.raises(ValidationError, match="max_network_px"):
        FnetConfig(model="sd-turbo", weights="there", max_network_px=640)
