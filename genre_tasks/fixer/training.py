"""Training of the small fixer: its autoencoder first, then UNet, decoder and skips on pairs (paper Sec. III-B).

The encoder is frozen after the first part. Checkpoints hold everything that a step depends on: a resumed training
takes the same steps as one that was never stopped.
"""

from __future__ import annotations

import copy
import hashlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from genre_tasks.errors import InputError, NonFiniteError
from genre_tasks.fixer.conditioning import conditions, given
from genre_tasks.fixer.network import Fnet, FnetArchitecture, build, restart_residual, small_architecture
from genre_tasks.fixer.pairs import Pairs, sample
from genre_tasks.fixer.weights import trainable_state
from genre_tasks.progress import Progress, silent


@dataclass(frozen=True)
class TrainingSettings:
    """How long and with what. The paper trains 20 000 steps of batch 8 at 720 × 1280 from SD-Turbo.

    ``perceptual`` is small because the distance is steep: its gradient has about a hundred times the size of L1's, most
    of it fine noise, and at 0.1 it drowns L1's. ``squared`` is the squared error's weight beside L1: from errors of
    1 / (2 · squared) on it weighs more. ``half``: bfloat16 where torch has it for an operation.
    """

    autoencoder_steps: int = 200
    autoencoder_batch: int = 4
    steps: int = 2600
    batch: int = 2
    crop: tuple[int, int] = (128, 192)
    learning_rate: float = 1e-3
    autoencoder_learning_rate: float = 2e-3
    warmup: int = 50
    perceptual: float = 0.03
    squared: float = 4.0
    half: bool = True
    clean_share: float = 0.2
    average: float = 0.995
    kl: float = 1e-5
    seed: int = 0
    checkpoint_every: int = 100


PRESETS = {
    "small": TrainingSettings(),
    "further": TrainingSettings(steps=1500, learning_rate=6e-4, perceptual=0.1, clean_share=0.3, seed=1),
    "last": TrainingSettings(steps=2000, learning_rate=6e-4, perceptual=0.05, clean_share=0.3, seed=2),
    "paper": TrainingSettings(steps=20_000, batch=8, crop=(720, 1280), learning_rate=2e-5, perceptual=1.0),
}
"""``small``: half an hour on a core from nothing. ``further``: 18 minutes from its weights; ``last``: 24 from
those. ``paper`` (Sec. III-B):
SD-Turbo's LoRA adapters and skips; the paper gives steps, batch and size, rate and weight are Difix3D's."""

CHECKPOINT = "fixer.pt"

FOLLOWS = {"further": "small", "last": "further"}
"""The preset whose weights a preset starts from."""

AUTOENCODER_SETTINGS = ("autoencoder_steps", "autoencoder_batch", "autoencoder_learning_rate", "crop", "kl", "seed")
"""Settings on which the first part depends: with others of these its result is not used again."""


@dataclass
class TrainingState:
    """Everything that the next step depends on."""

    fnet: Fnet
    average: dict[str, Tensor]  # of what is trained
    optimiser: torch.optim.Optimizer
    generator: torch.Generator
    step: int
    losses: list[float]


Distance = Callable[[Tensor, Tensor], Tensor]


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
    """A trained fixer (averaged weights); continues from ``folder`` where a checkpoint of the same settings lies there.

    Args:
        start: a fixer to train further; without it training begins with the autoencoder. Of one with LoRA adapters
            those and the skips alone are trained.
        autoencoder: the folder of the trained autoencoder, if fixers of several inputs share it; else ``folder``.
        distance: perceptual distance of [B, H, W, 3] images, [B].
        on_checkpoint: called with the averaged network, the step and all losses at each checkpoint.

    Raises:
        InputError: the checkpoint is of other settings, pairs or weights, or the pairs are smaller than a crop.
        NonFiniteError: a loss is not finite.
    """
    folder.mkdir(parents=True, exist_ok=True)
    height, width = pairs.truth.shape[-2:]
    if height < settings.crop[0] or width < settings.crop[1]:
        raise InputError(
            f"the pairs are {width} × {height} pixels, crops of {settings.crop[1]} × {settings.crop[0]} are trained on",
            remedy="Make pairs of larger images, or train with smaller crops.",
            stage="train fnet",
        )
    first = settings.autoencoder_steps if start is None else 0
    total = first + settings.steps
    if start is None:
        fnet = _pretrained(
            pairs, settings, architecture or small_architecture(), autoencoder or folder, progress, total
        )
    else:
        fnet = copy.deepcopy(start).train()
        if fnet.architecture.residual:
            fnet.requires_grad_(True)
    state, origin = _fixer_state(fnet, settings), {"pairs": pairs.digest(), "starting weights": _digest(fnet)}
    _restore(state, folder / CHECKPOINT, settings, origin)
    report = _Reporter(progress, first, total, state.step)
    while state.step < settings.steps:
        views, truth = sample(pairs, state.generator, settings.batch, settings.crop, settings.clean_share)
        inputs = conditions(given(views, fnet.architecture.inputs))
        noise = torch.randn(settings.batch, *fnet.noise_shape(*settings.crop), generator=state.generator)
        with torch.autocast("cpu", torch.bfloat16, enabled=settings.half):
            out = fnet(inputs, noise)
        loss = (out - truth).abs().mean() + settings.squared * (out - truth).square().mean()
        if settings.perceptual:
            loss = loss + settings.perceptual * distance(_last(out.clamp(0, 1)), _last(truth)).mean()
        _step(state, loss, settings, settings.learning_rate)
        with torch.no_grad():
            decay = min(settings.average, (1 + state.step) / (10 + state.step))
            for name, parameter in trainable_state(fnet).items():
                state.average[name].lerp_(parameter, 1 - decay)
        report(state)
        if state.step % settings.checkpoint_every == 0 or state.step == settings.steps:
            if on_checkpoint is not None:  # before the checkpoint: what a kill leaves out is made again
                on_checkpoint(averaged(state), state.step, state.losses)
            _save(state, folder / CHECKPOINT, settings, origin)
    return averaged(state)


