"""Whether disk and memory are likely to suffice: estimates from sizes of images and numbers of Gaussians."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from flows.machine.facts import count_cores
from flows.machine.memory import memory_limit_gib
from flows.pipeline.memory_plan import (
    ChunkSize,
    choose_threads,
    estimate_chunk_size,
    grow_until,
    needs_disk,
    predict_memory,
)
from flows.preflight.store_checks import free_space_mib
from genre_tasks.config import PipelineConfig

if TYPE_CHECKING:
    from genre_tasks.logs.types import Camera, DrivingLog

# Measured on demo and small runs. Images are stored as they were recorded; EXR compresses renders little.
_RECORDED_BYTES_PER_PX = 0.2
_NOVEL_VIEW_BYTES_PER_PX = 28
_FIXED_VIEW_BYTES_PER_PX = 6
_BYTES_PER_GAUSSIAN = 120
_BYTES_PER_POINT = 16
_POINTS_PER_SWEEP = 100_000
_REPORT_MIB = 5

_CLEARLY_TOO_LITTLE = 0.7
"""Memory is estimated from other machines, so that less than the estimate may still suffice."""


def estimate_disk_mib(log: DrivingLog, cameras: Sequence[Camera], config: PipelineConfig, chunks: int) -> float:
    """Estimates how much a run adds to the store.

    Args:
        log: what is reconstructed.
        cameras: those that are used.
        config: the effective configuration.
        chunks: how many chunks are computed.

    Returns:
        MiB, as if nothing were in the store yet.
    """
    frames = min(config.ingest.chunk_frames, log.frame_count)
    recorded_px = sum(camera.lens.width_px * camera.lens.height_px for camera in cameras)
    images = frames * recorded_px * _RECORDED_BYTES_PER_PX
    points = frames * _POINTS_PER_SWEEP * _BYTES_PER_POINT
    # The most that there may be; LiDAR may give fewer Gaussians.
    size = estimate_chunk_size(log, cameras, config)
    rendered_px = size.novel_views * config.ingest.width_px * config.ingest.height_px
    views = rendered_px * (_NOVEL_VIEW_BYTES_PER_PX + _FIXED_VIEW_BYTES_PER_PX)
    gnet = grow_until("evaluate/gnet", size, config).gaussians
    enet = grow_until("evaluate/enet", size, config).gaussians
    gaussians = size.gaussians + gnet * (1 + config.gnet.snapshots) + enet * (1 + config.enet.snapshots)
    return chunks * ((images + points + views + gaussians * _BYTES_PER_GAUSSIAN) / 2**20 + _REPORT_MIB)


def assess_disk(root: Path, needed_mib: float) -> str | None:
    """Compares the free space with an estimate.

    Args:
        root: the store's folder.
        needed_mib: what the run may add.

    Returns:
        A warning, or ``None``.
    """
    free_mib = free_space_mib(root)
    if free_mib >= needed_mib:
        return None
    return (
        f"the disk of the store ({root}) has {free_mib / 1024:.1f} GiB of free space, and the run may add about "
        f"{needed_mib / 1024:.1f} GiB to what is stored"
    )


def assess_memory(
    size: ChunkSize, config: PipelineConfig, stages: Iterable[str], *, has_budget: bool = False
) -> str | None:
    """Compares the memory that this process may use with what the stages will take.

    Args:
        size: of a chunk.
        config: the effective configuration.
        stages: names of the stages that will run.
        has_budget: whether a budget chooses the settings. It leaves out those that the limit is too low for, so that
            the limit is no error here.

    Returns:
        A warning, or ``None``.

    Raises:
        ResourceError: the limit that the user sets is too low for a stage.
    """
    needed_mib = 0.0
    for stage in stages:
        grown = grow_until(stage, size, config)
        memory = predict_memory(stage, grown, config, choose_threads(stage, grown, config, count_cores()))
        if not has_budget:
            # Raises where the limit is too low.
            needs_disk(stage, memory, config)
        needed_mib = max(needed_mib, memory.with_images_on_disk_mib)
    machine_gib = memory_limit_gib()
    if machine_gib < _CLEARLY_TOO_LITTLE * needed_mib / 1024:
        return (
            f"this process may use {machine_gib:.1f} GiB of memory, and the run needs about {needed_mib / 1024:.1f} "
            f"GiB; {_describe_what_needs_less(config, has_budget)}"
        )
    limit_gib = config.limits.memory_gib
    if limit_gib is not None and machine_gib < limit_gib:
        return (
            f"the limit on memory is {limit_gib:.1f} GiB, and this process may use {machine_gib:.1f} GiB: stages are "
            "planned for the smaller of the two"
        )
    return None


def _describe_what_needs_less(config: PipelineConfig, has_budget: bool) -> str:
    if has_budget:
        return "the budget chooses among its table's settings that need less, if there are any"
    # A scene from a file has the file's Gaussians, whatever the settings say.
    if config.initial.scene is not None:
        return "smaller images (ingest.width_px) or fewer Gaussians in the file need less"
    return "smaller images or fewer Gaussians (ingest.width_px, initial.max_points) need less"
