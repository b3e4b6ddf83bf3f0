"""Training of the fixer: its autoencoder first, then UNet, decoder and skips on pairs (paper Sec. III-B).

The encoder is frozen after the first part.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from genre_tasks.checks import check_finite
from genre_tasks.errors import InputError
from genre_tasks.fixer.architectures import build_fnet, reset_to_identity, small_architecture, with_latent_scale
from genre_tasks.fixer.conditioning import build_conditions
from genre_tasks.fixer.inputs import mask_inputs
from genre_tasks.fixer.network import Fnet, FnetArchitecture
from genre_tasks.fixer.pairs import Pairs, sample_crops
from genre_tasks.fixer.training_checkpoint import (
    AUTOENCODER_FILE,
    CHECKPOINT_FILE,
    TrainedAutoencoder,
    TrainingState,
    digest_architecture,
    digest_weights,
    load_autoencoder,
    restore_checkpoint,
    save_autoencoder,
    save_checkpoint,
)
from genre_tasks.fixer.training_settings import TrainingSettings
from genre_tasks.fixer.weights import trainable_state
from genre_tasks.progress import Progress, silent

Distance = Callable[[Tensor, Tensor], Tensor]
"""Perceptual distance [B] of two batches of images [B, H, W, 3]."""


def train(
    pairs: Pairs,
    settings: TrainingSettings,
    folder: Path,
    distance: Distance,
    progress: Progress = silent,
    on_checkpoint: Callable[[Fnet, int, Sequence[float]], None] | None = None,
    architecture: FnetArchitecture | None = None,
    start: Fnet | None = None,
    autoencoder: Path | None = None,
) -> Fnet:
    """Trains a fixer on pairs; continues from ``folder`` where a checkpoint of the same settings lies there.

    Args:
        pairs: to train on.
        settings: how long and with what.
        folder: for checkpoints; it is made where it is missing.
        distance: perceptual distance of the loss.
        progress: called with the steps done, their total, and the recent loss.
        on_checkpoint: called with the averaged network, the step and all losses at each checkpoint.
        architecture: of a new network; the small one if none is given.
        start: a fixer to train further; without it training begins with the autoencoder. Of a fixer with LoRA adapters
            those and the skips alone are trained.
        autoencoder: the folder of the trained autoencoder, if fixers of several inputs share it; else ``folder``.

    Returns:
        The trained fixer, with averaged weights, ready for inference.

    Raises:
        InputError: the checkpoint is of other settings, pairs or weights, or the pairs are smaller than a crop.
        NonFiniteError: a loss is not finite.
    """
    folder.mkdir(parents=True, exist_ok=True)
    # Before the first part, which takes minutes.
    _require_crop_fits(pairs, settings)
    autoencoder_steps = settings.autoencoder_steps if start is None else 0
    total = autoencoder_steps + settings.steps
    if start is None:
        path = (autoencoder or folder) / AUTOENCODER_FILE
        fnet = _build_with_autoencoder(pairs, settings, architecture or small_architecture(), path, progress, total)
    else:
        # A copy: the caller's network stays as it was.
        fnet = copy.deepcopy(start).train()
        # SD-Turbo trains its adapters and skips alone, which are the ones that require gradients already.
        if fnet.architecture.residual:
            fnet.requires_grad_(True)
    state = _start_state(fnet, settings)
    origin = {"pairs": pairs.digest(), "starting weights": digest_weights(fnet)}
    restore_checkpoint(state, folder / CHECKPOINT_FILE, settings, origin)
    report = _Reporter(progress, autoencoder_steps, total, state.step)
    while state.step < settings.steps:
        loss = _compute_loss(state, pairs, settings, distance)
        _apply_step(state, loss, settings.learning_rate, settings.warmup, settings.steps)
        _update_average(state, settings.average)
        report(state)
        if state.step % settings.checkpoint_every == 0 or state.step == settings.steps:
            if on_checkpoint is not None:
                # Before the checkpoint is written: what a kill leaves out is then done again.
                on_checkpoint(averaged_network(state), state.step, state.losses)
            save_checkpoint(state, folder / CHECKPOINT_FILE, settings, origin)
    return averaged_network(state)


def _require_crop_fits(pairs: Pairs, settings: TrainingSettings) -> None:
    height, width = pairs.truth.shape[-2:]
    crop_height, crop_width = settings.crop
    if height < crop_height or width < crop_width:
        raise InputError(
            f"the pairs are {width} × {height} pixels, crops of {crop_width} × {crop_height} are trained on",
            remedy="Make pairs of larger images, or train with smaller crops.",
            stage="train fnet",
        )


def _compute_loss(state: TrainingState, pairs: Pairs, settings: TrainingSettings, distance: Distance) -> Tensor:
    """L1, squared error and perceptual distance of the network's output on a random batch of crops."""
    fnet = state.fnet
    views, truth = sample_crops(pairs, state.generator, settings.batch, settings.crop, settings.clean_share)
    inputs = build_conditions(mask_inputs(views, fnet.architecture.inputs))
    noise = torch.randn(settings.batch, *fnet.noise_shape(*settings.crop), generator=state.generator)
    with torch.autocast("cpu", torch.bfloat16, enabled=settings.half):
        out = fnet(inputs, noise)
    # The squared error makes large errors count more than they do by L1 alone.
    loss = (out - truth).abs().mean() + settings.squared * (out - truth).square().mean()
    if settings.perceptual:
        perceptual = distance(_channels_last(out.clamp(0, 1)), _channels_last(truth))
        loss = loss + settings.perceptual * perceptual.mean()
    return loss


