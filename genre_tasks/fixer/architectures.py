"""The two networks of the fixer: the small one, which is trained from nothing, and SD-Turbo with LoRA adapters."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import nn

from genre_tasks.errors import InputError
from genre_tasks.fixer.network import GATE_COUNT, Fnet, FnetArchitecture


def small_architecture(
    widths: tuple[int, ...] = (24, 32, 48, 64), latent_channels: int = 8, unet_widths: tuple[int, ...] = (32, 64)
) -> FnetArchitecture:
    """Describes the default network: the classes of Stable Diffusion, sized for CPUs.

    Args:
        widths: channels of the autoencoder, finest level first.
        latent_channels: channels of a latent.
        unet_widths: channels of the UNet, finest level first.

    Returns:
        The architecture, untrained.

    >>> small_architecture().vae["latent_channels"]
    8
    """
    autoencoder_levels = len(widths)
    unet_levels = len(unet_widths)
    return FnetArchitecture(
        vae={
            "down_block_types": ("DownEncoderBlock2D",) * autoencoder_levels,
            "up_block_types": ("UpDecoderBlock2D",) * autoencoder_levels,
            "block_out_channels": widths,
            "layers_per_block": 1,
            "latent_channels": latent_channels,
            "out_channels": 3 + GATE_COUNT,
            "norm_num_groups": 8,
            # Attention is the UNet's part; in the autoencoder it would only cost time.
            "mid_block_add_attention": False,
            "scaling_factor": 1.0,
        },
        unet={
            "in_channels": latent_channels,
            "out_channels": latent_channels,
            "block_out_channels": unet_widths,
            "down_block_types": ("CrossAttnDownBlock2D",) * unet_levels,
            "up_block_types": ("CrossAttnUpBlock2D",) * unet_levels,
            "layers_per_block": 1,
            # The number of heads, despite diffusers' historical name: on CPUs attention costs by the head.
            "attention_head_dim": 1,
            # Text attention is taken out again, so that its width only has to be valid.
            "cross_attention_dim": 8,
            "norm_num_groups": 8,
        },
        residual=True,
    )


def with_latent_scale(architecture: FnetArchitecture, scaling_factor: float) -> FnetArchitecture:
    """Replaces the factor that brings latents to unit variance.

    Args:
        architecture: to change.
        scaling_factor: factor on the encoder's output.

    Returns:
        The architecture with that factor.

    >>> with_latent_scale(small_architecture(), 0.5).vae["scaling_factor"]
    0.5
    """
    return replace(architecture, vae={**architecture.vae, "scaling_factor": scaling_factor})


def build_fnet(architecture: FnetArchitecture, seed: int = 0) -> Fnet:
    """Builds a network with random weights; torch's global random state is left as it was.

    Args:
        architecture: of the network.
        seed: of the weights.

    Returns:
        The network; with ``architecture.residual`` it is the identity until it is trained.
    """
    from diffusers import AutoencoderKL, UNet2DConditionModel

    # diffusers draws from the global generator alone.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        vae = AutoencoderKL(**architecture.vae)
        unet = UNet2DConditionModel(**architecture.unet)
        fnet = Fnet(vae, unet, architecture)
    if architecture.residual:
        reset_to_identity(fnet)
    return fnet


def reset_to_identity(fnet: Fnet, seed: int = 0) -> None:
    """Zeroes the last convolutions of decoder and UNet, so that the fixer is the identity until it is trained.

    Args:
        fnet: a network with a residual output, changed in place.
        seed: of the new weights of the skip connections.
    """
    # A zero residual leaves the render as it is, and zero predicted noise leaves its latent.
    for last in (fnet.vae.decoder.conv_out, fnet.unet.conv_out):
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
    # Behind zeroed outputs the skips may start at random. From the first step, at full strength, they then bring what
    # the latent has lost.
    generator = torch.Generator().manual_seed(seed)
    for skip in fnet.skips:
        assert isinstance(skip, nn.Conv2d)
        nn.init.normal_(skip.weight, std=2 * skip.in_channels**-0.5, generator=generator)


def load_sd_turbo(source: str, timestep: int = 200, rank: int = 16) -> Fnet:
    """Loads SD-Turbo and adds untrained LoRA adapters.

    Args:
        source: a local folder or a hub id, with the subfolders ``vae`` and ``unet``.
        timestep: τ of the one step.
        rank: of the adapters.

    Returns:
        The network, of which adapters and skip connections are trainable.

    Raises:
        InputError: the source cannot be loaded.
    """
    from diffusers import AutoencoderKL, UNet2DConditionModel

    try:
        # Other weights are pickles, which may run code.
        vae = AutoencoderKL.from_pretrained(source, subfolder="vae", use_safetensors=True)
        unet = UNet2DConditionModel.from_pretrained(source, subfolder="unet", use_safetensors=True)
    except (OSError, ValueError) as error:
        raise InputError(
            f"SD-Turbo cannot be loaded: {str(error).splitlines()[0]}",
            remedy="Name a folder with vae and unet: by --start in training, by `base` in fnet.json for a run.",
            file=source,
            stage="fnet",
        ) from error
    fnet = Fnet(vae, unet, FnetArchitecture(dict(vae.config), dict(unet.config), residual=False, timestep=timestep))
    add_lora(fnet, rank)
    return fnet


def add_lora(fnet: Fnet, rank: int, seed: int = 0) -> None:
    """Adds low-rank adapters to UNet and decoder, and freezes all but them and the skips (paper Sec. III-B).

    Args:
        fnet: changed in place.
        rank: of the adapters.
        seed: of their weights; torch's global random state is left as it was.
    """
    from peft import LoraConfig

    attention = r"to_q|to_k|to_v|to_out\.0"
    unet_layers = rf".*({attention}|conv1|conv2|proj_in|proj_out)"
    decoder_layers = rf"decoder\..*({attention}|conv1|conv2|conv)"
    fnet.requires_grad_(False)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        # The rank as alpha makes the adapters' scale 1, whatever their rank.
        fnet.unet.add_adapter(LoraConfig(r=rank, lora_alpha=rank, target_modules=unet_layers))
        fnet.vae.add_adapter(LoraConfig(r=rank, lora_alpha=rank, target_modules=decoder_layers))
    fnet.skips.requires_grad_(True)
