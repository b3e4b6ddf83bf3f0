"""Views of a chunk from a log's images; those of no use are noted and left out, or an error under ``strict``."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from genre_tasks.errors import InputError
from genre_tasks.log_checks.images import LEFT_OUT, find_unfit, read_image, summarise_findings
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.log_selection import SourceSchedule, select_source_frames
from genre_tasks.logs.types import Camera, Float64
from genre_tasks.scene.chunk import View
from genre_tasks.scene.image_decoding import decode_with_facts
from genre_tasks.scene.transforms import invert_se3
from genre_tasks.stages.chunk_reading import ChunkReading

REMEDY = "Fetch the file again, or run without strict to go on without it."

_STRICT_REMEDY = "Or run without strict to go on without it."
# Between two frames where neither images nor sweeps have times.
_FRAME_S = 0.1
_MISSING = Finding("missing_image", "warning", "there is no image")


def read_views(reading: ChunkReading, cameras: Sequence[Camera]) -> tuple[list[View], list[NDArray[np.uint8] | None]]:
    """Reads the images of a chunk.

    Every ``source_every``-th frame has source views, the others are held out. Where none of its images can be used, the
    next frame that has one takes its place. See :func:`select_source_frames` for cameras that take turns.

    Args:
        reading: the chunk; its issues grow.
        cameras: that are used.

    Returns:
        Views ordered by frame and camera, and the decoded pixels [H, W, 3] of source views (``None`` for the others).

    Raises:
        InputError: an image is missing, unreadable, of another size than the lens, blank or in doubt, under ``strict``.
    """
    config = reading.config
    log = reading.log
    views: list[View] = []
    pixels: list[NDArray[np.uint8] | None] = []
    chunk_SE3_world = invert_se3(reading.world_SE3_chunk)
    remarks: dict[str, list[tuple[int, Finding]]] = {camera.name: [] for camera in cameras}
    # Held-out images are decoded too, so that an unreadable one is found here and not hours later.
    decode = partial(decode_with_facts, width_px=config.width_px, height_px=config.height_px)
    schedule = SourceSchedule(config.source_every)
    for n, frame in enumerate(reading.frames):
        reading.report(n, "images")
        # Counted within the chunk: its first frame is a source frame, wherever the chunk begins in the log.
        is_source = schedule.is_due(n)
        count_before = len(views)
        for camera in cameras:
            image, problem = read_image(partial(log.image_bytes, camera.name, frame), decode)
            if image is not None:
                problem = find_unfit(camera.lens, image.facts)
            if image is None or problem is not None:
                _note_or_raise(reading, problem or _MISSING, camera, frame)
                continue
            remarks[camera.name] += [(frame, f) for f in image.facts.findings if f.severity == "warning"]
            try:
                world_SE3_camera = log.world_SE3_camera(camera.name, frame)
            except InputError as error:
                # The error itself names the file of poses.
                if config.strict:
                    raise
                reading.add_issue("unreadable_pose", error.problem, frame, camera.name)
                continue
            view = View(
                camera=camera.name,
                frame=frame,
                role="source" if is_source else "heldout",
                timestamp_s=_read_time(reading, camera, frame),
                chunk_SE3_camera=chunk_SE3_world @ world_SE3_camera,
                # The bytes are stored as they came; the lens is of the working resolution, to which they are decoded.
                lens=camera.lens.resized(config.width_px, config.height_px),
                image=image.data,
            )
            views.append(view)
            # Pixels are for colouring points, which must not look at held-out images. They are large, and dropped at
            # once.
            pixels.append(image.pixels if is_source else None)
        if is_source and len(views) > count_before:
            schedule.take(n)
    _note_remarks(reading, remarks)
    _supervise_cameras(reading, views, pixels)
    _note_unsupervised_cameras(reading, views)
    return views, pixels


def _supervise_cameras(reading: ChunkReading, views: list[View], pixels: list[NDArray[np.uint8] | None]) -> None:
    """Makes views sources, in place, of cameras that have images between the source frames of the others alone."""
    row_of_frame = {frame: n for n, frame in enumerate(reading.frames)}
    has_images = {view.camera: [False] * len(row_of_frame) for view in views}
    for view in views:
        has_images[view.camera][row_of_frame[view.frame]] = True
    selected = select_source_frames(reading.config.source_every, has_images)
    for n, view in enumerate(views):
        if view.role == "heldout" and row_of_frame[view.frame] in selected[view.camera]:
            views[n] = replace(view, role="source")
            # Decoded once more: only now it shows that they are asked for.
            pixels[n] = decode_with_facts(view.image, reading.config.width_px, reading.config.height_px).pixels


def _note_unsupervised_cameras(reading: ChunkReading, views: list[View]) -> None:
    """Names cameras whose only image lies between the source frames of the others: no scene is fitted to them."""
    supervised = {view.camera for view in views if view.role == "source"}
    for camera in sorted({view.camera for view in views} - supervised):
        detail = "its only image is of no source frame: it supervises nothing; set ingest.source_every=1"
        reading.add_issue("no_source_view", detail, camera=camera)


def _read_time(reading: ChunkReading, camera: Camera, frame: int) -> float:
    """An image's time in seconds; where it is not finite, the one that sweeps and the camera's other images give."""
    read_image_time = partial(reading.log.camera_timestamp_s, camera.name)
    time_s = _read_stated_time(reading, read_image_time, frame)
    if np.isfinite(time_s):
        return time_s
    # What effects compute from times would be NaN in all views of the camera.
    detail = "its time cannot be read; those of sweeps and of the camera's other images give it"
    reading.add_issue("missing_timestamp", detail, frame, camera.name)
    times = np.array([_read_stated_time(reading, read_image_time, f) for f in reading.frames])
    sweep_times = np.array([_read_stated_time(reading, reading.log.frame_timestamp_s, f) for f in reading.frames])
    return float(_fill_times(reading.frames, times, sweep_times)[reading.frames.index(frame)])


def _fill_times(frames: Sequence[int], times: Float64, sweep_times: Float64) -> Float64:
    """Fills in the times of a camera's images where they are missing.

    Args:
        frames: [F] of the chunk.
        times: [F] seconds, of the camera's images; NaN where they are missing.
        sweep_times: [F] seconds, of the sweeps; NaN where they are missing.

    Returns:
        [F] those that are known. Others are the sweep's with the camera's usual offset, and without a sweep's time
        they lie on the line between their neighbours.
    """
    offsets = (times - sweep_times)[np.isfinite(times) & np.isfinite(sweep_times)]
    # The median, so that one wrong time moves no other.
    offset_s = float(np.median(offsets)) if offsets.size else 0.0
    filled = np.where(np.isfinite(times), times, sweep_times + offset_s)
    known = np.flatnonzero(np.isfinite(filled))
    positions = np.asarray(frames, np.float64)
    if len(known) < 2:
        start_s = filled[known[0]] - _FRAME_S * positions[known[0]] if len(known) else 0.0
        return np.where(np.isfinite(filled), filled, start_s + _FRAME_S * positions)
    for row in np.flatnonzero(~np.isfinite(filled)):
        # At an end the line through the two nearest goes on, where one time for all would double velocities.
        before = int(np.clip(np.searchsorted(known, row), 1, len(known) - 1)) - 1
        first, second = known[before], known[before + 1]
        fraction = (positions[row] - positions[first]) / (positions[second] - positions[first])
        filled[row] = filled[first] + fraction * (filled[second] - filled[first])
    return filled


def _read_stated_time(reading: ChunkReading, read_time: Callable[[int], float], frame: int) -> float:
    """The time that the log states for a frame, seconds; NaN where it cannot be read."""
    try:
        return read_time(frame)
    except InputError:
        if reading.config.strict:
            raise
        return math.nan


def require_source_frames(reading: ChunkReading, sources: Sequence[View]) -> None:
    """Checks that a chunk can be reconstructed from its images.

    Args:
        reading: the chunk, after its images were read.
        sources: its source views.

    Raises:
        InputError: they are of fewer than two frames; the error says why images were left out.
    """
    # Frames and not views: six cameras at one moment have no parallax over time.
    count = len({view.frame for view in sources})
    if count >= 2:
        return
    problem = f"the chunk has {count} source frames with images, at least two are needed"
    remedy = "Choose other chunks with --chunks, or a smaller ingest.source_every."
    left_out = [issue for issue in reading.log_issues if issue.kind in LEFT_OUT]
    if left_out:
        if not count:
            # Nothing is left that a denser choice of source frames could take.
            remedy = "Correct the images, or choose other chunks with --chunks."
        first = left_out[0]
        detail = first.detail.removesuffix(".")
        problem += (
            f"; {len(left_out)} images are left out, the first one ({first.camera}, frame {first.frame}): {detail}"
        )
    raise reading.input_error(problem, remedy)


def _note_or_raise(reading: ChunkReading, problem: Finding, camera: Camera, frame: int) -> None:
    # A long log has a bad image now and then: without ``strict`` the rest of it is still worth a scene.
    if reading.config.strict:
        remedy = f"{problem.remedy} {_STRICT_REMEDY}" if problem.remedy else REMEDY
        raise reading.input_error(problem.message, remedy, camera.name, frame)
    reading.add_issue(problem.word, _describe(problem), frame, camera.name)


def _note_remarks(reading: ChunkReading, remarks: Mapping[str, Sequence[tuple[int, Finding]]]) -> None:
    """Notes what is in doubt of images that are used, once a camera."""
    for camera, found in remarks.items():
        for finding in summarise_findings(camera, found):
            if reading.config.strict:
                raise reading.input_error(finding.message, finding.remedy, camera, finding.frames[0])
            reading.add_issue(finding.word, _describe(finding), finding.frames[0], camera)


def _describe(finding: Finding) -> str:
    return f"{finding.message}. {finding.remedy}" if finding.remedy else finding.message
