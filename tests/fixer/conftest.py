"""Toy fixers and views: the same classes as the shipped network, small enough for milliseconds."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from genre_tasks.fixer.architectures import build_fnet, small_architecture
from genre_tasks.fixer.inputs import FixerInputs
from genre_tasks.fixer.network import Fnet
from genre_tasks.logs.types import Lens
from genre_tasks.scene.chunk import Chunk, Points, View
from genre_tasks.scene.novel_views import NovelView, NovelViews


def toy(seed: int = 0, trained: bool = True) -> Fnet:
    """A toy network; ``trained`` gives the zero-initialised parts random weights, so that everything has an effect."""
    fnet = build_fnet(small_architecture((8, 8, 16, 16), 4, (16, 16)), seed)
    if trained:
        generator = torch.Generator().manual_seed(seed)
        for module in (*fnet.skips, fnet.vae.decoder.conv_out, fnet.unet.conv_out):
            for parameter in module.parameters():
                parameter.data = 0.1 * torch.randn(parameter.shape, generator=generator)
    return fnet.eval().requires_grad_(False)


def save_toy_sd_turbo(folder: Path) -> Path:
    """SD-Turbo's layout at toy size: four latent channels, text attention, image output, random weights."""
    from diffusers import AutoencoderKL, UNet2DConditionModel

    size = small_architecture((8, 8, 16, 16), 4, (16, 16))
    torch.manual_seed(0)
    AutoencoderKL(**{**size.vae, "out_channels": 3}).save_pretrained(folder / "vae")
    UNet2DConditionModel(**size.unet).save_pretrained(folder / "unet")
    return folder


def random_views(count: int, height: int, width: int, seed: int = 0) -> FixerInputs:
    """Views of random content with alpha between 0 and 1."""
    generator = torch.Generator().manual_seed(seed)

    def rand(channels: int) -> torch.Tensor:
        return torch.rand(count, channels, height, width, generator=generator)

    alpha, lidar_alpha, mask, other = rand(1), rand(1), (rand(1) > 0.5).float(), (rand(1) > 0.5).float()
    warps = (rand(3) * mask, mask, rand(1), rand(3) * other, other, rand(1))
    return FixerInputs(rand(3) * alpha, alpha, rand(3) * lidar_alpha, lidar_alpha, rand(3), *warps, rand(1))


@pytest.fixture
def scene() -> tuple[Chunk, NovelViews]:
    """A chunk of two source views and five novel views, 52 × 36 pixels (no multiple of the stride)."""
    width, height = 52, 36
    lens = Lens(50.0, 50.0, width / 2, height / 2, width, height)
    rng = np.random.default_rng(0)
    views = []
    for frame in (0, 4):
        buffer = io.BytesIO()
        Image.fromarray(rng.integers(0, 256, (height, width, 3), dtype=np.uint8)).save(buffer, "PNG")
        pose = np.eye(4)
        pose[2, 3] = frame
        views.append(View("front_camera", frame, "source", 0.1 * frame, pose, lens, buffer.getvalue()))
    points = Points(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros(0, bool), np.zeros(0, np.int16))
    chunk = Chunk(
        "synthetic",
        "toy",
        0,
        (0, 4),
        ("front_camera",),
        width,
        height,
        np.eye(4),
        np.stack([np.eye(4)] * 2),
        tuple(views),
        points,
        (),
        (),
    )
    novel = []
    for k in range(5):
        pose = np.eye(4)
        pose[0, 3] = 0.1 * k
        novel.append(NovelView("front_camera", 4 * (k % 2), 3.0, pose, lens, ("front_camera", 4 * (k % 2))))
    d = random_views(5, height, width)
    depth = torch.full((5, height, width), 8.0)
    channels_last = [x.permute(0, 2, 3, 1).contiguous() for x in (d.color, d.lidar_color)]
    alpha, lidar_alpha = d.alpha[:, 0], d.lidar_alpha[:, 0]
    return chunk, NovelViews(tuple(novel), channels_last[0], alpha, depth, channels_last[1], lidar_alpha, depth.clone())
