"""FNet's network: a one-step diffusion fixer of diffusers classes (paper Sec. III-B).

One code path for two configurations: ``small`` (sized for CPUs, trained from nothing) and ``sd-turbo`` (the paper's).
Images are sRGB in [0, 1], [B, 3, H, W]; inside the autoencoder they are in [−1, 1].
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from genre_tasks.fixer.attention import mix_views, remove_text_attention

HINTS = 19
"""Channels of ``Conditions.hints``: render alpha, LiDAR alpha; source images looked up by rendered depth (3) and where
they see it; the same by the LiDAR map's depth; six maps of agreement and sharpness, three of how sure the depths are
(``conditioning``)."""

GATES = 3
"""Sources that a corrected render may copy from: LiDAR map, images by rendered depth, images by the map's depth."""


INPUTS = ("render", "reference", "lidar")
"""What a view can be fixed from (paper Table 3)."""


@dataclass(frozen=True)
class FnetArchitecture:
    """What makes a network: the configurations of the two diffusers models, and how the output is formed.

    ``residual``: the decoder predicts a correction of the render (see :func:`corrected`), so that an untrained fixer is
    the identity; without it the decoder's image is the output, as in SD-Turbo. ``inputs``: those of ``INPUTS`` that it
    is trained with; the others are blank.
    """

    vae: dict[str, Any]
    unet: dict[str, Any]
    residual: bool
    timestep: int = 200
    inputs: tuple[str, ...] = INPUTS

    def __post_init__(self) -> None:
        object.__setattr__(self, "inputs", tuple(self.inputs))  # a list, from JSON
        stray = [name for name in self.inputs if name not in INPUTS]
        if stray or not self.inputs:
            raise ValueError(f"expected inputs among {', '.join(INPUTS)}, got {', '.join(stray) or 'none'}")

    def as_json(self) -> dict[str, Any]:
        """Plain values for the JSON beside the weights."""
        return asdict(self)


@dataclass(frozen=True)
class Conditions:
    """What a batch of B views is fixed from; H and W are multiples of ``Fnet.stride``.

    ``render`` has its holes filled; ``lidar`` is on black; ``reference`` is a source image from another viewpoint;
    ``hints`` are pixel-aligned with the render (see ``HINTS``).
    """

    render: Tensor  # [B, 3, H, W]
    reference: Tensor  # [B, 3, H, W]
    lidar: Tensor  # [B, 3, H, W]
    hints: Tensor  # [B, HINTS, H, W]


@dataclass(frozen=True)
class Encoded:
    """An image behind the encoder: scaled latent [B, C, h, w] and the encoder's features, finest first."""

    latent: Tensor
    features: tuple[Tensor, ...]


