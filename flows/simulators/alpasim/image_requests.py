"""Requests for images, from the wire to the renderer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from flows.simulators.alpasim import sensorsim_pb2
from flows.simulators.alpasim.served_scene import ServedScene
from flows.simulators.alpasim.wire_lenses import read_lens
from flows.simulators.alpasim.wire_poses import read_pose_pair
from flows.simulators.image_request import ActorPose, ImageRequest
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.logs.types import Float64, Lens
from genre_tasks.render.wide_lens import CoverTile, LensCover, WideLens, cover_lens
from genre_tasks.scene.transforms import compose_se3, interpolate_pose

MAX_OBJECTS = 4096
"""Objects of one image; a street has some hundred."""

# Takes the place of a wide lens until its tiles are cut.
_AXIS = Lens(1.0, 1.0, 0.5, 0.5, width_px=1, height_px=1)
_ROW_SHUTTERS = (sensorsim_pb2.UNKNOWN, sensorsim_pb2.ROLLING_TOP_TO_BOTTOM)


@dataclass(frozen=True)
class ReadImage:
    """An image as the renderer makes it, and what is left to do then.

    Attributes:
        requests: for the renderer; several where pinholes cover a wide lens.
        cover: how they become one image; ``None``: there is one, and it is the image.
    """

    requests: tuple[ImageRequest, ...]
    cover: LensCover | None = None

    def finish(self, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
        """Makes the image that the client asked for.

        Args:
            images: [H', W', 3] one for each of ``requests``.

        Returns:
            [H, W, 3].
        """
        return images[0] if self.cover is None else self.cover.resample(images)


def read_image_request(request: sensorsim_pb2.RGBRenderRequest, scene: ServedScene) -> ReadImage:
    """Reads what an image shall show.

    A client that sends no object at all wants the recorded traffic. One that sends any sends all of the traffic:
    objects that the scene has no Gaussians of, such as the ego vehicle, are left out, and actors that are not sent are
    absent.

    Args:
        request: of the wire.
        scene: that it asks for.

    Returns:
        The request in the log's world.

    Raises:
        InputError: a value is missing, not finite or absurd.
        ConfigError: the camera model or the shutter is one that GenRe does not render.
    """
    width_px, height_px = _read_size(request, scene)
    lens = read_lens(request.camera_intrinsics, width_px, height_px)
    cover = _cover(lens, width_px, height_px, scene)
    start_us = request.frame_start_us
    end_us = request.frame_end_us
    if end_us < start_us:
        raise InputError(
            f"the frame ends at {end_us} µs, before it starts at {start_us} µs", remedy="Send the end after the start."
        )
    if not request.HasField("sensor_pose"):
        raise InputError("the request has no sensor pose", remedy="Send the camera's pose at start and end.")
    start, end = read_pose_pair(request.sensor_pose, "the camera")
    is_rolling = _check_shutter(request)
    middle_s = (start_us + end_us) / 2e6
    camera = request.camera_intrinsics.logical_id
    image = ImageRequest(
        lens=lens if isinstance(lens, Lens) else _AXIS,
        start_world_SE3_camera=scene.frame.to_world(start),
        end_world_SE3_camera=scene.frame.to_world(end),
        # An image without a readout is of one moment: the middle.
        start_s=start_us / 1e6 if is_rolling else middle_s,
        end_s=end_us / 1e6 if is_rolling else middle_s,
        actors=_read_objects(request, scene),
        # A camera that only the simulator has fires with the mean of the rig.
        camera=camera if camera in scene.renderer.cameras else None,
    )
    if cover is None:
        return ReadImage((image,))
    return ReadImage(tuple(_cut_tile(image, tile) for tile in cover.tiles), cover)


def _cut_tile(image: ImageRequest, tile: CoverTile) -> ImageRequest:
    """The part of a wide image that one pinhole sees, in that part of the readout in which its rows are read."""
    tile_pose = compose_se3(tile.lens_R_tile, np.zeros(3))
    first, last = (tile.first_row, tile.last_row) if image.end_s > image.start_s else (0.0, 1.0)

    def cut(start: Float64, end: Float64) -> tuple[Float64, Float64]:
        return interpolate_pose(start, end, first), interpolate_pose(start, end, last)

    start, end = cut(image.start_world_SE3_camera, image.end_world_SE3_camera)
    actors = image.actors
    if actors is not None:
        actors = tuple(
            ActorPose(actor.track_id, *cut(actor.start_world_SE3_box, actor.end_world_SE3_box)) for actor in actors
        )
    readout_s = image.end_s - image.start_s
    return replace(
        image,
        lens=tile.lens,
        start_world_SE3_camera=start @ tile_pose,
        end_world_SE3_camera=end @ tile_pose,
        start_s=image.start_s + first * readout_s,
        end_s=image.start_s + last * readout_s,
        actors=actors,
        # The renderer would take the vehicle to be turned with the pinhole.
        camera=None,
    )


def _check_shutter(request: sensorsim_pb2.RGBRenderRequest) -> bool:
    """Whether rows are read out one after the other, from the top."""
    shutter = request.camera_intrinsics.shutter_type
    moves = request.sensor_pose.start_pose != request.sensor_pose.end_pose
    lasts = request.frame_end_us > request.frame_start_us
    if shutter not in (*_ROW_SHUTTERS, sensorsim_pb2.GLOBAL) and moves and lasts:
        raise ConfigError(
            f"the shutter type {shutter} is not rendered, only rows from top to bottom",
            remedy="Send ROLLING_TOP_TO_BOTTOM or GLOBAL.",
        )
    return shutter in _ROW_SHUTTERS


def _cover(lens: Lens | WideLens, width_px: int, height_px: int, scene: ServedScene) -> LensCover | None:
    if isinstance(lens, Lens):
        return None
    # One at a time: finding the rays of a large image takes a quarter of a gigabyte for a moment.
    with _cover_lock:
        cover = _cover_lens(lens, width_px, height_px)
    limits = scene.renderer.limits
    wide = max(tile.lens.width_px for tile in cover.tiles)
    high = max(tile.lens.height_px for tile in cover.tiles)
    if wide > limits.max_width_px or high > limits.max_height_px:
        raise InputError(
            f"an image of {width_px} × {height_px} px of so wide a lens takes a render of {wide} × {high} px",
            remedy=f"Ask for a smaller image, or serve more than {limits.max_width_px} × {limits.max_height_px} px.",
        )
    return cover


_cover_lock = Lock()

# A rig has a few wide cameras, and takes images of each all along.
_cover_lens = lru_cache(maxsize=6)(cover_lens)


def _read_size(request: sensorsim_pb2.RGBRenderRequest, scene: ServedScene) -> tuple[int, int]:
    # An image of no stated size has that of its lens.
    width_px = request.resolution_w or request.camera_intrinsics.resolution_w
    height_px = request.resolution_h or request.camera_intrinsics.resolution_h
    limits = scene.renderer.limits
    # Before a lens takes memory for its pixels.
    if not (1 <= width_px <= limits.max_width_px and 1 <= height_px <= limits.max_height_px):
        raise InputError(
            f"an image of {width_px} × {height_px} px is out of bounds",
            remedy=f"Send resolution_w and resolution_h, at most {limits.max_width_px} × {limits.max_height_px}.",
        )
    return width_px, height_px


def _read_objects(request: sensorsim_pb2.RGBRenderRequest, scene: ServedScene) -> tuple[ActorPose, ...] | None:
    objects = request.dynamic_objects
    if len(objects) > MAX_OBJECTS:
        raise InputError(f"{len(objects)} objects are too many for one image", remedy=f"Send at most {MAX_OBJECTS}.")
    if not objects:
        return None
    actors = []
    for entry in objects:
        if entry.track_id not in scene.track_ids:
            continue
        start, end = read_pose_pair(entry.pose_pair, f"object '{entry.track_id}'")
        actors.append(ActorPose(entry.track_id, scene.frame.to_world(start), scene.frame.to_world(end)))
    return tuple(actors)
