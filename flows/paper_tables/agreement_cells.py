"""A cell of table 7: a method's scene of the front camera, as a detector sees it from the front-left one."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import TYPE_CHECKING

from flows.experiments.log_chunks import LogChunk
from flows.experiments.stages import StageRunner, run_stages
from flows.paper_tables.columns import MeasuredCell
from flows.paper_tables.layouts import Layout
from flows.paper_tables.measure import Basis, build_cell, list_stages
from flows.paper_tables.methods import Method
from flows.perception.camera_names import select_front_camera, select_front_left_camera
from flows.pipeline.log_cache import cached_log
from flows.pipeline.stage_runner import ArtifactRef, Job, read_artifact

if TYPE_CHECKING:
    from collections.abc import Mapping

    from flows.perception.camera_transfer import ImagePairs
    from genre_tasks.detection.detector import Detector


@functools.lru_cache(maxsize=2)
def open_cached_detector(detector: str) -> Detector:
    """Opens a detector; the last ones stay open.

    Args:
        detector: file or name, see :func:`genre_tasks.detection.detector.open_detector`.

    Raises:
        ConfigError: a package is missing.
        InputError: the file is missing or holds no detector.
    """
    from genre_tasks.detection.detector import open_detector

    return open_detector(detector)


def restrict_to_front_camera(layout: Layout, log: str) -> Layout:
    """Restricts a table's protocol to the front camera.

    Args:
        layout: the table.
        log: URI of a log, which must have a front-left camera too.

    Raises:
        ConfigError: it has none.
    """
    return replace(layout, protocol=(*layout.protocol, front_camera_setting(log)))


def front_camera_setting(log: str) -> str:
    """Gives the setting that reads the front camera alone.

    Args:
        log: URI of a log, which must have a front-left camera too.

    Raises:
        ConfigError: it has none.
    """
    names = [camera.name for camera in cached_log(log).cameras]
    # Checked before hours of computing.
    select_front_left_camera(names)
    return f"ingest.cameras=[{select_front_camera(names)}]"


def measure_agreement_cell(
    basis: Basis, layout: Layout, method: Method, where: LogChunk, detector_name: str, runner: StageRunner
) -> MeasuredCell:
    """Measures how far a detector's finds on a method's renders agree with those on recorded images.

    Args:
        basis: what all methods share.
        layout: the table.
        method: the row's method.
        where: the chunk.
        detector_name: file or name of the detector.
        runner: runs one stage.

    Returns:
        The cell.

    Raises:
        GenreError: as the stages and the detector raise it.
    """
    # Imported here: what only predicts a table should not load the renderer.
    from flows.perception.camera_transfer import agreement_metrics, detect_pairs

    job = basis.job(layout, method, where)
    refs = run_stages(list_stages(layout, method), job, runner)
    detector = open_cached_detector(detector_name)
    pairs = detect_pairs(detector, render_front_left(job, refs, method.end))
    metrics = agreement_metrics([pairs], has_masks=detector.has_masks)
    return build_cell(method, where, job, refs, metrics)


def render_front_left(job: Job, refs: Mapping[str, ArtifactRef], end: str) -> ImagePairs:
    """Renders a scene of the front camera as the front-left one recorded it.

    Args:
        job: of the scene.
        refs: its stages' artifacts.
        end: the stage whose scene is rendered.

    Raises:
        InputError: the front-left camera has no image in the chunk.
    """
    from flows.perception.camera_transfer import render_camera

    # Its images are read from the log: the chunk was made without this camera.
    log = cached_log(job.log)
    camera = select_front_left_camera([camera.name for camera in log.cameras])
    return render_camera(log, read_artifact(job, refs["ingest"]), read_artifact(job, refs[end]).scene, camera)
