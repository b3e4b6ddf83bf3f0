"""A simulator that speaks to the sensor service over gRPC, as AlpaSim does."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import grpc
import numpy as np
from numpy.typing import NDArray

from benchmarks.exchange.service_report import CAMERAS
from flows.simulators.alpasim import common_pb2, sensorsim_pb2
from flows.simulators.alpasim.server import SERVICE
from flows.simulators.alpasim.wire_poses import read_pose, write_pose
from genre_tasks.lidar_simulation.ego_motion import interpolate_poses
from genre_tasks.logs.types import Float64


@dataclass(frozen=True)
class Simulator:
    """A client that knows of the scene what the service says."""

    channel: grpc.Channel
    scene_id: str
    cameras: tuple[sensorsim_pb2.AvailableCamerasReturn.AvailableCamera, ...]
    times_us: NDArray[np.int64]
    local_SE3_rig: Float64

    @staticmethod
    def connect(address: str) -> Simulator:
        """Asks for scene, cameras and path."""
        channel = grpc.insecure_channel(address)
        (scene_id,) = ask(
            channel, "get_available_scenes", common_pb2.Empty(), common_pb2.AvailableScenesReturn
        ).scene_ids
        cameras = ask(
            channel,
            "get_available_cameras",
            sensorsim_pb2.AvailableCamerasRequest(scene_id=scene_id),
            sensorsim_pb2.AvailableCamerasReturn,
        ).available_cameras
        (path,) = ask(
            channel,
            "get_available_trajectories",
            sensorsim_pb2.AvailableTrajectoriesRequest(scene_id=scene_id),
            sensorsim_pb2.AvailableTrajectoriesReturn,
        ).available_trajectories
        poses = path.trajectory.poses
        return Simulator(
            channel=channel,
            scene_id=scene_id,
            cameras=tuple(cameras[:CAMERAS]),
            times_us=np.array([pose.timestamp_us for pose in poses], np.int64),
            local_SE3_rig=np.stack([read_pose(pose.pose, "the rig") for pose in poses]),
        )

    def rig_at(self, time_us: int) -> Float64:
        """The recorded rig [4, 4] at a moment."""
        seconds = (self.times_us - self.times_us[0]) / 1e6
        moment = np.array([(time_us - self.times_us[0]) / 1e6])
        return np.asarray(interpolate_poses(self.local_SE3_rig, seconds, moment)[0])


def ask(channel: grpc.Channel, method: str, request: Any, answer: Any) -> Any:
    """Calls a method of the service and waits for the answer."""
    call = channel.unary_unary(f"/{SERVICE}/{method}", type(request).SerializeToString, answer.FromString)
    return call(request, timeout=300)


def make_plain_request(simulator: Simulator, size_px: tuple[int, int]) -> sensorsim_pb2.RGBRenderRequest:
    """Asks for a PNG of the first camera at the first pose of the path.

    Args:
        simulator: connected.
        size_px: width and height of the image.

    Returns:
        The request.
    """
    camera = simulator.cameras[0]
    pose = write_pose(simulator.local_SE3_rig[0] @ read_pose(camera.rig_to_camera, "the camera"))
    moment_us = int(simulator.times_us[0])
    return sensorsim_pb2.RGBRenderRequest(
        scene_id=simulator.scene_id,
        resolution_h=size_px[1],
        resolution_w=size_px[0],
        camera_intrinsics=camera.intrinsics,
        frame_start_us=moment_us,
        frame_end_us=moment_us,
        sensor_pose=sensorsim_pb2.PosePair(start_pose=pose, end_pose=pose),
        image_format=sensorsim_pb2.PNG,
    )