def train_autoencoder(
    pairs: Pairs, settings: TrainingSettings, architecture: FnetArchitecture, progress: Progress, total: int
) -> Fnet:
    """Encoder and decoder as a plain autoencoder on true images; latents are then scaled to unit variance.

    With a small KL term: latents must survive noise of the size of σ_τ, not be a normal distribution.
    """
    fnet = build(architecture, settings.seed)
    vae = fnet.vae
    # the fixer's decoder starts at zero; an autoencoder's must not
    nn.init.normal_(vae.decoder.conv_out.weight, std=0.02, generator=torch.Generator().manual_seed(settings.seed))
    optimiser = torch.optim.AdamW(vae.parameters(), lr=settings.autoencoder_learning_rate, weight_decay=0.0)
    generator = torch.Generator().manual_seed(settings.seed)
    state = TrainingState(fnet, {}, optimiser, generator, 0, [])
    report = _Reporter(progress, 0, total, 0)
    spread = torch.zeros(())
    while state.step < settings.autoencoder_steps:
        _, image = sample(pairs, generator, settings.autoencoder_batch, settings.crop, 0.0)
        posterior = vae.encode(image * 2 - 1).latent_dist
        out = vae.decode(posterior.sample(generator)).sample[:, :3] / 2 + 0.5
        loss = (out - image).abs().mean() + settings.kl * posterior.kl().mean() / posterior.mean[0].numel()
        _step(state, loss, settings, settings.autoencoder_learning_rate, settings.autoencoder_steps)
        latent = posterior.mean.detach()
        spread = torch.lerp(spread, latent.std(), 0.05) if state.step > 1 else latent.std()
        report(state)
    vae.register_to_config(scaling_factor=1.0 / float(spread))
    return fnet


def averaged(state: TrainingState) -> Fnet:
    """A copy of the network with the averaged weights."""
    fnet = copy.deepcopy(state.fnet)
    fnet.load_state_dict(state.average, strict=False)
    return fnet.eval()


def _pretrained(
    pairs: Pairs,
    settings: TrainingSettings,
    architecture: FnetArchitecture,
    folder: Path,
    progress: Progress,
    total: int,
) -> Fnet:
    """The network after the first part, from ``folder`` or trained; the decoder's and UNet's ends are zeroed."""
    path = folder / "autoencoder.pt"
    if path.exists():
        stored = torch.load(path, weights_only=True)
        _require_same(stored["settings"], settings, path, AUTOENCODER_SETTINGS)
        _require_origin(stored, {"pairs": pairs.digest()}, path)
        scale, weights = stored["scale"], stored["weights"]
    else:
        trained = train_autoencoder(pairs, settings, architecture, progress, total)
        scale, weights = trained.vae.config.scaling_factor, trained.state_dict()
        origin = {"pairs": pairs.digest()}
        _write({"settings": _plain(settings), "origin": origin, "scale": scale, "weights": weights}, path)
    fnet = build(scaled(architecture, scale), settings.seed)
    fnet.load_state_dict(weights)
    restart_residual(fnet)
    return fnet


def scaled(architecture: FnetArchitecture, scaling_factor: float) -> FnetArchitecture:
    """The architecture with a latent scale."""
    return replace(architecture, vae={**architecture.vae, "scaling_factor": scaling_factor})