class Fnet(nn.Module):
    """The fixer: shared encoder, view-mixing UNet at one timestep, decoder with skip connections."""

    def __init__(self, vae: Any, unet: Any, architecture: FnetArchitecture) -> None:
        """Of an ``AutoencoderKL`` and a ``UNet2DConditionModel`` (``Any``: their attributes are made dynamically)."""
        super().__init__()
        remove_text_attention(unet)
        mix_views(unet)
        self.vae: Any = vae
        self.unet: Any = unet
        self.architecture = architecture
        widths = vae.config.block_out_channels
        encoder_out = [widths[0], *widths[:-1]]  # what enters each down block: conv_in's output, then each block's
        decoder_in = [*widths[1:], widths[-1]]  # what enters the up block of the same resolution
        self.skips = nn.ModuleList(
            nn.Conv2d(2 * c_in + HINTS, c_out, 1) for c_in, c_out in zip(encoder_out, decoder_in, strict=True)
        )
        for skip in self.skips:
            assert isinstance(skip, nn.Conv2d) and skip.bias is not None
            nn.init.zeros_(skip.weight)
            nn.init.zeros_(skip.bias)
        self.sigma, self.input_scale = noise_level(architecture.timestep)

    @property
    def stride(self) -> int:
        """Image sizes must be multiples of it: the autoencoder's stride times the UNet's."""
        return self.latent_stride * 2 ** (len(self.unet.config.block_out_channels) - 1)

    @property
    def latent_stride(self) -> int:
        """Pixels per latent."""
        return int(2 ** (len(self.vae.config.block_out_channels) - 1))

    def encode(self, image: Tensor) -> Encoded:
        """[B, 3, H, W] → the posterior's mode, scaled, with the features that enter each down block."""
        encoder = self.vae.encoder
        x = encoder.conv_in(image * 2 - 1)
        features = []
        for block in encoder.down_blocks:
            features.append(x)
            x = block(x)
        x = encoder.conv_out(encoder.conv_act(encoder.conv_norm_out(encoder.mid_block(x))))
        if self.vae.quant_conv is not None:
            x = self.vae.quant_conv(x)
        return Encoded(x.chunk(2, 1)[0] * self.vae.config.scaling_factor, tuple(features))

    def denoise(self, render: Tensor, reference: Tensor, lidar: Tensor, noise: Tensor) -> Tensor:
        """z̃ = z_τ − σ_τ ε̃ with z_τ = z_render + σ_τ ε; all [B, C, h, w]; reference and LiDAR stay clean."""
        noisy = render + self.sigma * noise
        # only the noisy latent is scaled, as the scheduler does for its σ; a clean latent has σ = 0 and scale 1
        views = torch.stack([noisy * self.input_scale, reference, lidar], 1)
        predicted = self.unet(
            views.flatten(0, 1), self.architecture.timestep, None, cross_attention_kwargs={"views": views.shape[1]}
        ).sample
        return noisy - self.sigma * predicted.unflatten(0, views.shape[:2])[:, 0]

    def decode(self, latent: Tensor, render: Encoded, lidar: Encoded, inputs: Conditions) -> Tensor:
        """The image [B, 3, H, W], not clamped, of a latent and what the skip connections bring."""
        decoder = self.vae.decoder
        z = latent / self.vae.config.scaling_factor
        if self.vae.post_quant_conv is not None:
            z = self.vae.post_quant_conv(z)
        x = decoder.mid_block(decoder.conv_in(z))
        levels = list(zip(self.skips, render.features, lidar.features, strict=True))
        for block, (skip, ours, points) in zip(decoder.up_blocks, reversed(levels), strict=True):
            pooled = F.adaptive_avg_pool2d(inputs.hints, (ours.shape[-2], ours.shape[-1]))
            added = skip(torch.cat([ours, points, pooled], 1))
            x = block(_unit(x) + _unit(added) if self.architecture.residual else x + added)
        x = decoder.conv_out(decoder.conv_act(decoder.conv_norm_out(x))).to(inputs.render.dtype) / 2  # autocast ends
        return corrected(x, inputs) if self.architecture.residual else x + 0.5

    def forward(self, conditions: Conditions, noise: Tensor, reference: Encoded | None = None) -> Tensor:
        """The fixed images [B, 3, H, W], not clamped (a loss needs the gradient beyond 0 and 1).

        ``noise`` [B, C, h, w] is standard normal; ``reference`` may be passed where it is already encoded.
        Raises ``ValueError`` for sizes that are no multiple of ``stride``.
        """
        height, width = conditions.render.shape[-2:]
        if height % self.stride or width % self.stride:
            raise ValueError(f"expected sizes that are multiples of {self.stride}, got {height} × {width}")
        render, lidar = self.encode(conditions.render), self.encode(conditions.lidar)
        reference = self.encode(conditions.reference) if reference is None else reference
        latent = self.denoise(render.latent, reference.latent, lidar.latent, noise)
        return self.decode(latent, render, lidar, conditions)

    def noise_shape(self, height: int, width: int) -> tuple[int, int, int]:
        """Shape of one view's noise, [C, h, w]."""
        return int(self.vae.config.latent_channels), height // self.latent_stride, width // self.latent_stride


def _unit(x: Tensor) -> Tensor:
    """Each sample at root mean square 1, so that latent and skip are of one weight: a decoder trained for hundreds of
    steps grows its activations from level to level into the thousands (its normalisations hide that)."""
    return x / x.float().square().mean((1, 2, 3), keepdim=True).clamp_min(1e-12).sqrt().to(x.dtype)


def corrected(output: Tensor, inputs: Conditions) -> Tensor:
    """The render plus a residual, plus gates times what the aligned sources have that the render has not.

    ``output`` [B, 3 + GATES, H, W]. A gate of 1 copies its source's pixel (LiDAR map, the two warps):
    sharp detail that exists is carried over and not drawn anew.
    """
    out = inputs.render + output[:, :3]
    lidar_alpha, warped, mask = inputs.hints[:, 1:2], inputs.hints[:, 2:5], inputs.hints[:, 5:6]
    lidar_warped, lidar_mask = inputs.hints[:, 6:9], inputs.hints[:, 9:10]
    sources = ((inputs.lidar, lidar_alpha), (warped, mask), (lidar_warped, lidar_mask))
    for k, (image, cover) in enumerate(sources):  # images are premultiplied: no division where they are empty
        out = out + output[:, 3 + k : 4 + k] * (image - cover * inputs.render)
    return out


