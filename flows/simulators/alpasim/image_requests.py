"""Requests for images, from the wire to the renderer."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from flows.simulators.alpasim import sensorsim_pb2
from flows.simulators.alpasim.local_frame import LocalFrame
from flows.simulators.alpasim.wire_lenses import read_lens
from flows.simulators.alpasim.wire_poses import read_pose_pair
from flows.simulators.image_request import ActorPose, CameraDescription, ImageRequest
from genre_tasks.errors import ConfigError, InputError

MAX_OBJECTS = 4096
"""Objects of one image; a street has some hundred."""

MAX_SIDE_PX = 1 << 14

_ROW_SHUTTERS = (sensorsim_pb2.UNKNOWN, sensorsim_pb2.ROLLING_TOP_TO_BOTTOM)


def read_image_request(
    request: sensorsim_pb2.RGBRenderRequest,
    frame: LocalFrame,
    cameras: Mapping[str, CameraDescription],
    known_actors: Iterable[str],
) -> ImageRequest:
    """Reads what an image shall show.

    A client that sends no object at all wants the recorded traffic. One that sends any sends all of the traffic:
    objects that the scene has no Gaussians of, such as the ego vehicle, are left out, and actors that are not sent are
    absent.

    Args:
        request: of the wire.
        frame: that its poses are stated in.
        cameras: of the run, by name.
        known_actors: track ids of the run.

    Returns:
        The request in the log's world.

    Raises:
        InputError: a value is missing, not finite or absurd.
        ConfigError: the camera model or the shutter is one that GenRe does not render.

    Frames that end when they start, and those of a global shutter, are one moment: the middle.
    """
    width_px, height_px = _read_size(request)
    lens = read_lens(request.camera_intrinsics, width_px, height_px)
    start_us = request.frame_start_us
    end_us = request.frame_end_us
    if end_us < start_us:
        raise InputError(
            f"the frame ends at {end_us} µs, before it starts at {start_us} µs", remedy="Send the end after the start."
        )
    if not request.HasField("sensor_pose"):
        raise InputError("the request has no sensor pose", remedy="Send the camera's pose at start and end.")
    start, end = read_pose_pair(request.sensor_pose, "the camera")
    shutter = request.camera_intrinsics.shutter_type
    moving = request.sensor_pose.start_pose != request.sensor_pose.end_pose
    if shutter not in (*_ROW_SHUTTERS, sensorsim_pb2.GLOBAL) and moving and end_us > start_us:
        raise ConfigError(
            f"the shutter type {shutter} is not rendered, only rows from top to bottom",
            remedy="Send ROLLING_TOP_TO_BOTTOM or GLOBAL.",
        )
    middle_s = (start_us + end_us) / 2e6
    rolling = shutter in _ROW_SHUTTERS
    camera = request.camera_intrinsics.logical_id
    return ImageRequest(
        lens=lens,
        start_world_SE3_camera=frame.to_world(start),
        end_world_SE3_camera=frame.to_world(end),
        start_s=start_us / 1e6 if rolling else middle_s,
        end_s=end_us / 1e6 if rolling else middle_s,
        actors=_read_objects(request, frame, frozenset(known_actors)),
        # A camera that only the simulator has fires with the mean of the rig.
        camera=camera if camera in cameras else None,
    )


def _read_size(request: sensorsim_pb2.RGBRenderRequest) -> tuple[int, int]:
    # An image of no stated size has that of its lens.
    width_px = request.resolution_w or request.camera_intrinsics.resolution_w
    height_px = request.resolution_h or request.camera_intrinsics.resolution_h
    if not (1 <= width_px <= MAX_SIDE_PX and 1 <= height_px <= MAX_SIDE_PX):
        raise InputError(
            f"an image of {width_px} × {height_px} pixels cannot be rendered",
            remedy="Send resolution_w and resolution_h.",
        )
    return width_px, height_px


def _read_objects(
    request: sensorsim_pb2.RGBRenderRequest, frame: LocalFrame, known: frozenset[str]
) -> tuple[ActorPose, ...] | None:
    objects = request.dynamic_objects
    if len(objects) > MAX_OBJECTS:
        raise InputError(f"{len(objects)} objects are too many for one image", remedy=f"Send at most {MAX_OBJECTS}.")
    if not objects:
        return None
    actors = []
    for entry in objects:
        if entry.track_id not in known:
            continue
        start, end = read_pose_pair(entry.pose_pair, f"object '{entry.track_id}'")
        actors.append(ActorPose(entry.track_id, frame.to_world(start), frame.to_world(end)))
    return tuple(actors)
