"""Settings of the fixer's training, and presets of them."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class TrainingSettings:
    """How long and with what the fixer is trained.

    The paper trains 20 000 steps of batch 8 at 720 × 1280 from SD-Turbo.

    Attributes:
        autoencoder_steps: steps of the first part, which trains the autoencoder alone.
        autoencoder_batch: crops per step of the first part.
        steps: steps of the second part, which trains UNet, decoder and skip connections on pairs.
        batch: crops per step of the second part.
        crop: height and width of a crop in pixels.
        learning_rate: of the second part.
        autoencoder_learning_rate: of the first part.
        warmup: steps over which the learning rate rises from 0.
        perceptual: weight of the perceptual distance.
        squared: weight of the squared error relative to L1's; it counts more from errors of 1 / (2 · squared) on.
        half: compute in bfloat16 where torch has it for an operation.
        clean_share: fraction of crops whose render is the truth.
        average: decay of the running mean of the weights, which is what training returns.
        kl: weight of the autoencoder's KL term.
        seed: of weights, crops and noise.
        checkpoint_every: steps between checkpoints.
    """

    autoencoder_steps: int = 200
    autoencoder_batch: int = 4
    steps: int = 2600
    batch: int = 2
    crop: tuple[int, int] = (128, 192)
    learning_rate: float = 1e-3
    autoencoder_learning_rate: float = 2e-3
    warmup: int = 50
    # The distance is steep: its gradient is about a hundred times that of L1, most of it fine noise, and at 0.1 it
    # drowns L1's.
    perceptual: float = 0.03
    squared: float = 4.0
    half: bool = True
    clean_share: float = 0.2
    # Single steps of small batches are noisy; the mean of the last few hundred weights is better and steadier.
    average: float = 0.995
    # Latents must survive noise of the size of σ_τ, not be normally distributed.
    kl: float = 1e-5
    seed: int = 0
    checkpoint_every: int = 100

    def as_plain(self) -> dict[str, Any]:
        """Converts to plain values, as checkpoints hold them.

        Returns:
            The fields by name.

        >>> TrainingSettings().as_plain()["crop"]
        [128, 192]
        """
        return {**asdict(self), "crop": list(self.crop)}


# Steps and batch of ``paper`` are those of Sec. III-B; it gives no learning rate and no weight of the perceptual
# distance, which are Difix3D's. Crops fit the pairs, which are of 320 × 180, and SD-Turbo's stride of 64.
PRESETS = {
    "small": TrainingSettings(),
    "further": TrainingSettings(steps=1500, learning_rate=6e-4, perceptual=0.1, clean_share=0.3, seed=1),
    "last": TrainingSettings(steps=2000, learning_rate=6e-4, perceptual=0.05, clean_share=0.3, seed=2),
    "paper": TrainingSettings(steps=20_000, batch=8, crop=(128, 256), learning_rate=2e-5, perceptual=1.0),
}
"""``small`` takes half an hour on one core, from nothing; ``further`` 18 minutes from its weights; ``last`` 24 minutes
from those. ``paper`` trains SD-Turbo's LoRA adapters and skip connections."""

STARTS_FROM = {"further": "small", "last": "further"}
"""The preset whose weights a preset starts from."""

# The pairs and the architecture count too, see ``training``.
AUTOENCODER_SETTINGS = (
    "autoencoder_steps",
    "autoencoder_batch",
    "autoencoder_learning_rate",
    "warmup",
    "crop",
    "kl",
    "seed",
)
"""Settings on which the first part depends: its result is used again only where all of these are the same."""
