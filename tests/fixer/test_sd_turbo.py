"""SD-Turbo's real shapes on random weights: loads, runs, trains one step, saves and reloads its adapters."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from genre_tasks.fixer.architectures import load_sd_turbo
from genre_tasks.fixer.training import train
from genre_tasks.fixer.training_settings import PRESETS
from genre_tasks.fixer.weights import load_fnet, save_fnet, trainable_state
from tests.fixer.test_fixer_pairs import some_pairs

VAE = {
    "down_block_types": ("DownEncoderBlock2D",) * 4,
    "up_block_types": ("UpDecoderBlock2D",) * 4,
    "block_out_channels": (128, 256, 512, 512),
    "layers_per_block": 2,
    "latent_channels": 4,
    "sample_size": 768,
}
UNET = {
    "sample_size": 64,
    "block_out_channels": (320, 640, 1280, 1280),
    "layers_per_block": 2,
    "attention_head_dim": (5, 10, 20, 20),
    "cross_attention_dim": 1024,
    "use_linear_projection": True,
    "down_block_types": (*(("CrossAttnDownBlock2D",) * 3), "DownBlock2D"),
    "up_block_types": ("UpBlock2D", *(("CrossAttnUpBlock2D",) * 3)),
}
"""The configurations in `stabilityai/sd-turbo`."""


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Random weights in half precision, as they are published."""
    from diffusers import AutoencoderKL, UNet2DConditionModel

    folder = tmp_path_factory.mktemp("sd-turbo")
    torch.manual_seed(0)
    AutoencoderKL(**VAE).half().save_pretrained(folder / "vae")
    UNet2DConditionModel(**UNET).half().save_pretrained(folder / "unet")
    return folder


@pytest.mark.slow
def test_real_shapes_train_a_step_save_and_reload(base, tmp_path):
    network = load_sd_turbo(str(base), rank=16).float()
    count = sum(p.numel() for p in network.unet.parameters()) + sum(p.numel() for p in network.vae.parameters())
    assert 0.8e9 < count < 1.1e9
    trained = sum(p.numel() for p in trainable_state(network).values())
    assert trained < 0.06 * count
    # Pairs have 320 × 180 pixels, and SD-Turbo a stride of 64.
    height, width = PRESETS["paper"].crop
    assert height <= 180 and width <= 320 and height % 64 == width % 64 == 0
    settings = replace(PRESETS["paper"], steps=1, batch=1, crop=(64, 64), warmup=1, perceptual=0.0, half=False)

    def distance(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        return (a - b).square().mean((1, 2, 3))

    before = {name: p.detach().clone() for name, p in trainable_state(network).items()}
    frozen = network.unet.conv_in.weight.detach().clone()
    after = train(some_pairs(1, 64, 64), settings, tmp_path / "run", distance, start=network)
    moved = [name for name, p in trainable_state(after).items() if not torch.equal(p, before[name])]
    assert moved and torch.equal(after.unet.conv_in.weight, frozen)
    save_fnet(after, tmp_path / "fnet.safetensors", base=str(base), rank=16)
    stored = load_file(tmp_path / "fnet.safetensors")
    assert set(stored) == set(before) and (tmp_path / "fnet.safetensors").stat().st_size < 0.06 * 2 * count
    again = trainable_state(load_fnet(tmp_path, "sd-turbo").requires_grad_(True))
    assert all(torch.equal(again[name], value.float()) for name, value in stored.items())
