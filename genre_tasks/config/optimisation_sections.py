"""Sections of the stages that optimise Gaussians: the loss, the learned optimiser, tuned Adam and per-scene 3DGS."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from genre_tasks.config.section import LearningRate, LearningRates, LossWeight, Section, Seed, Text


class LossConfig(Section):
    """Weights of the rendering loss (paper Eq. 9–11, Sec. III-C)."""

    # The paper's weights (Sec. III-C).
    rgb: LossWeight = Field(0.8, description="Weight λ of the mean absolute colour error (L1).")
    perceptual: LossWeight = Field(
        0.2, description="Weight λ_lpips of the perceptual term; the distance is the project's own, not LPIPS."
    )
    ssim: LossWeight = Field(0.2, description="Weight λ_ssim of 1 − SSIM.")
    depth: LossWeight = Field(
        0.01, description="Weight λ_depth of the relative error of LiDAR depth; in source views only."
    )
    novel: LossWeight = Field(0.5, description="Weight λ_novel of the fixed novel views.")
    perceptual_every: int = Field(
        4, ge=1, le=10_000, description="The perceptual term is computed in every n-th iteration."
    )
    perceptual_views: int = Field(
        1,
        ge=1,
        le=10_000,
        description="The perceptual term is computed on a crop in so many source and so many novel views.",
    )

    @model_validator(mode="after")
    def _require_term(self) -> Self:
        # Without any term all gradients are zero, and the result would be the initial scene without a word.
        if self.rgb + self.perceptual + self.ssim + self.depth == 0:
            raise ValueError("rgb, perceptual, ssim and depth are all 0, so that nothing would be optimised")
        return self


class AdamConfig(Section):
    """Tuned Adam, a baseline that is tuned for the number of iterations it runs (``configs/baselines.yaml``)."""

    learning_rates: LearningRates | None = Field(
        None, description="Learning rates; null: those tuned for 24 iterations of 6 views, one set for each stage."
    )
    schedule: Literal["cosine", "constant"] = Field(
        "cosine", description="How all learning rates change over the iterations."
    )


class DensityConfig(Section):
    """When and how per-scene 3DGS adds and removes Gaussians; iterations count in a run of 30 000."""

    # The numbers of Kerbl et al. and gsplat, but for the bound on Gaussians, which memory asks for.
    start: int = Field(500, ge=0, le=1_000_000, description="First iteration of densification.")
    stop: int = Field(
        15_000,
        ge=0,
        le=1_000_000,
        description="From this iteration on, no Gaussian is added or removed and no opacity is lowered.",
    )
    every: int = Field(100, ge=1, le=1_000_000, description="Gaussians are added and removed in every n-th iteration.")
    reset_every: int = Field(3000, ge=1, le=1_000_000, description="Opacities are lowered in every n-th iteration.")
    grow_gradient: float = Field(
        2e-4,
        ge=0,
        le=1e6,
        description="A Gaussian is cloned or split above this screen-space gradient, the image from −1 to 1.",
    )
    grow_scale: float = Field(
        0.01,
        gt=0,
        le=1e6,
        description="Gaussians up to this size are cloned, larger ones split; a fraction of their node's extent.",
    )
    prune_opacity: float = Field(0.005, gt=0, lt=0.5, description="Gaussians below this opacity are removed.")
    prune_scale: float = Field(
        0.1,
        gt=0,
        le=1e6,
        description="Gaussians above this size are removed after the first reset of opacities; a fraction of their "
        "node's extent.",
    )
    max_gaussians: int = Field(
        1_000_000,
        ge=1,
        le=100_000_000,
        description="No Gaussians are added beyond this number; the published recipe has no bound.",
    )


class PerSceneConfig(Section):
    """Per-scene 3DGS as published (Kerbl et al. 2023; gsplat's ``simple_trainer`` and ``DefaultStrategy``)."""

    iterations: int = Field(
        30_000, ge=1, le=200_000, description="Number of iterations, one view each; all schedules scale with it."
    )
    means_lr: LearningRate = Field(
        1.6e-4, description="Learning rate of the means at the start, as a fraction of the scene's extent."
    )
    means_lr_end_fraction: float = Field(
        0.01, gt=0, le=1, description="Learning rate of the means at the end, as a fraction of that at the start."
    )
    log_scales_lr: LearningRate = Field(5e-3, description="Learning rate of the log-scales.")
    quats_lr: LearningRate = Field(1e-3, description="Learning rate of the quaternions.")
    logit_opacities_lr: LearningRate = Field(5e-2, description="Learning rate of the logit opacities.")
    sh_lr: LearningRate = Field(
        2.5e-3,
        description="Learning rate of the constant spherical harmonic; that of colours is C0 = 0.282 times it.",
    )
    rgb: LossWeight = Field(0.8, description="Weight of the mean absolute colour error (L1).")
    ssim: LossWeight = Field(0.2, description="Weight of 1 − SSIM.")
    depth: LossWeight = Field(
        0.0, description="Weight of the relative error of LiDAR depth; the published recipe has none."
    )
    density: DensityConfig = Field(DensityConfig(), description="When and how Gaussians are added and removed.")

    @model_validator(mode="after")
    def _require_term(self) -> Self:
        # As for the loss of the other methods.
        if self.rgb + self.ssim + self.depth == 0:
            raise ValueError("rgb, ssim and depth are all 0, so that nothing would be optimised")
        return self


class OptimiserConfig(Section):
    """GNet and ENet: the unrolled learned optimiser (paper Sec. III-C, III-D)."""

    # The paper's T for GNet; that of ENet is set where the sections come together.
    iterations: int = Field(24, ge=1, le=10_000, description="Number of iterations T.")
    views_per_iteration: int = Field(6, ge=1, le=10_000, description="Source views rendered in each iteration.")
    novel_views_per_iteration: int = Field(
        0, ge=0, le=10_000, description="Fixed novel views rendered in each iteration."
    )
    loss: LossConfig = Field(LossConfig(), description="Weights of the rendering loss.")
    method: Literal["learned", "adam"] = Field(
        "learned", description="learned: the learned optimiser; adam: the baseline tuned for each attribute."
    )
    adam: AdamConfig = Field(AdamConfig(), description="Settings of the method adam.")
    weights: Text = Field(
        "builtin",
        description="builtin, builtin:NAME (another network's, e.g. builtin:gnet), or the path of a .safetensors file.",
    )
    learning_rates: LearningRates | None = Field(
        None,
        description="Learning rates of the learned optimiser; null: those that its weights were trained with. Presets "
        "are tuned for the built-in weights, so set null with others. Of GNet alone, gnet.refine.lr_before_refine "
        "takes precedence.",
    )
    constrain_ground: bool = Field(
        True, description="Let Gaussians that lie on the ground move and turn within the ground's plane only."
    )
    split_fraction: float = Field(
        0.0, ge=0, le=4, description="Fraction of Gaussians to split before the start, largest image residual first."
    )
    snapshots: int = Field(
        6, ge=0, le=1000, description="Intermediate scenes kept for the curve of accuracy against seconds."
    )
    seed: Seed = Field(0, description="Seed of every random choice of the stage.")

    @property
    def refine_iterations(self) -> int:
        """How many of the T iterations belong to the refinement part."""
        return 0


class RefineConfig(Section):
    """The refinement part of GNet: Gaussians are split, then optimised further with other weights."""

    fraction_of_iterations: float = Field(
        2 / 3, gt=0, lt=1, description="Fraction of gnet.iterations spent on refinement."
    )
    split_fraction: float = Field(
        0.3, ge=0, le=4, description="Fraction of Gaussians to split before refinement, largest image residual first."
    )
    weights: Text = Field(
        "builtin:enet", description="As gnet.weights. ENet's weights were trained on scenes with split Gaussians."
    )
    # Steps that end in a refinement can be bolder than steps to the very end.
    lr_before_refine: LearningRates | None = Field(
        None, description="Learning rates of the first part when refinement follows; null: the same as gnet's."
    )


class GnetConfig(OptimiserConfig):
    """GNet, or in its place a baseline that reconstructs from source views too (``configs/baselines.yaml``)."""

    # mypy takes more choices than the base class has for a conflict.
    method: Literal["learned", "adam", "standard_3dgs", "street_gs", "g3r", "none"] = Field(  # type: ignore[assignment]
        "learned",
        description="learned: GNet; adam: the baseline tuned for each attribute; standard_3dgs, street_gs: per-scene "
        "3DGS without and with actors; g3r: learned from recorded views alone, with weights of its own; none: the "
        "initial scene stays as it is.",
    )
    per_scene: PerSceneConfig = Field(
        PerSceneConfig(), description="Settings of the methods standard_3dgs and street_gs."
    )
    refine: RefineConfig | None = Field(
        None, description="The last iterations of the method learned, on split Gaussians; null: no refinement part."
    )

    @property
    def refinement(self) -> RefineConfig | None:
        """The refinement part that runs, if any: baselines have none, nor has a single iteration."""
        # A single iteration cannot be divided.
        return self.refine if self.method == "learned" and self.iterations > 1 else None

    @property
    def refine_iterations(self) -> int:
        """Iterations of the refinement part; at least one iteration is left on either side of its start."""
        if self.refinement is None:
            return 0
        # Rounding must not take all iterations for one part.
        wanted = max(1, round(self.refinement.fraction_of_iterations * self.iterations))
        return min(wanted, self.iterations - 1)
