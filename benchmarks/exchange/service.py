"""The sensor service as AlpaSim drives it: a rollout over gRPC, timed, its images compared with the library's."""

from __future__ import annotations

import io
import time
from collections.abc import Sequence
from typing import Any

import grpc
import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from benchmarks.common.bench import NotMeasuredError, Row
from benchmarks.common.context import THREADS
from benchmarks.exchange.service_report import CAMERAS, IMAGE_PX
from benchmarks.exchange.simulator_client import Simulator, ask, make_plain_request
from flows.simulators.alpasim import sensorsim_pb2
from flows.simulators.alpasim.local_frame import LocalFrame, read_local_frame
from flows.simulators.alpasim.sensor_service import SensorService
from flows.simulators.alpasim.served_scene import ServedScene
from flows.simulators.alpasim.server import SensorServer
from flows.simulators.alpasim.timestamps import to_microseconds
from flows.simulators.alpasim.wire_poses import read_pose, write_pose
from flows.simulators.scene_renderer import ActorDescription, SceneRenderer
from genre_tasks.lidar_simulation.ego_motion import interpolate_poses
from genre_tasks.logs.types import Float64
from genre_tasks.render import render_views
from genre_tasks.rollout.rig import RolloutView
from genre_tasks.scene.chunk import View
from genre_tasks.scene_edits.chunk_scene import ChunkScene
from storage.codecs.png import to_pixels

STEPS = 200
SHUTTER_US = 15_000
_SIDEWAYS_M = 1.0
_AHEAD_M = 0.5
_COMPARED_FRAMES = 8


def measure_service(store: str, run: str, steps: int = STEPS) -> Row:
    """Drives a run as AlpaSim does: beside the recorded path, all actors ahead of their recorded places.

    Args:
        store: folder of the store.
        run: the run's name, or the start of it.
        steps: of the rollout, spread evenly over the run.

    Returns:
        ``failed`` calls, milliseconds of an image asked for alone and in batches of all cameras, and
        ``max_difference`` of 255 between images at recorded moments and those of the library.

    Raises:
        NotMeasuredError: the run has fewer cameras.
    """
    torch.set_num_threads(THREADS)
    renderer = SceneRenderer(store, run)
    if len(renderer.cameras) < CAMERAS:
        raise NotMeasuredError(f"the rig has {len(renderer.cameras)} cameras, {CAMERAS} are asked for")
    frame = read_local_frame(renderer.scenes)
    service = SensorService({renderer.name: ServedScene(renderer, frame)})
    with SensorServer(service) as server:
        simulator = Simulator.connect(server.address)
        rollout = _drive(simulator, renderer.actors(), frame, steps)
        difference = _compare(simulator, renderer, frame)
        simulator.channel.close()
    log = str(renderer.scenes.record["log"])
    return {
        "log": log,
        "run": renderer.name,
        "steps": steps,
        "cameras": CAMERAS,
        "size_px": list(IMAGE_PX),
        **rollout,
        "max_difference": difference,
    }


def _drive(simulator: Simulator, actors: Sequence[ActorDescription], frame: LocalFrame, steps: int) -> Row:
    first_us = int(simulator.times_us[0])
    last_us = int(simulator.times_us[-1]) - SHUTTER_US
    alone_ms: list[float] = []
    batch_ms: list[float] = []
    failed = 0
    for step in range(-1, steps):
        # One step more, which loads code and scenes.
        start_us = first_us + (last_us - first_us) * max(step, 0) // max(steps - 1, 1)
        batch = sensorsim_pb2.BatchRGBRenderRequest()
        for camera in simulator.cameras:
            request = _make_request(simulator, camera, actors, frame, start_us)
            batch.items.add(camera_name=camera.logical_id, request=request)
        for item in batch.items:
            begin = time.perf_counter()
            failed += not _succeeds(simulator, "render_rgb", item.request, sensorsim_pb2.RGBRenderReturn)
            alone_ms.append(1e3 * (time.perf_counter() - begin))
        begin = time.perf_counter()
        failed += not _succeeds(simulator, "batch_render_rgb", batch, sensorsim_pb2.BatchRGBRenderReturn)
        batch_ms.append(1e3 * (time.perf_counter() - begin) / len(batch.items))
    alone_ms = alone_ms[CAMERAS:]
    batch_ms = batch_ms[1:]
    return {
        "images": len(alone_ms) + CAMERAS * len(batch_ms),
        "failed": failed,
        "alone_ms": _summarise(alone_ms),
        "batch_ms": _summarise(batch_ms),
    }


def _summarise(values: Sequence[float]) -> dict[str, float]:
    median, p95 = np.percentile(values, [50, 95]).tolist()
    return {"median": median, "p95": p95, "max": max(values), "n": len(values)}


def _succeeds(simulator: Simulator, method: str, request: Any, answer: Any) -> bool:
    try:
        got = ask(simulator.channel, method, request, answer)
    except grpc.RpcError:
        return False
    return all(item.success for item in got.items) if method == "batch_render_rgb" else bool(got.image_bytes)