def _fixer_state(fnet: Fnet, settings: TrainingSettings) -> TrainingState:
    fnet.vae.encoder.requires_grad_(False)
    if fnet.vae.quant_conv is not None:
        fnet.vae.quant_conv.requires_grad_(False)
    trained = [p for p in fnet.parameters() if p.requires_grad]
    optimiser = torch.optim.AdamW(trained, lr=settings.learning_rate, weight_decay=1e-4)
    average = {name: value.detach().clone() for name, value in trainable_state(fnet).items()}
    return TrainingState(fnet, average, optimiser, torch.Generator().manual_seed(settings.seed + 1), 0, [])


def _step(
    state: TrainingState, loss: Tensor, settings: TrainingSettings, rate: float, steps: int | None = None
) -> None:
    """One step of the optimiser: warm-up, then a cosine to a hundredth of the rate; gradients clipped at norm 1."""
    if not bool(torch.isfinite(loss)):
        raise NonFiniteError("train fnet", f"loss of step {state.step}", 1, ())
    done = state.step / max(1, settings.steps if steps is None else steps)
    factor = min(1.0, (state.step + 1) / settings.warmup) * (
        0.505 + 0.495 * float(torch.cos(torch.tensor(done * torch.pi)))
    )
    for group in state.optimiser.param_groups:
        group["lr"] = rate * factor
    state.optimiser.zero_grad()
    loss.backward()
    nn.utils.clip_grad_norm_([p for g in state.optimiser.param_groups for p in g["params"]], 1.0)
    state.optimiser.step()
    state.step += 1
    state.losses.append(float(loss.detach()))


class _Reporter:
    """Progress with the recent loss and the time left."""

    def __init__(self, progress: Progress, offset: int, total: int, first: int) -> None:
        self.progress, self.offset, self.total, self.first = progress, offset, total, first
        self.began = time.monotonic()

    def __call__(self, state: TrainingState) -> None:
        done = self.offset + state.step
        each = (time.monotonic() - self.began) / max(1, state.step - self.first)
        recent = state.losses[-100:]
        left = each * (self.total - done)
        self.progress(done, self.total, f"loss {sum(recent) / len(recent):.4f}, {left / 60:.1f} min left")


def _digest(fnet: Fnet) -> str:
    """Of a network's inputs and of all its weights."""
    found = hashlib.sha256("+".join(fnet.architecture.inputs).encode())
    for name, value in sorted(fnet.state_dict().items()):
        found.update(name.encode() + value.detach().contiguous().numpy().tobytes())
    return found.hexdigest()


def _save(state: TrainingState, path: Path, settings: TrainingSettings, origin: Mapping[str, str]) -> None:
    document = {
        "settings": _plain(settings),
        "origin": dict(origin),
        "weights": {name: value.detach() for name, value in trainable_state(state.fnet).items()},
        "average": state.average,
        "optimiser": state.optimiser.state_dict(),
        "generator": state.generator.get_state(),
        "step": state.step,
        "losses": state.losses,
    }
    _write(document, path)


def _restore(state: TrainingState, path: Path, settings: TrainingSettings, origin: Mapping[str, str]) -> None:
    if not path.exists():
        return
    stored = torch.load(path, weights_only=True)
    _require_same(stored["settings"], settings, path, tuple(_plain(settings)))
    _require_origin(stored, origin, path)
    state.fnet.load_state_dict(stored["weights"], strict=False)
    state.average = stored["average"]
    state.optimiser.load_state_dict(stored["optimiser"])
    state.generator.set_state(stored["generator"])
    state.step, state.losses = stored["step"], stored["losses"]


def _write(document: dict[str, Any], path: Path) -> None:
    """Renamed into place: a kill leaves the last whole checkpoint."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".tmp")
    torch.save(document, part)
    part.replace(path)


def _plain(settings: TrainingSettings) -> dict[str, Any]:
    return {**asdict(settings), "crop": list(settings.crop)}


def _require_same(stored: dict[str, Any], settings: TrainingSettings, path: Path, names: Sequence[str]) -> None:
    now = _plain(settings)
    other = [name for name in names if stored.get(name) != now[name]]
    if other:
        raise InputError(
            f"the checkpoint was trained with other settings: {', '.join(other)}",
            remedy="Train with the same settings, or into another folder.",
            file=path,
        )


def _require_origin(stored: dict[str, Any], origin: Mapping[str, str], path: Path) -> None:
    if other := [name for name, value in origin.items() if stored.get("origin", {}).get(name) != value]:
        raise InputError(
            f"the checkpoint was trained with other {' and '.join(other)}",
            remedy="Delete it, or train into another folder.",
            file=path,
        )


def _last(image: Tensor) -> Tensor:
    return image.permute(0, 2, 3, 1)