@torch.no_grad()
def _update_average(state: TrainingState, decay: float) -> None:
    # The first steps count for little: the mean then follows the weights closely.
    decay = min(decay, (1 + state.step) / (10 + state.step))
    for name, parameter in trainable_state(state.fnet).items():
        state.average[name].lerp_(parameter, 1 - decay)


def train_autoencoder(
    pairs: Pairs, settings: TrainingSettings, architecture: FnetArchitecture, progress: Progress, total: int
) -> Fnet:
    """Trains encoder and decoder as a plain autoencoder on true images, and scales latents to unit variance.

    Args:
        pairs: whose true images are trained on.
        settings: how long and with what.
        architecture: of the network.
        progress: called with the steps done, the total and the recent loss.
        total: steps of both parts of training.

    Returns:
        The network, whose UNet and skip connections are untrained.

    Raises:
        NonFiniteError: a loss is not finite.
    """
    fnet = build_fnet(architecture, settings.seed)
    vae = fnet.vae
    # The fixer's decoder starts at zero; an autoencoder's must not.
    nn.init.normal_(vae.decoder.conv_out.weight, std=0.02, generator=torch.Generator().manual_seed(settings.seed))
    optimiser = torch.optim.AdamW(vae.parameters(), lr=settings.autoencoder_learning_rate, weight_decay=0.0)
    generator = torch.Generator().manual_seed(settings.seed)
    state = TrainingState(fnet, {}, optimiser, generator, 0, [])
    report = _Reporter(progress, 0, total, 0)
    spread = torch.zeros(())
    while state.step < settings.autoencoder_steps:
        _, image = sample_crops(pairs, generator, settings.autoencoder_batch, settings.crop, 0.0)
        posterior = vae.encode(image * 2 - 1).latent_dist
        out = vae.decode(posterior.sample(generator)).sample[:, :3] / 2 + 0.5
        # The KL term is small: latents must survive noise of the size of σ_τ, not be a normal distribution.
        loss = (out - image).abs().mean() + settings.kl * posterior.kl().mean() / posterior.mean[0].numel()
        _apply_step(state, loss, settings.autoencoder_learning_rate, settings.warmup, settings.autoencoder_steps)
        latent = posterior.mean.detach()
        # A running mean, because a single batch of crops tells little of the latents' spread.
        spread = torch.lerp(spread, latent.std(), 0.05) if state.step > 1 else latent.std()
        report(state)
    vae.register_to_config(scaling_factor=1.0 / float(spread))
    return fnet