def _make_request(
    simulator: Simulator,
    camera: sensorsim_pb2.AvailableCamerasReturn.AvailableCamera,
    actors: Sequence[ActorDescription],
    frame: LocalFrame,
    start_us: int,
) -> sensorsim_pb2.RGBRenderRequest:
    place = read_pose(camera.rig_to_camera, "the camera")
    ends = [start_us, start_us + SHUTTER_US]
    pair = [write_pose(_shift_rig(simulator, time_us) @ place) for time_us in ends]
    request = sensorsim_pb2.RGBRenderRequest(
        scene_id=simulator.scene_id,
        resolution_h=IMAGE_PX[1],
        resolution_w=IMAGE_PX[0],
        camera_intrinsics=camera.intrinsics,
        frame_start_us=ends[0],
        frame_end_us=ends[1],
        sensor_pose=sensorsim_pb2.PosePair(start_pose=pair[0], end_pose=pair[1]),
        image_format=sensorsim_pb2.JPEG,
        image_quality=95,
    )
    request.camera_intrinsics.shutter_type = sensorsim_pb2.ROLLING_TOP_TO_BOTTOM
    for actor in actors:
        poses = [write_pose(_lead_actor(actor, frame, time_us)) for time_us in ends]
        pose_pair = sensorsim_pb2.PosePair(start_pose=poses[0], end_pose=poses[1])
        request.dynamic_objects.add(track_id=actor.track_id, pose_pair=pose_pair)
    return request


def _shift_rig(simulator: Simulator, time_us: int) -> Float64:
    # Once over to the left and back along the whole path.
    pose = simulator.rig_at(time_us).copy()
    fraction = (time_us - simulator.times_us[0]) / (simulator.times_us[-1] - simulator.times_us[0])
    pose[:3, 3] += _SIDEWAYS_M * np.sin(np.pi * fraction) * pose[:3, 1]
    return pose


def _lead_actor(actor: ActorDescription, frame: LocalFrame, time_us: int) -> Float64:
    seconds = actor.times_s - actor.times_s[0]
    moment = np.clip(time_us / 1e6 - actor.times_s[0], 0.0, seconds[-1])
    pose = np.asarray(interpolate_poses(actor.world_SE3_box, seconds, np.array([moment]))[0]).copy()
    pose[:3, 3] += _AHEAD_M * pose[:3, 0]
    return frame.to_local(pose)


def _compare(simulator: Simulator, renderer: SceneRenderer, frame: LocalFrame) -> int:
    """Largest difference of a channel to the library's render, at recorded poses, frames and traffic."""
    largest = 0
    by_camera = {camera.logical_id: camera for camera in simulator.cameras}
    for number in renderer.scenes.chunk_numbers:
        loaded = renderer.scenes.load(number)
        frames = set(loaded.chunk.frames[:: max(1, len(loaded.chunk.frames) // _COMPARED_FRAMES)])
        for view in loaded.chunk.views:
            if view.frame not in frames or view.camera not in by_camera:
                continue
            lens = view.lens.resized(*IMAGE_PX)
            with torch.no_grad():
                shown = RolloutView(view.camera, view.frame, view.chunk_SE3_camera, lens)
                expected = to_pixels(render_views(loaded.scene, [shown]).color)[0]
            request = _repeat_view(simulator, by_camera[view.camera], view, loaded, frame)
            # Once with the recorded traffic of that moment, once with all actors put where they were.
            for objects in ([], _repeat_traffic(loaded, view.frame, frame)):
                request.dynamic_objects.extend(objects)
                largest = max(largest, _measure_difference(simulator, request, expected))
    return largest


def _repeat_view(
    simulator: Simulator,
    camera: sensorsim_pb2.AvailableCamerasReturn.AvailableCamera,
    view: View,
    loaded: ChunkScene,
    frame: LocalFrame,
) -> sensorsim_pb2.RGBRenderRequest:
    request = make_plain_request(simulator, IMAGE_PX)
    pose = write_pose(frame.to_local(loaded.chunk.world_SE3_chunk @ view.chunk_SE3_camera))
    request.camera_intrinsics.CopyFrom(camera.intrinsics)
    request.sensor_pose.CopyFrom(sensorsim_pb2.PosePair(start_pose=pose, end_pose=pose))
    request.frame_start_us = to_microseconds(view.timestamp_s)
    request.frame_end_us = request.frame_start_us
    return request


def _repeat_traffic(loaded: ChunkScene, moment: int, frame: LocalFrame) -> list[sensorsim_pb2.DynamicObject]:
    # Any object makes the list all of the traffic, also where no actor is.
    objects = [sensorsim_pb2.DynamicObject(track_id="EGO")]
    for node in loaded.scene.actors:
        box = node.pose(moment)
        if box is not None:
            pose = write_pose(frame.to_local(loaded.chunk.world_SE3_chunk @ box))
            pair = sensorsim_pb2.PosePair(start_pose=pose, end_pose=pose)
            objects.append(sensorsim_pb2.DynamicObject(track_id=node.track_id, pose_pair=pair))
    return objects


def _measure_difference(
    simulator: Simulator, request: sensorsim_pb2.RGBRenderRequest, expected: NDArray[np.uint8]
) -> int:
    answer = ask(simulator.channel, "render_rgb", request, sensorsim_pb2.RGBRenderReturn)
    with Image.open(io.BytesIO(answer.image_bytes)) as image:
        pixels = np.array(image).astype(int)
    return int(np.abs(pixels - expected).max())
