"""How much memory a stage will take, and whether the images of many views have to lie on disk for it.

A stage takes memory for its networks and Gaussians, for the few views it works on at a time, and for the images of all
views that it reads or makes. The last part alone grows with the length of a chunk, and can lie on disk.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from flows.pipeline.memory_limit import usable_memory_gib
from flows.pipeline.scene_size import count_start_gaussians
from genre_tasks.config import PipelineConfig
from genre_tasks.errors import ResourceError
from genre_tasks.logs.log_selection import choose_working_size

if TYPE_CHECKING:
    from flows.pipeline.definition import StageSpec
    from genre_tasks.logs.types import Camera, DrivingLog
    from genre_tasks.scene.chunk import Chunk

_FLOAT_BYTES = 4

# Channels of the images of all views that a stage holds.
_NOVEL_CHANNELS = 10
_FIXED_CHANNELS = 3
_SOURCE_CHANNELS = 4
_STATISTICS_CHANNELS = 6
"""SSIM's, of small images alone."""

# As ``KEPT_PIXELS`` of the losses, whose module loads torch; a test compares the two.
_LARGEST_WITH_STATISTICS_PX = 300_000


@dataclass(frozen=True)
class _Terms:
    """Factors of a stage's memory.

    Attributes:
        base_mib: networks and what does not grow with the chunk.
        gaussian_bytes: for each Gaussian of the scene that it ends with.
        pixel_bytes: for each pixel of the views that are worked on at a time.
        reuse: what freed memory costs that stays with the process, that of earlier stages too, as a factor.
    """

    base_mib: float
    gaussian_bytes: float = 0.0
    pixel_bytes: float = 0.0
    reuse: float = 1.0


# Optimisers take most for a step of the network, which sees all Gaussians at once; the views are few.
_TERMS: Mapping[str, _Terms] = {
    "ingest": _Terms(60, 0, 80, 1.19),
    "effects": _Terms(593, 0, 197, 1.17),
    "initial": _Terms(250, 1370, 0, 1.2),
    "gnet": _Terms(300, 4470, 0, 1.29),
    "novel_views": _Terms(170, 960, 19, 1.67),
    "fnet": _Terms(150, 0, 279, 1.62),
    "enet": _Terms(550, 4600, 0, 1.29),
    "evaluate": _Terms(238, 1100, 840),
}
"""Fitted to stages at 320×180 and 1280×720; ``genre bench full_size`` compares predictions with what runs took."""

_NETWORK_PIXEL_BYTES = 1200
"""Of FNet, for each pixel that its network sees."""

_PROCESS_MIB = 150
"""Python, torch and the pipeline, before a stage begins."""


@dataclass(frozen=True)
class ChunkSize:
    """What the memory of a chunk's stages depends on.

    Attributes:
        cameras: that are used.
        source_views: views that scenes are fitted to.
        novel_views: views beside the path.
        width_px: working width of images.
        height_px: working height of images.
        native_px: pixels of the largest recorded image.
        gaussians: of the scene that the stage starts from.
    """

    cameras: int
    source_views: int
    novel_views: int
    width_px: int
    height_px: int
    native_px: int
    gaussians: int

    @property
    def pixels(self) -> int:
        """Pixels of an image at the working resolution."""
        return self.width_px * self.height_px


@dataclass(frozen=True)
class StageMemory:
    """What a stage takes, as predicted.

    Attributes:
        working_mib: networks, Gaussians, and the views that are worked on at a time.
        images_mib: images of all views.
        reuse: what freed memory costs that stays with the process, as a factor of ``working_mib``.
    """

    working_mib: float
    images_mib: float
    reuse: float = 1.0

    @property
    def with_images_on_disk_mib(self) -> float:
        """Where images lie on disk. What earlier stages left counts, too; under a limit they leave nothing."""
        return self.reuse * self.working_mib

    @property
    def in_memory_mib(self) -> float:
        """Where freed memory stays with the process, which is faster."""
        return self.reuse * self.working_mib + self.images_mib


