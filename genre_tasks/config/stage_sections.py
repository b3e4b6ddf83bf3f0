"""Sections of the stages that do not optimise: reading a log, the first Gaussians, novel views, fixing, evaluation."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from genre_tasks.config.section import Distances, FilePath, FilePlacement, Section, Seed, Shifts, Text, TextList


class IngestConfig(Section):
    """Chunks, source views and the working resolution (paper Sec. III-C, IV-A)."""

    chunk_frames: int = Field(20, ge=2, le=200, description="Frames of a chunk; the last chunk may be shorter.")
    source_every: int = Field(
        4,
        ge=1,
        le=20,
        description="Every n-th frame has source views, which scenes are fitted to; others are held out.",
    )
    # The paper's resolution (Sec. IV-A). Presets for a CPU take a sixteenth of its pixels.
    width_px: int = Field(
        1280,
        ge=16,
        le=4096,
        description="Working width of all images, pixels. Images of another shape are used at as many pixels in "
        "their own, and none is enlarged beyond the size of the largest.",
    )
    height_px: int = Field(720, ge=16, le=4096, description="Working height of all images, pixels; see width_px.")
    cameras: TextList | None = Field(None, description="Names of the cameras to use; null: all.")
    points: FilePath | None = Field(
        None, description="Path of a PLY file with coloured points, for a log without LiDAR."
    )
    scene: FilePath | None = Field(
        None,
        description="Path of a file of Gaussians whose own depth stands in for LiDAR where there is none, as "
        "`genre enhance` sets it; points take precedence.",
    )
    placement: FilePlacement = Field(FilePlacement(), description="From the axes of points and scene to the world.")
    complete_facades: bool = Field(
        True, description="Complete façades above the LiDAR's field of view, as far as images support it."
    )
    strict: bool = Field(
        False,
        description="Fail on what `genre check` warns of and on unreadable files, instead of going on.",
    )
    min_actor_travel_m: float = Field(
        0.5, ge=0, le=1e6, description="A track that moves less than this, in metres, is part of the background."
    )
    min_actor_points: int = Field(
        10, ge=1, le=1_000_000_000, description="An actor with fewer LiDAR points than this is left out and reported."
    )
    min_actor_frames: int = Field(
        3, ge=1, le=1_000_000, description="An actor that exists in fewer frames than this is left out and reported."
    )

    @model_validator(mode="after")
    def _require_two_source_frames(self) -> Self:
        # Frames 0, n, 2n, … of a chunk are source frames, and one alone has no parallax.
        if self.source_every >= self.chunk_frames:
            raise ValueError(
                f"source_every ({self.source_every}) must be less than chunk_frames ({self.chunk_frames}): "
                "a chunk needs two source frames"
            )
        return self


class InitialConfig(Section):
    """Gaussians on LiDAR points, and a number of them far away (paper Sec. III-A); or those of a file."""

    scene: FilePath | None = Field(
        None,
        description="Path of a file of Gaussians to start from, in any format that `genre export` writes; null: they "
        "are placed on LiDAR points.",
    )
    placement: FilePlacement = Field(FilePlacement(), description="From the axes of scene to the world.")

    max_points: int = Field(
        400_000,
        ge=100,
        le=100_000_000,
        description="Largest number of Gaussians on LiDAR points; the voxel size follows from it.",
    )
    distant_count: int = Field(10_000, ge=0, le=100_000_000, description="Number of Gaussians of the distant region.")
    distant_radius_m: float = Field(
        200.0, gt=10, le=1e6, description="Radius in metres of the shell that the distant region starts on."
    )
    neighbours: int = Field(
        16, ge=4, le=64, description="LiDAR points that give a Gaussian its normal and its thickness."
    )
    # Nearer to 0 or 1 its logit leaves float32.
    opacity: float = Field(
        0.6, ge=0.001, le=0.999, description="Opacity of the Gaussians on LiDAR points at the start."
    )
    max_range_m: float = Field(
        100.0,
        gt=1,
        le=1e6,
        description="LiDAR points farther than this from the path, in metres, are left to the distant region.",
    )


class NovelViewsConfig(Section):
    """Views beside the path that the fixer repairs: the poses of the source frames, shifted."""

    # Without one there is no image to fix.
    shifts_m: Annotated[Shifts, Field(min_length=1)] = Field(
        (3.0, -3.0), description="Distances from the path in metres; positive is to the left."
    )
    every: int = Field(
        1,
        ge=1,
        le=1_000_000,
        description="Each shift is used at every n-th source frame. Shifts take turns: with 2, one side at even and "
        "the other at odd frames, so that half as many views are repaired.",
    )
    lidar_max_points: int = Field(
        200_000, ge=100, le=100_000_000, description="Largest number of points drawn in the LiDAR map."
    )


class FnetConfig(Section):
    """FNet: the one-step diffusion model that repairs renders (paper Sec. III-B)."""

    # The small network is the default, as it runs on a CPU and its weights ship.
    model: Literal["small", "sd-turbo"] = Field(
        "small",
        description="small: the network that ships; sd-turbo: the paper's, slow on a CPU, whose weights do not ship.",
    )
    weights: Text = Field("builtin", description="builtin, or the path of a folder with the model's weights.")
    timestep: int = Field(
        200,
        ge=1,
        le=999,
        description="Diffusion timestep τ of the single step; the one that the weights were trained at.",
    )
    batch_views: int = Field(4, ge=1, le=10_000, description="Views that are fixed at once; more need more memory.")
    seed: Seed = Field(0, description="Seed of the diffusion noise.")
    gate: float = Field(
        0.0,
        ge=0,
        le=1,
        description="A view is fixed where more than this fraction of its pixels is thinly covered or not supported by "
        "recorded images; 0: every view is fixed.",
    )
    max_network_px: int | None = Field(
        None,
        ge=64,
        le=4096,
        description="Largest width and height that the network sees: larger views are reduced for it by a whole "
        "factor, and its correction is enlarged; null: no limit.",
    )
    half: bool | None = Field(None, description="Compute in bfloat16; null: where the device is faster with it.")
    temporal: bool = Field(
        False, description="In a simulation, look pixels up in the fixed image of the frame before, too."
    )

    @model_validator(mode="after")
    def _require_correction(self) -> Self:
        # SD-Turbo draws the whole image, which would be blurred where it is enlarged.
        if self.model == "sd-turbo" and self.max_network_px is not None:
            raise ValueError("max_network_px is for model: small, whose output is a correction of the render")
        return self


LPIPS_NETWORKS = ("alex", "vgg")
"""Networks of LPIPS that have a name, since a package brings their weights."""


class EvaluateConfig(Section):
    """What is measured after a stage."""

    shifts_m: Distances = Field(
        (1.0, 2.0, 3.0, 4.0, 5.0), description="Distances from the path in metres; each is rendered on both sides."
    )
    distributions: bool = Field(
        True, description="Measure Fréchet and kernel distances between renders and the chunk's real images."
    )
    every: int = Field(1, ge=1, le=1_000_000, description="Beside the path, every n-th frame of the chunk is rendered.")
    bootstrap: int = Field(
        200,
        ge=0,
        le=1_000_000,
        description="Resamples over frames for the 95 % interval of the kernel distance; 0: no interval.",
    )
    pictures: int = Field(3, ge=0, le=1000, description="Number of pictures kept for the report.")
    inception: FilePath | None = Field(
        None, description="Path of a TorchScript file of InceptionV3; with it FID is measured, too."
    )
    lpips: FilePath | None = Field(
        None,
        description="Network of LPIPS, measured where there is a truth: alex or vgg with the weights of the extra "
        "`lpips`, or the path of a TorchScript file.",
    )


# No stage has this section: it belongs to the command ``genre range``.
class RangeConfig(Section):
    """Where a scene counts as reliable beside the path: how much worse its guards may be than on the path."""

    shifts_m: Annotated[Distances, Field(min_length=1)] = Field(
        (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0),
        description="Distances from the path in metres; each is rendered on both sides.",
    )
    every: int = Field(4, ge=1, le=1_000_000, description="Every n-th frame of the chunk is rendered.")
    max_drop_db: float = Field(
        3.0, gt=0, le=100, description="Largest drop of the median view's estimated PSNR against the path, dB."
    )
    max_hidden: float = Field(
        0.1, gt=0, le=1, description="Largest extra fraction of pixels whose depth agrees with no recorded image."
    )
    max_thin: float = Field(
        0.02, gt=0, le=1, description="Largest extra fraction of pixels that Gaussians cover by less than half."
    )
    max_floating: float = Field(
        0.02, gt=0, le=1, description="Largest extra fraction of pixels rendered far before the LiDAR's depth."
    )
    max_undetected: float = Field(
        0.3, gt=0, le=1, description="Largest fraction of a detector's detections on the path that may be lost."
    )
    # Fewer than for the fixer: here the map only tells what floats.
    lidar_max_points: int = Field(
        20_000, ge=100, le=100_000_000, description="Largest number of points drawn in the LiDAR map."
    )
