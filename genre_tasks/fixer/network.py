"""FNet's network: a one-step diffusion fixer of diffusers classes (paper Sec. III-B).

One code path serves two configurations, which ``architectures`` builds: ``small`` (sized for CPUs, trained from
nothing) and ``sd-turbo`` (the paper's). Images are sRGB in [0, 1], [B, 3, H, W]; inside the autoencoder they are in
[−1, 1].
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from genre_tasks.fixer.attention import mix_views, remove_text_attention

HINT_CHANNELS = 19
"""Channels of ``Conditions.hints``: render alpha, LiDAR alpha; source images sampled by rendered depth (3) and where
they see it; the same by the LiDAR map's depth; six maps of agreement and sharpness, three of how sure the depths are
(``conditioning``)."""

GATE_COUNT = 3
"""Sources that a corrected render may copy from: LiDAR map, images by rendered depth, images by the map's depth."""

INPUTS = ("render", "reference", "lidar")
"""What a view can be fixed from (paper Table 3)."""


@dataclass(frozen=True)
class FnetArchitecture:
    """What makes a network: the configurations of the two diffusers models, and how the output is formed.

    Attributes:
        vae: arguments of ``AutoencoderKL``.
        unet: arguments of ``UNet2DConditionModel``.
        residual: the decoder predicts a correction of the render (see :func:`apply_correction`), so that an untrained
            fixer is the identity. Without it the decoder's image is the output, as in SD-Turbo.
        timestep: of the diffusion schedule, τ in the paper.
        inputs: those of ``INPUTS`` that it is trained with; the others are blank.
    """

    vae: dict[str, Any]
    unet: dict[str, Any]
    residual: bool
    timestep: int = 200
    inputs: tuple[str, ...] = INPUTS

    def __post_init__(self) -> None:
        # JSON has lists, which would make two equal architectures differ.
        object.__setattr__(self, "inputs", tuple(self.inputs))  # JSON has lists
        stray = [name for name in self.inputs if name not in INPUTS]
        if stray or not self.inputs:
            raise ValueError(f"expected inputs among {', '.join(INPUTS)}, got {', '.join(stray) or 'none'}")

    def as_json(self) -> dict[str, Any]:
        """Converts to plain values, for the JSON next to the weights.

        Returns:
            The fields by name.
        """
        return asdict(self)


@dataclass(frozen=True)
class Conditions:
    """What the network fixes a batch of B views from; H and W are multiples of ``Fnet.stride``.

    Attributes:
        render: [B, 3, H, W] the rendered view, its holes filled.
        reference: [B, 3, H, W] a source image from another viewpoint.
        lidar: [B, 3, H, W] the LiDAR map on black.
        hints: [B, HINT_CHANNELS, H, W] maps that are pixel-aligned with the render, see ``HINT_CHANNELS``.
    """

    render: Tensor
    reference: Tensor
    lidar: Tensor
    hints: Tensor


@dataclass(frozen=True)
class Encoded:
    """An image behind the encoder.

    Attributes:
        latent: [B, C, h, w] scaled.
        features: the encoder's features, finest first.
    """

    latent: Tensor
    features: tuple[Tensor, ...]


