"""Views of a chunk from a log's images; unreadable ones are noted, or an error under ``strict``."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from genre_tasks.config import IngestConfig
from genre_tasks.errors import InputError
from genre_tasks.logs.types import Camera
from genre_tasks.scene.chunk import View
from genre_tasks.scene.image_decoding import decode_pixels, read_image_size
from genre_tasks.scene.transforms import invert_se3
from genre_tasks.stages.chunk_reading import ChunkReading

REMEDY = "Fetch the file again, or run without strict to go on without it."


def read_views(reading: ChunkReading, cameras: Sequence[Camera]) -> tuple[list[View], list[NDArray[np.uint8] | None]]:
    """Reads the images of a chunk.

    Every ``source_every``-th frame is a source view, the others are held out.

    Args:
        reading: the chunk; its issues grow.
        cameras: that are used.

    Returns:
        Views ordered by frame and camera, and the decoded pixels [H, W, 3] of source views (``None`` for the others).

    Raises:
        InputError: an image is missing, or it or its pose is unreadable, under ``strict``.
    """
    config = reading.config
    log = reading.log
    views: list[View] = []
    pixels: list[NDArray[np.uint8] | None] = []
    chunk_SE3_world = invert_se3(reading.world_SE3_chunk)
    for n, frame in enumerate(reading.frames):
        reading.report(n, "images")
        # Counted within the chunk: its first frame is a source frame, wherever the chunk begins in the log.
        is_source = n % config.source_every == 0
        for camera in cameras:
            try:
                data = log.image_bytes(camera.name, frame)
            except InputError as error:
                _note_or_raise(reading, error.problem, camera, frame, missing=False)
                continue
            if data is None:
                _note_or_raise(reading, "there is no image", camera, frame, missing=True)
                continue
            problem, decoded = _decode(config, camera, data)
            if problem:
                _note_or_raise(reading, problem, camera, frame, missing=False)
                continue
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
                timestamp_s=log.camera_timestamp_s(camera.name, frame),
                chunk_SE3_camera=chunk_SE3_world @ world_SE3_camera,
                # The bytes are stored as they came; the lens is of the working resolution, to which they are decoded.
                lens=camera.lens.resized(config.width_px, config.height_px),
                image=data,
            )
            views.append(view)
            # Pixels are for colouring points, which must not look at held-out images. They are large, and dropped at
            # once.
            pixels.append(decoded if is_source else None)
    return views, pixels


def _note_or_raise(reading: ChunkReading, problem: str, camera: Camera, frame: int, missing: bool) -> None:
    # A long log has a bad image now and then: without ``strict`` the rest of it is still worth a scene.
    if reading.config.strict:
        raise reading.input_error(problem, REMEDY, camera.name, frame)
    reading.add_issue("missing_image" if missing else "unreadable_image", problem, frame, camera.name)


def _decode(config: IngestConfig, camera: Camera, data: bytes) -> tuple[str, NDArray[np.uint8] | None]:
    """(what is wrong or "", pixels at the working resolution)."""
    try:
        width, height = read_image_size(data)
        # Held-out images are decoded too, so that an unreadable one is found here and not hours later.
        pixels = decode_pixels(data, config.width_px, config.height_px)
    except InputError as error:
        return error.problem, None
    # A crop, a thumbnail or another camera's image: the intrinsics of this camera would be wrong for it.
    lens = camera.lens
    if (width, height) != (lens.width_px, lens.height_px):
        return f"the image is {width}×{height}, the camera's lens is {lens.width_px}×{lens.height_px}", None
    return "", pixels
