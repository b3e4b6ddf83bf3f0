"""Configuration of the stages: bounded pydantic models. A stage gets its own subtree and nothing else.

Defaults are the paper's numbers where the paper gives one (Sec. III and IV); presets in ``configs/`` say what they
change and why.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

Rate = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Rates = tuple[float, float, float, float, float]
"""Learning rates of means, log-scales, quaternions, logit opacities and colours, in this order."""


class Section(BaseModel):
    """Base of all sections: unknown keys are errors, values are frozen."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class LearningRates(Section):
    """Learning rate of each attribute of a Gaussian.

    A mean moves in units of its Gaussian's initial size; all else moves in raw space (log-scale, logit opacity).

    >>> LearningRates(means=0.1, log_scales=0.2, quats=0.05, logit_opacities=0.3, colors=0.02).as_tuple()
    (0.1, 0.2, 0.05, 0.3, 0.02)
    """

    means: Rate
    log_scales: Rate
    quats: Rate
    logit_opacities: Rate
    colors: Rate

    def as_tuple(self) -> Rates:
        """The rates in the order of the 14 packed attributes."""
        return (self.means, self.log_scales, self.quats, self.logit_opacities, self.colors)

    @classmethod
    def of(cls, rates: Sequence[float]) -> LearningRates:
        """From five rates in the order of :meth:`as_tuple`."""
        return cls(**dict(zip(cls.model_fields, rates, strict=True)))


class IngestConfig(Section):
    """Chunks, source views and the working resolution (paper Sec. III-C, IV-A)."""

    chunk_frames: int = Field(20, ge=2, le=200, description="Frames of a chunk; the last one may be shorter.")
    source_every: int = Field(4, ge=1, le=20, description="Every n-th frame is a source view, the others held out.")
    width_px: int = Field(1280, ge=16, le=4096, description="Working width of all images.")
    height_px: int = Field(720, ge=16, le=4096, description="Working height of all images.")
    cameras: tuple[str, ...] | None = Field(None, description="Cameras to use, by name; null: all.")
    points: str | None = Field(None, description="A PLY file with coloured points, for a log without LiDAR.")
    complete_facades: bool = Field(
        True, description="Complete façades above the LiDAR's view as far as the images bear it out."
    )
    strict: bool = Field(False, description="Fail on a missing or unreadable image or sweep instead of marking it.")
    min_actor_travel_m: float = Field(0.5, ge=0, description="A track that moves less is part of the background.")
    min_actor_points: int = Field(10, ge=1, description="An actor with fewer LiDAR points is left out and counted.")
    min_actor_frames: int = Field(3, ge=1, description="An actor seen in fewer frames is left out and counted.")


class InitialConfig(Section):
    """Gaussians on LiDAR points and a fixed number far away (paper Sec. III-A)."""

    max_points: int = Field(400_000, ge=100, description="Near Gaussians at most; voxel size follows from it.")
    distant_count: int = Field(10_000, ge=0, description="Gaussians of the distant region.")
    distant_radius_m: float = Field(200.0, gt=10, description="Radius of the distant region's shell.")
    neighbours: int = Field(16, ge=4, le=64, description="LiDAR neighbourhood for normal and thickness.")
    opacity: float = Field(0.6, gt=0, lt=1, description="Opacity of near Gaussians at the start.")
    max_range_m: float = Field(
        100.0, gt=1, description="LiDAR points farther from the path are left to the distant region."
    )


class LossConfig(Section):
    """Weights of the rendering loss (paper Eq. 9–11, Sec. III-C)."""

    rgb: float = Field(0.8, ge=0)
    perceptual: float = Field(0.2, ge=0, description="λ_lpips; the distance is the project's own perceptual one.")
    ssim: float = Field(0.2, ge=0)
    depth: float = Field(0.01, ge=0, description="Source views only.")
    novel: float = Field(0.5, ge=0, description="Weight of the novel-view terms.")
    perceptual_every: int = Field(4, ge=1, description="The perceptual term is taken in every n-th iteration.")
    perceptual_views: int = Field(1, ge=1, description="There on crops of so many source and so many novel views.")


class AdamConfig(Section):
    """Tuned Adam, to be tuned for the horizon that it is used at (``configs/baselines.yaml``)."""

    learning_rates: LearningRates | None = Field(
        None, description="null: the rates that were tuned for 24 iterations of 6 views, one set a stage."
    )
    schedule: Literal["cosine", "constant"] = Field("cosine", description="Of all rates, over the iterations.")


