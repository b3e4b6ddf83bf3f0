"""A simulator for tests: it speaks the wire alone, and knows of the scene what the service tells it."""

from __future__ import annotations

import io
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from flows.simulation.run_scenes import RunScenes
from flows.simulators.alpasim import common_pb2, sensorsim_pb2
from flows.simulators.alpasim.local_frame import LocalFrame, read_local_frame
from flows.simulators.alpasim.sensor_service import SensorService
from flows.simulators.alpasim.served_scene import ServedScene
from flows.simulators.alpasim.wire_poses import read_pose, write_pose
from flows.simulators.scene_renderer import SceneRenderer
from genre_tasks.logs.types import Float64
from tests.flows.small_simulation import make_run

PATH = "/nre.grpc.protos.sensorsim.SensorsimService/"
ANSWERS = {
    "render_rgb": sensorsim_pb2.RGBRenderReturn,
    "batch_render_rgb": sensorsim_pb2.BatchRGBRenderReturn,
    "get_version": common_pb2.VersionId,
    "get_available_scenes": common_pb2.AvailableScenesReturn,
    "get_loaded_scenes": sensorsim_pb2.LoadedScenesReturn,
    "get_available_cameras": sensorsim_pb2.AvailableCamerasReturn,
    "get_available_trajectories": sensorsim_pb2.AvailableTrajectoriesReturn,
    "get_available_ego_masks": sensorsim_pb2.AvailableEgoMasksReturn,
}


@dataclass(frozen=True)
class ServedRun:
    """A run, its renderer and its service."""

    store: str
    run: str
    renderer: SceneRenderer
    frame: LocalFrame

    @staticmethod
    def open(folder: Path) -> ServedRun:
        run = make_run(folder)
        renderer = SceneRenderer(str(folder), run)
        return ServedRun(str(folder), run, renderer, read_local_frame(renderer.scenes))

    @cached_property
    def service(self) -> SensorService:
        return SensorService({self.renderer.name: ServedScene(self.renderer, self.frame)})

    @cached_property
    def scenes(self) -> RunScenes:
        return RunScenes(self.store, self.run)


class WireClient:
    """Calls methods by their paths, with bytes."""

    def __init__(self, address: str) -> None:
        import grpc

        self._channel = grpc.insecure_channel(address)

    def __enter__(self) -> WireClient:
        return self

    def __exit__(self, *_: object) -> None:
        self._channel.close()

    def send(self, method: str, payload: bytes) -> bytes:
        answer: bytes = self._channel.unary_unary(PATH + method)(payload, timeout=60)
        return answer

    def start(self, method: str, payload: bytes) -> Any:
        """A call that may be cancelled."""
        return self._channel.unary_unary(PATH + method).future(payload, timeout=60)

    def call(self, method: str, request: Any = None) -> Any:
        payload = b"" if request is None else request.SerializeToString()
        return ANSWERS[method].FromString(self.send(method, payload))

    def status(self, method: str, payload: bytes) -> tuple[str, str]:
        """Name of the status and its details."""
        import grpc

        try:
            self.send(method, payload)
        except grpc.RpcError as error:
            return error.code().name, error.details()
        return "OK", ""

    @cached_property
    def scene_id(self) -> str:
        (scene_id,) = self.call("get_available_scenes").scene_ids
        return str(scene_id)

    @cached_property
    def cameras(self) -> list[Any]:
        request = sensorsim_pb2.AvailableCamerasRequest(scene_id=self.scene_id)
        return list(self.call("get_available_cameras", request).available_cameras)

    @cached_property
    def path(self) -> list[Any]:
        request = sensorsim_pb2.AvailableTrajectoriesRequest(scene_id=self.scene_id)
        (found,) = self.call("get_available_trajectories", request).available_trajectories
        return list(found.trajectory.poses)

    def image_request(self, camera: int = 0, step: int = 4) -> sensorsim_pb2.RGBRenderRequest:
        """What AlpaSim asks for: rig pose times place on the rig, at a time of the path."""
        available = self.cameras[camera]
        rig = read_pose(self.path[step].pose, "the rig")
        pose = write_pose(rig @ read_pose(available.rig_to_camera, "the camera"))
        start_us = self.path[step].timestamp_us
        return sensorsim_pb2.RGBRenderRequest(
            scene_id=self.scene_id,
            resolution_h=available.intrinsics.resolution_h,
            resolution_w=available.intrinsics.resolution_w,
            camera_intrinsics=available.intrinsics,
            frame_start_us=start_us,
            frame_end_us=start_us + 10_000,
            sensor_pose=pose_pair(pose),
            image_format=sensorsim_pb2.PNG,
            image_quality=95,
        )

    def render(self, request: sensorsim_pb2.RGBRenderRequest) -> NDArray[np.uint8]:
        return decode(self.call("render_rgb", request).image_bytes)


def pose_pair(start: common_pb2.Pose, end: common_pb2.Pose | None = None) -> sensorsim_pb2.PosePair:
    return sensorsim_pb2.PosePair(start_pose=start, end_pose=start if end is None else end)


def place_object(track_id: str, local_SE3_box: Float64) -> sensorsim_pb2.DynamicObject:
    return sensorsim_pb2.DynamicObject(track_id=track_id, pose_pair=pose_pair(write_pose(local_SE3_box)))


def decode(encoded: bytes) -> NDArray[np.uint8]:
    with Image.open(io.BytesIO(encoded)) as image:
        return np.array(image)