def estimate_chunk_size(log: DrivingLog, cameras: Sequence[Camera], config: PipelineConfig) -> ChunkSize:
    """Estimates a chunk's size before it is ingested.

    Args:
        log: that is reconstructed.
        cameras: those that are used.
        config: the effective configuration.

    Returns:
        The sizes of a full chunk; LiDAR may give fewer Gaussians.
    """
    frames = min(config.ingest.chunk_frames, log.frame_count)
    # As if every frame had all images: a log with gaps takes less.
    source_views = -(-frames // config.ingest.source_every) * len(cameras)
    width_px, height_px = choose_working_size(config.ingest, cameras)
    return ChunkSize(
        cameras=len(cameras),
        source_views=source_views,
        novel_views=_count_novel_views(source_views, len(cameras), config),
        width_px=width_px,
        height_px=height_px,
        native_px=max((camera.lens.width_px * camera.lens.height_px for camera in cameras), default=0),
        gaussians=count_start_gaussians(config.initial),
    )


def grow_until(stage: str, size: ChunkSize, config: PipelineConfig) -> ChunkSize:
    """Estimates the size at a later stage, where GNet and ENet have split Gaussians before it.

    Args:
        stage: the stage's name.
        size: with the Gaussians of the initial scene.
        config: the effective configuration.

    Returns:
        The size with the Gaussians that the stage starts from.
    """
    # FNet is not among them: it sees images alone.
    before = {"gnet": ("novel_views", "enet", "evaluate/gnet", "evaluate/enet"), "enet": ("evaluate/enet",)}
    for optimiser, later in before.items():
        if stage in later:
            size = replace(size, gaussians=_count_final_gaussians(optimiser, size, config))
    return size


def measure_chunk_size(chunk: Chunk, config: PipelineConfig, gaussians: int) -> ChunkSize:
    """Takes a chunk's size from the chunk itself.

    Args:
        chunk: as ``ingest`` made it.
        config: the effective configuration.
        gaussians: of the scene that the stage starts from.

    Returns:
        The sizes; recorded images play no part in stages after ``ingest``.
    """
    source_views = len(chunk.views_with_role("source"))
    cameras = len(chunk.camera_names)
    novel_views = _count_novel_views(source_views, cameras, config)
    return ChunkSize(cameras, source_views, novel_views, chunk.width_px, chunk.height_px, 0, gaussians)


def _count_novel_views(source_views: int, cameras: int, config: PipelineConfig) -> int:
    """Counts novel views, as if every source frame had an image of every camera."""
    frames = -(-source_views // max(cameras, 1))
    return -(-frames // config.novel_views.every) * cameras * len(config.novel_views.shifts_m)


def predict_memory(stage: str, size: ChunkSize, config: PipelineConfig, threads: int) -> StageMemory:
    """Predicts what a stage takes: sums of terms whose factors were fitted to measurements.

    Args:
        stage: the stage's name.
        size: of its chunk.
        config: the effective configuration.
        threads: of torch.

    Returns:
        Memory of the process, without pages of files.
    """
    terms = _TERMS[stage.partition("/")[0]]
    gaussians = _count_final_gaussians(stage, size, config)
    pixels = _count_pixels_at_a_time(stage, size, config, threads)
    working = terms.gaussian_bytes * gaussians + terms.pixel_bytes * pixels
    if stage == "fnet":
        # Along both axes, as its network sees reduced views.
        reduction = -(-max(size.width_px, size.height_px) // (config.fnet.max_network_px or 10**6))
        working += _NETWORK_PIXEL_BYTES * pixels / max(1, reduction) ** 2
    images = _FLOAT_BYTES * _count_image_values(stage, size, config)
    reuse = terms.reuse if keeps_freed_memory(config) else 1.0
    return StageMemory(_PROCESS_MIB + terms.base_mib + working / 2**20, images / 2**20, reuse)


def choose_threads(stage: str, size: ChunkSize, config: PipelineConfig, threads: int) -> int:
    """Chooses how many threads a stage works with: as many as fit, since each holds images of its own.

    Args:
        stage: the stage's name.
        size: of its chunk.
        config: with the user's limit, if any.
        threads: that there are.

    Returns:
        From 1 to ``threads``; the stage's result does not depend on it.
    """
    least_mib = predict_memory(stage, size, config, 1).working_mib
    # Where even one thread takes too much, fewer threads may save nothing: then the stage has all that there are.
    limit_mib = max(1024 * usable_memory_gib(config), least_mib)
    fewer = range(threads, 1, -1)
    return next((n for n in fewer if predict_memory(stage, size, config, n).working_mib <= limit_mib), 1)


def keeps_freed_memory(config: PipelineConfig) -> bool:
    """Decides whether freed memory may stay with the process, which is faster.

    Args:
        config: with the user's limit, if any.

    Returns:
        False under a limit: later stages would take what earlier ones left, and pass the limit by it.
    """
    return config.limits.memory_gib is None


def _count_final_gaussians(stage: str, size: ChunkSize, config: PipelineConfig) -> int:
    """Gaussians of the scene that a stage works on at its end."""
    count = float(size.gaussians)
    if stage == "gnet" and config.gnet.method != "none":
        refinement = config.gnet.refinement
        count *= (1 + config.gnet.split_fraction) * (1 + (0.0 if refinement is None else refinement.split_fraction))
        # Per-scene training adds Gaussians up to a bound of its own.
        if config.gnet.method in ("standard_3dgs", "street_gs"):
            count = max(count, config.gnet.per_scene.density.max_gaussians)
    elif stage == "enet":
        count *= 1 + config.enet.split_fraction
    return round(count)


def _count_pixels_at_a_time(stage: str, size: ChunkSize, config: PipelineConfig, threads: int) -> float:
    """Pixels of the images that a stage works on at a time."""
    views: dict[str, float] = {
        "effects": threads,
        "gnet": config.gnet.views_per_iteration,
        # All sides of a frame's cameras are rendered in one call.
        "novel_views": size.cameras * len(config.novel_views.shifts_m),
        "fnet": threads * config.fnet.batch_views,
        "enet": config.enet.views_per_iteration + config.enet.novel_views_per_iteration,
        # Each thread scores an image with a network.
        "evaluate": threads,
    }
    return threads * size.native_px if stage == "ingest" else views.get(stage.partition("/")[0], 0) * size.pixels


def _count_image_values(stage: str, size: ChunkSize, config: PipelineConfig) -> int:
    """Values of the images of all views that a stage holds."""
    statistics = _STATISTICS_CHANNELS if size.pixels <= _LARGEST_WITH_STATISTICS_PX else 0
    source = size.source_views * (_SOURCE_CHANNELS + statistics)
    fixed = size.novel_views * _FIXED_CHANNELS
    # Other stages hold one view or one frame at a time.
    channels = {
        "gnet": source,
        "novel_views": size.novel_views * _NOVEL_CHANNELS,
        "fnet": size.novel_views * _NOVEL_CHANNELS + fixed + size.source_views * _SOURCE_CHANNELS,
        "enet": source + fixed + size.novel_views * statistics,
        "evaluate/fnet": size.novel_views * _NOVEL_CHANNELS + fixed,
    }
    return channels.get(stage, 0) * size.pixels


def shrink_batch(spec: StageSpec, section: Any, attempt: int) -> Any:
    """Halves the setting that bounds a stage's memory, once for each attempt that ran out of it.

    Args:
        spec: the stage.
        section: its section of the configuration.
        attempt: how many tries ran out of memory.

    Returns:
        The section; other stages have no such setting, and keep theirs.
    """
    if spec.batch_setting is None or attempt == 0:
        return section
    smaller = max(1, getattr(section, spec.batch_setting) >> attempt)
    return section.model_copy(update={spec.batch_setting: smaller})


def needs_disk(stage: str, memory: StageMemory, config: PipelineConfig) -> bool:
    """Decides whether the images of a stage's views lie on disk.

    Args:
        stage: the stage's name.
        memory: that it will take.
        config: with the user's limit, if any.

    Returns:
        True where they do not fit into memory.

    Raises:
        ResourceError: the limit that is set is too low for the stage even so.
    """
    limit_gib = config.limits.memory_gib
    # The machine's memory is no wish: where a prediction is too high, the stage may still succeed.
    if limit_gib is not None and memory.working_mib > limit_gib * 1024:
        # A scene from a file has the file's Gaussians, whatever the settings say.
        less = "or choose a smaller ingest.width_px or initial.max_points"
        if config.initial.scene is not None:
            less = "choose a smaller ingest.width_px, or remove Gaussians from the file"
        raise ResourceError(
            f"{stage} needs about {memory.working_mib / 1024:.1f} GiB of memory with its images on disk, and may use "
            f"{limit_gib:.1f} GiB",
            remedy=f"Allow more (--memory), {less}.",
            stage=stage,
        )
    return memory.in_memory_mib > usable_memory_gib(config) * 1024