class DensityConfig(Section):
    """When and how per-scene 3DGS adds and removes Gaussians; iterations count in a run of 30 000."""

    start: int = Field(500, ge=0, description="No growth up to this iteration.")
    stop: int = Field(15_000, ge=0, description="No growth, pruning or reset from this iteration on.")
    every: int = Field(100, ge=1, description="Grow and prune in every n-th iteration.")
    reset_every: int = Field(3000, ge=1, description="Opacities are lowered in every n-th iteration.")
    grow_gradient: float = Field(2e-4, ge=0, description="Screen-space gradient, the image from −1 to 1.")
    grow_scale: float = Field(0.01, gt=0, description="Of the extent: clones up to this size, splits above.")
    prune_opacity: float = Field(0.005, gt=0, lt=0.5)
    prune_scale: float = Field(0.1, gt=0, description="Of the extent; larger ones go, after the first reset.")
    max_gaussians: int = Field(1_000_000, ge=1, description="Growth stops here; the published recipe has no bound.")


class PerSceneConfig(Section):
    """Per-scene 3DGS as published (Kerbl et al. 2023; gsplat's ``simple_trainer`` and ``DefaultStrategy``)."""

    iterations: int = Field(30_000, ge=1, le=200_000, description="One view each; all schedules scale with it.")
    means_lr: float = Field(1.6e-4, ge=0, description="Metres per step and metre of the scene's extent.")
    means_lr_end_fraction: float = Field(
        0.01, gt=0, le=1, description="Learning rate of the means at the end, as a fraction of that at the start."
    )
    log_scales_lr: float = Field(5e-3, ge=0)
    quats_lr: float = Field(1e-3, ge=0)
    logit_opacities_lr: float = Field(5e-2, ge=0)
    sh_lr: float = Field(2.5e-3, ge=0, description="Of the spherical harmonics' constant term: colours × 1/C0.")
    rgb: float = Field(0.8, ge=0, description="Weight of L1.")
    ssim: float = Field(0.2, ge=0, description="Weight of 1 − SSIM.")
    depth: float = Field(0.0, ge=0, description="Weight of the LiDAR depth term, as in loss.depth; published: none.")
    density: DensityConfig = DensityConfig()


class OptimiserConfig(Section):
    """GNet and ENet: the unrolled learned optimiser (paper Sec. III-C, III-D)."""

    iterations: int = Field(24, ge=1, le=10_000, description="T.")
    views_per_iteration: int = Field(6, ge=1, description="Source views rendered in each iteration.")
    novel_views_per_iteration: int = Field(0, ge=0, description="Fixed novel views rendered in each iteration.")
    loss: LossConfig = LossConfig()
    method: Literal["learned", "adam"] = Field("learned", description="adam: the tuned per-attribute baseline.")
    adam: AdamConfig = AdamConfig()
    weights: str = Field(
        "builtin", description="builtin, builtin:NAME (another network's, e.g. gnet), or a path to a .safetensors file."
    )
    learning_rates: LearningRates | None = Field(
        None,
        description="Step sizes of the learned optimiser; null: those that its weights were trained with. Presets are "
        "tuned for the built-in weights, so set null with others. gnet.refine.lr_before_refine takes precedence.",
    )
    constrain_ground: bool = Field(
        True, description="Gaussians that lie on the ground move and turn within the ground's plane only."
    )
    split_fraction: float = Field(
        0.0, ge=0, le=4, description="Fraction of Gaussians to split before the start, largest image residual first."
    )
    snapshots: int = Field(6, ge=0, description="Intermediate scenes kept for the curve of accuracy against seconds.")
    seed: int = Field(0, ge=0)

    @property
    def refine_iterations(self) -> int:
        """How many of the T iterations belong to the refinement part."""
        return 0


class RefineConfig(Section):
    """The refinement part of GNet: Gaussians are split, then optimised further with other weights."""

    fraction_of_iterations: float = Field(2 / 3, gt=0, lt=1, description="Part of gnet.iterations spent on refinement.")
    split_fraction: float = Field(
        0.3, ge=0, le=4, description="Fraction of Gaussians to split before refinement, largest image residual first."
    )
    weights: str = Field(
        "builtin:enet", description="As gnet.weights. ENet's weights were trained on scenes with split Gaussians."
    )
    lr_before_refine: LearningRates | None = Field(
        None, description="Learning rates of the first part when refinement follows; null: the same as gnet's."
    )


class GnetConfig(OptimiserConfig):
    """GNet, or in its place a baseline that reconstructs from source views too (``configs/baselines.yaml``)."""

    method: Literal["learned", "adam", "standard_3dgs", "street_gs", "g3r"] = Field(  # type: ignore[assignment]
        "learned",
        description="adam: tuned per attribute; standard_3dgs, street_gs: per-scene 3DGS without and with actors; "
        "g3r: learned from recorded views alone, with weights of its own.",
    )
    per_scene: PerSceneConfig = PerSceneConfig()
    refine: RefineConfig | None = Field(
        None, description="The last iterations of the method learned, on split Gaussians; null: no refinement part."
    )

    @property
    def refinement(self) -> RefineConfig | None:
        """The refinement part that runs, if any: baselines have none, nor has a single iteration."""
        return self.refine if self.method == "learned" and self.iterations > 1 else None

    @property
    def refine_iterations(self) -> int:
        """Iterations of the refinement part; at least one iteration is left on either side."""
        if self.refinement is None:
            return 0
        wanted = max(1, round(self.refinement.fraction_of_iterations * self.iterations))
        return min(wanted, self.iterations - 1)