def averaged_network(state: TrainingState) -> Fnet:
    """Copies the network with the averaged weights.

    Args:
        state: of a training.

    Returns:
        The copy, ready for inference.
    """
    fnet = copy.deepcopy(state.fnet)
    fnet.load_state_dict(state.average, strict=False)
    return fnet.eval()


def _build_with_autoencoder(
    pairs: Pairs,
    settings: TrainingSettings,
    architecture: FnetArchitecture,
    path: Path,
    progress: Progress,
    total: int,
) -> Fnet:
    """The network after the first part, which is read from ``path`` or trained; the identity until it is trained on."""
    origin = {"pairs": pairs.digest(), "architecture": digest_architecture(architecture)}
    autoencoder = load_autoencoder(path, settings, origin)
    if autoencoder is None:
        trained = train_autoencoder(pairs, settings, architecture, progress, total)
        autoencoder = TrainedAutoencoder(trained.vae.config.scaling_factor, trained.state_dict())
        save_autoencoder(autoencoder, path, settings, origin)
    fnet = build_fnet(with_latent_scale(architecture, autoencoder.scaling_factor), settings.seed)
    fnet.load_state_dict(autoencoder.weights)
    reset_to_identity(fnet)
    return fnet


def _start_state(fnet: Fnet, settings: TrainingSettings) -> TrainingState:
    """The state before the second part's first step, with the encoder frozen."""
    # Latents must stay what the decoder was trained on, and references can be encoded once.
    fnet.vae.encoder.requires_grad_(False)
    if fnet.vae.quant_conv is not None:
        fnet.vae.quant_conv.requires_grad_(False)
    trained = [p for p in fnet.parameters() if p.requires_grad]
    optimiser = torch.optim.AdamW(trained, lr=settings.learning_rate, weight_decay=1e-4)
    average = {name: value.detach().clone() for name, value in trainable_state(fnet).items()}
    # Another seed than the first part's, which drew its crops from the same pairs.
    return TrainingState(fnet, average, optimiser, torch.Generator().manual_seed(settings.seed + 1), 0, [])


def _apply_step(state: TrainingState, loss: Tensor, learning_rate: float, warmup: int, steps: int) -> None:
    """One step of the optimiser: warm-up, then a cosine to a hundredth of the rate; gradients clipped at norm 1."""
    check_finite(loss, f"loss of step {state.step}", "train fnet")
    done = state.step / max(1, steps)
    cosine = 0.505 + 0.495 * float(torch.cos(torch.tensor(done * torch.pi)))
    factor = min(1.0, (state.step + 1) / warmup) * cosine
    for group in state.optimiser.param_groups:
        group["lr"] = learning_rate * factor
    state.optimiser.zero_grad()
    loss.backward()
    # Clipped, because the perceptual distance is steep: its gradient can be a hundred times that of L1.
    nn.utils.clip_grad_norm_([p for group in state.optimiser.param_groups for p in group["params"]], 1.0)
    state.optimiser.step()
    state.step += 1
    state.losses.append(float(loss.detach()))


class _Reporter:
    """Progress with the recent loss and the time left."""

    def __init__(self, progress: Progress, offset: int, total: int, first_step: int) -> None:
        self._progress = progress
        self._offset = offset
        self._total = total
        self._first_step = first_step
        self._start_s = time.monotonic()

    def __call__(self, state: TrainingState) -> None:
        done = self._offset + state.step
        seconds_per_step = (time.monotonic() - self._start_s) / max(1, state.step - self._first_step)
        recent = state.losses[-100:]
        minutes_left = seconds_per_step * (self._total - done) / 60
        self._progress(done, self._total, f"loss {sum(recent) / len(recent):.4f}, {minutes_left:.1f} min left")


def _channels_last(image: Tensor) -> Tensor:
    return image.permute(0, 2, 3, 1)