def noise_level(timestep: int) -> tuple[float, float]:
    """σ_τ of Stable Diffusion's schedule, and its schedulers' factor on the UNet's input, 1 / √(1 + σ_τ²)."""
    from diffusers import EulerDiscreteScheduler

    scheduler: Any = EulerDiscreteScheduler(beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear")
    alpha = float(scheduler.alphas_cumprod[timestep])
    sigma = ((1 - alpha) / alpha) ** 0.5
    return sigma, (1 + sigma**2) ** -0.5


def small_architecture(
    widths: tuple[int, ...] = (24, 32, 48, 64), latent_channels: int = 8, unet_widths: tuple[int, ...] = (32, 64)
) -> FnetArchitecture:
    """The default network: the same classes, sized for CPUs."""
    blocks = len(widths)
    depth = len(unet_widths)
    return FnetArchitecture(
        vae={
            "down_block_types": ("DownEncoderBlock2D",) * blocks,
            "up_block_types": ("UpDecoderBlock2D",) * blocks,
            "block_out_channels": widths,
            "layers_per_block": 1,
            "latent_channels": latent_channels,
            "out_channels": 3 + GATES,
            "norm_num_groups": 8,
            "mid_block_add_attention": False,
            "scaling_factor": 1.0,
        },
        unet={
            "in_channels": latent_channels,
            "out_channels": latent_channels,
            "block_out_channels": unet_widths,
            "down_block_types": ("CrossAttnDownBlock2D",) * depth,
            "up_block_types": ("CrossAttnUpBlock2D",) * depth,
            "layers_per_block": 1,
            "attention_head_dim": 1,  # heads (diffusers' name is historical): on CPUs attention costs by the head
            "cross_attention_dim": 8,
            "norm_num_groups": 8,
        },
        residual=True,
    )


def build(architecture: FnetArchitecture, seed: int = 0) -> Fnet:
    """A network with random weights of a seed; the global random state is left as it was."""
    from diffusers import AutoencoderKL, UNet2DConditionModel

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        vae = AutoencoderKL(**architecture.vae)
        unet = UNet2DConditionModel(**architecture.unet)
        fnet = Fnet(vae, unet, architecture)
    if architecture.residual:
        restart_residual(fnet)
    return fnet


def restart_residual(fnet: Fnet, seed: int = 0) -> None:
    """Zeroes the last convolutions of decoder and UNet, in place: the fixer is the identity until it is trained.

    Its skips may then start at random: at full strength, from the first step, they bring what the latent has lost.
    """
    for last in (fnet.vae.decoder.conv_out, fnet.unet.conv_out):
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
    generator = torch.Generator().manual_seed(seed)
    for skip in fnet.skips:
        assert isinstance(skip, nn.Conv2d)
        nn.init.normal_(skip.weight, std=2 * skip.in_channels**-0.5, generator=generator)


def sd_turbo(source: str, timestep: int = 200, rank: int = 16) -> Fnet:
    """SD-Turbo from a local folder or a hub id (subfolders ``vae`` and ``unet``), with untrained LoRA adapters.

    Raises ``InputError`` where it cannot be loaded.
    """
    from diffusers import AutoencoderKL, UNet2DConditionModel

    from genre_tasks.errors import InputError

    try:
        vae = AutoencoderKL.from_pretrained(source, subfolder="vae")
        unet = UNet2DConditionModel.from_pretrained(source, subfolder="unet")
    except (OSError, ValueError) as error:
        raise InputError(
            f"SD-Turbo cannot be loaded: {str(error).splitlines()[0]}",
            remedy="Give by `fnet.weights` a folder with the subfolders vae and unet in diffusers' layout.",
            file=source,
            stage="fnet",
        ) from error
    fnet = Fnet(vae, unet, FnetArchitecture(dict(vae.config), dict(unet.config), residual=False, timestep=timestep))
    add_lora(fnet, rank)
    return fnet


def add_lora(fnet: Fnet, rank: int, seed: int = 0) -> None:
    """Low-rank adapters on UNet and decoder, in place; everything but them and the skips is frozen (paper III-B)."""
    from peft import LoraConfig

    attention = r"to_q|to_k|to_v|to_out\.0"
    fnet.requires_grad_(False)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        unet = rf".*({attention}|conv1|conv2|proj_in|proj_out)"
        fnet.unet.add_adapter(LoraConfig(r=rank, lora_alpha=rank, target_modules=unet))
        decoder = rf"decoder\..*({attention}|conv1|conv2|conv)"
        fnet.vae.add_adapter(LoraConfig(r=rank, lora_alpha=rank, target_modules=decoder))
    fnet.skips.requires_grad_(True)