class Fnet(nn.Module):
    """The fixer: a shared encoder, a view-mixing UNet at one timestep, and a decoder with skip connections.

    Attributes:
        vae: the ``AutoencoderKL``.
        unet: the ``UNet2DConditionModel``, without text attention.
        skips: one convolution for each level, from the encoder's features and the hints to the decoder.
        architecture: what the network was built from.
        sigma: the noise's standard deviation at the timestep.
        input_scale: factor on the UNet's noisy input.
    """

    def __init__(self, vae: Any, unet: Any, architecture: FnetArchitecture) -> None:
        """Joins an autoencoder and a UNet; the skip connections begin at zero.

        Args:
            vae: an ``AutoencoderKL`` (``Any``, because its attributes are made dynamically).
            unet: a ``UNet2DConditionModel``, changed in place.
            architecture: of the two.
        """
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
            nn.Conv2d(2 * c_in + HINT_CHANNELS, c_out, 1) for c_in, c_out in zip(encoder_out, decoder_in, strict=True)
        )
        # At zero the skips change nothing, so that pretrained weights begin as they were trained.
        for skip in self.skips:
            assert isinstance(skip, nn.Conv2d) and skip.bias is not None
            nn.init.zeros_(skip.weight)
            nn.init.zeros_(skip.bias)
        self.sigma, self.input_scale = compute_noise_level(architecture.timestep)

    @property
    def stride(self) -> int:
        """Image sizes must be multiples of it: the autoencoder's stride times the UNet's."""
        return self.latent_stride * 2 ** (len(self.unet.config.block_out_channels) - 1)

    @property
    def latent_stride(self) -> int:
        """Pixels per latent."""
        return int(2 ** (len(self.vae.config.block_out_channels) - 1))

    def encode(self, image: Tensor) -> Encoded:
        """Encodes an image to the posterior's mode, and keeps the features that enter each down block.

        Args:
            image: [B, 3, H, W] in [0, 1].

        Returns:
            The scaled latent and the features.
        """
        encoder = self.vae.encoder
        x = encoder.conv_in(image * 2 - 1)
        features = []
        for block in encoder.down_blocks:
            features.append(x)
            x = block(x)
        x = encoder.conv_out(encoder.conv_act(encoder.conv_norm_out(encoder.mid_block(x))))
        # diffusers can build an autoencoder without this layer.
        if self.vae.quant_conv is not None:
            x = self.vae.quant_conv(x)
        # The mode and not a sample: the same image must give the same latent.
        return Encoded(x.chunk(2, 1)[0] * self.vae.config.scaling_factor, tuple(features))

    def denoise(self, render: Tensor, reference: Tensor, lidar: Tensor, noise: Tensor) -> Tensor:
        """Takes one step of diffusion: z̃ = z_τ − σ_τ ε̃ with z_τ = z_render + σ_τ ε (paper Sec. III-B).

        Args:
            render: [B, C, h, w] latent of the render, the only one that noise is added to.
            reference: [B, C, h, w] latent of the reference.
            lidar: [B, C, h, w] latent of the LiDAR map.
            noise: [B, C, h, w] standard normal, ε.

        Returns:
            [B, C, h, w] the fixed latent.
        """
        noisy = render + self.sigma * noise
        # Only the noisy latent is scaled, as the scheduler does for its σ: a clean latent has σ = 0 and scale 1.
        # Only the first entry's output is used. The order of the others does not matter: attention knows no positions.
        views = torch.stack([noisy * self.input_scale, reference, lidar], 1)
        predicted = self.unet(
            views.flatten(0, 1), self.architecture.timestep, None, cross_attention_kwargs={"views": views.shape[1]}
        ).sample
        return noisy - self.sigma * predicted.unflatten(0, views.shape[:2])[:, 0]

    def decode(self, latent: Tensor, render: Encoded, lidar: Encoded, inputs: Conditions) -> Tensor:
        """Decodes a latent with what the skip connections bring.

        Args:
            latent: [B, C, h, w] from :meth:`denoise`.
            render: the encoded render.
            lidar: the encoded LiDAR map.
            inputs: of the batch; their hints enter at every level.

        Returns:
            [B, 3 + GATE_COUNT, H, W] what makes the image, see :meth:`compose`.
        """
        decoder = self.vae.decoder
        z = latent / self.vae.config.scaling_factor
        if self.vae.post_quant_conv is not None:
            z = self.vae.post_quant_conv(z)
        x = decoder.mid_block(decoder.conv_in(z))
        levels = list(zip(self.skips, render.features, lidar.features, strict=True))
        for block, (skip, render_features, lidar_features) in zip(decoder.up_blocks, reversed(levels), strict=True):
            # Hints are of full resolution; each level takes their mean over its own pixels.
            hints = F.adaptive_avg_pool2d(inputs.hints, (render_features.shape[-2], render_features.shape[-1]))
            added = skip(torch.cat([render_features, lidar_features, hints], 1))
            x = block(_normalise(x) + _normalise(added) if self.architecture.residual else x + added)
        # Autocast ends here: the output is of the inputs' type.
        return decoder.conv_out(decoder.conv_act(decoder.conv_norm_out(x))).to(inputs.render.dtype) / 2

    def compose(self, output: Tensor, inputs: Conditions) -> Tensor:
        """Makes the image of what the decoder gives.

        Args:
            output: [B, 3 + GATE_COUNT, H, W] residual and gates; [B, 3, H, W] of an architecture without residual.
            inputs: of the batch, of the same H and W.

        Returns:
            [B, 3, H, W] the image, not clamped.
        """
        return apply_correction(output, inputs) if self.architecture.residual else output + 0.5

    def forward(self, conditions: Conditions, noise: Tensor, reference: Encoded | None = None) -> Tensor:
        """Fixes a batch of views.

        Args:
            conditions: of the batch; sizes are multiples of :attr:`stride`.
            noise: [B, C, h, w] standard normal, of :meth:`noise_shape`.
            reference: the encoded references, where they are at hand.

        Returns:
            [B, 3, H, W] the fixed images, not clamped, because a loss needs the gradient outside of 0 and 1.

        Raises:
            ValueError: a size is no multiple of :attr:`stride`.
        """
        return self.compose(self.predict(conditions, noise, reference), conditions)

    def predict(self, conditions: Conditions, noise: Tensor, reference: Encoded | None = None) -> Tensor:
        """Predicts what makes the images of a batch, without making them; see :meth:`forward` for the arguments.

        Args:
            conditions: of the batch.
            noise: of the batch.
            reference: the encoded references, where they are at hand.

        Returns:
            What :meth:`compose` takes, of the conditions' size.

        Raises:
            ValueError: a size is no multiple of :attr:`stride`.
        """
        height, width = conditions.render.shape[-2:]
        if height % self.stride or width % self.stride:
            raise ValueError(f"expected sizes that are multiples of {self.stride}, got {height} × {width}")
        render = self.encode(conditions.render)
        lidar = self.encode(conditions.lidar)
        # Many views share a reference: callers may encode it once.
        reference = self.encode(conditions.reference) if reference is None else reference
        latent = self.denoise(render.latent, reference.latent, lidar.latent, noise)
        return self.decode(latent, render, lidar, conditions)

    def noise_shape(self, height: int, width: int) -> tuple[int, int, int]:
        """Computes the shape of one view's noise.

        Args:
            height: of the image, a multiple of :attr:`stride`.
            width: likewise.

        Returns:
            (C, h, w).
        """
        return int(self.vae.config.latent_channels), height // self.latent_stride, width // self.latent_stride