class NovelViewsConfig(Section):
    """Views beside the path that are fixed: the source frames' poses, shifted (design: +3 and −3 m only)."""

    shifts_m: tuple[float, ...] = Field((3.0, -3.0), description="Left is positive.")
    lidar_max_points: int = Field(200_000, ge=100, description="Points drawn in the LiDAR map.")


class FnetConfig(Section):
    """FNet: the one-step diffusion fixer (paper Sec. III-B)."""

    model: Literal["small", "sd-turbo"] = "small"
    weights: str = Field("builtin", description="builtin, or a folder with the model's weights.")
    timestep: int = Field(200, ge=1, le=999, description="τ.")
    batch_views: int = Field(4, ge=1)
    seed: int = Field(0, ge=0)
    gate: float = Field(
        0.0,
        ge=0,
        le=1,
        description="A view is fixed where more than this share of it is thin or not borne out by images.",
    )
    half: bool | None = Field(None, description="bfloat16; null: where the device is faster with it.")


class EvaluateConfig(Section):
    """What is measured after a stage."""

    shifts_m: tuple[float, ...] = Field((1.0, 2.0, 3.0, 4.0, 5.0), description="Each is rendered on both sides.")
    distributions: bool = Field(True, description="Fréchet and kernel distances against the chunk's real images.")
    every: int = Field(1, ge=1, description="At shifts, every n-th frame of the chunk is rendered.")
    bootstrap: int = Field(200, ge=0, description="Resamples over frames for the 95 % interval of the kernel distance.")
    pictures: int = Field(3, ge=0, description="Pictures kept for the report.")
    inception: str | None = Field(None, description="TorchScript of InceptionV3 (see metrics/published.py): FID too.")
    lpips: str | None = Field(None, description="TorchScript of LPIPS on VGG: LPIPS too, where there is a truth.")


class RangeConfig(Section):
    """Where a scene counts as reliable beside the path: limits on what its guards lose against the path itself."""

    shifts_m: tuple[float, ...] = Field(
        (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0), min_length=1, description="Each is rendered on both sides."
    )
    every: int = Field(4, ge=1, description="Every n-th frame of the chunk is rendered.")
    max_drop_db: float = Field(3.0, gt=0, description="The median view's estimated PSNR falls by no more.")
    max_hidden: float = Field(0.1, gt=0, le=1, description="No more pixels than this that no recorded image bears out.")
    max_thin: float = Field(
        0.02, gt=0, le=1, description="No more pixels than this that are covered by less than half."
    )
    max_floating: float = Field(0.02, gt=0, le=1, description="No more pixels than this far before the LiDAR's depth.")
    max_undetected: float = Field(
        0.3, gt=0, le=1, description="No more of what a detector finds on the path is lost to it."
    )
    lidar_max_points: int = Field(20_000, ge=100, description="Points drawn in the LiDAR map.")


def _word(value: object) -> object:
    """YAML reads on and off as true and false."""
    return {True: "on", False: "off"}[value] if isinstance(value, bool) else value


EffectSetting = Annotated[Literal["auto", "on", "off"], BeforeValidator(_word)]
ToldSetting = Annotated[Literal["auto", "off"], BeforeValidator(_word)]
"""Of an effect that is measured and told, and not modelled: it cannot be set on."""


class EffectsConfig(Section):
    """Parts of the forward model that a scene may or may not need: on, off, or as its plan decides.

    ``effects=none`` (or ``auto``, ``on``, ``off``) sets them all; on: those that are modelled.
    """

    rigid_actors: EffectSetting = "auto"
    nonrigid_actors: EffectSetting = "auto"
    distant_region: EffectSetting = "auto"
    rolling_shutter: EffectSetting = "auto"
    lens_distortion: EffectSetting = "auto"
    exposure: EffectSetting = "auto"
    motion_blur: EffectSetting = "auto"
    view_dependent_colour: EffectSetting = "auto"
    lidar_depth: EffectSetting = "auto"
    anti_aliasing: EffectSetting = "auto"
    ego_mask: EffectSetting = "auto"
    darkness: ToldSetting = Field("auto", description="Measured and told; not modelled.")


class PipelineConfig(Section):
    """The whole configuration: one section per stage."""

    ingest: IngestConfig = IngestConfig()
    initial: InitialConfig = InitialConfig()
    gnet: GnetConfig = GnetConfig()
    novel_views: NovelViewsConfig = NovelViewsConfig()
    fnet: FnetConfig = FnetConfig()
    enet: OptimiserConfig = OptimiserConfig(iterations=12, novel_views_per_iteration=6)
    evaluate: EvaluateConfig = EvaluateConfig()
    effects: EffectsConfig = EffectsConfig()