def _normalise(x: Tensor) -> Tensor:
    """Scales each sample to root mean square 1, so that latent and skip are of one weight."""
    # A decoder trained for hundreds of steps grows its activations from level to level into the thousands. Its own
    # normalisations hide that, a sum of two branches does not.
    return x / x.float().square().mean((1, 2, 3), keepdim=True).clamp_min(1e-12).sqrt().to(x.dtype)


def apply_correction(output: Tensor, inputs: Conditions) -> Tensor:
    """Adds to the render a residual, and gates times what the aligned sources have that the render has not.

    A gate of 1 copies its source's pixel (LiDAR map, the two warps): sharp detail that exists is carried over, where a
    residual would have to draw it again.

    Args:
        output: [B, 3 + GATE_COUNT, H, W] of the decoder: residual, then gates.
        inputs: that the output is of.

    Returns:
        [B, 3, H, W] the corrected image, not clamped.

    >>> zeros = torch.zeros(1, 3, 1, 1)
    >>> inputs = Conditions(zeros + 0.5, zeros, zeros, torch.zeros(1, HINT_CHANNELS, 1, 1))
    >>> apply_correction(torch.zeros(1, 3 + GATE_COUNT, 1, 1), inputs).flatten().tolist()
    [0.5, 0.5, 0.5]
    """
    lidar_alpha = inputs.hints[:, 1:2]
    warped = inputs.hints[:, 2:5]
    warp_mask = inputs.hints[:, 5:6]
    lidar_warped = inputs.hints[:, 6:9]
    lidar_warp_mask = inputs.hints[:, 9:10]
    sources = ((inputs.lidar, lidar_alpha), (warped, warp_mask), (lidar_warped, lidar_warp_mask))
    corrected = inputs.render + output[:, :3]
    # Images are premultiplied, so that there is no division where they are empty.
    for k, (image, cover) in enumerate(sources):
        corrected = corrected + output[:, 3 + k : 4 + k] * (image - cover * inputs.render)
    return corrected


def compute_noise_level(timestep: int) -> tuple[float, float]:
    """Computes σ_τ of Stable Diffusion's schedule, and its schedulers' factor on the UNet's input.

    Args:
        timestep: τ, from 0 to 999.

    Returns:
        σ_τ and 1 / √(1 + σ_τ²).
    """
    from diffusers import EulerDiscreteScheduler

    scheduler: Any = EulerDiscreteScheduler(beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear")
    alpha = float(scheduler.alphas_cumprod[timestep])
    # In the schedulers' variance-exploding form, in which a latent is x + σ ε.
    sigma = ((1 - alpha) / alpha) ** 0.5
    return sigma, (1 + sigma**2) ** -0.5
