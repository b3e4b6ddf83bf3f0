"""What the sensor service answers: messages of the wire to messages of the wire, without any network."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import version

import numpy as np
from numpy.typing import NDArray

from flows.simulators.alpasim import common_pb2, sensorsim_pb2
from flows.simulators.alpasim.image_bytes import check_format, encode_pixels
from flows.simulators.alpasim.image_requests import ReadImage, read_image_request
from flows.simulators.alpasim.served_scene import ServedScene
from flows.simulators.alpasim.timestamps import to_microseconds
from flows.simulators.alpasim.wire_lenses import write_camera_spec
from flows.simulators.alpasim.wire_poses import write_pose
from flows.simulators.scene_renderer import SceneRenderer
from flows.simulators.service_metrics import ServiceMetrics, SilentMetrics
from genre_tasks.errors import ConfigError, InputError

PROTOCOL_VERSION = (0, 54, 0)
"""Of AlpaSim's messages, whose names and numbers the ``.proto`` files here have."""

SILENT = SilentMetrics()

_MASK_COLOR = 0


class SensorService:
    """Answers the calls of ``SensorsimService``.

    Args:
        scenes: of one or more runs, by the scene's name.
        metrics: where images are counted.
    """

    def __init__(self, scenes: Mapping[str, ServedScene], metrics: ServiceMetrics = SILENT) -> None:
        self._scenes = scenes
        self._metrics = metrics

    def get_version(self, _: common_pb2.Empty) -> common_pb2.VersionId:
        """Gives the versions of GenRe and of the protocol."""
        major, minor, patch = PROTOCOL_VERSION
        api = common_pb2.VersionId.APIVersion(major=major, minor=minor, patch=patch)
        return common_pb2.VersionId(version_id=f"genre {version('genre')}", grpc_api_version=api)

    def get_available_scenes(self, _: common_pb2.Empty) -> common_pb2.AvailableScenesReturn:
        """Names the scenes that are served."""
        return common_pb2.AvailableScenesReturn(scene_ids=list(self._scenes))

    def get_loaded_scenes(self, _: common_pb2.Empty) -> sensorsim_pb2.LoadedScenesReturn:
        """Names the same scenes as loaded: all are before the first call."""
        entries = [
            sensorsim_pb2.LoadedSceneEntry(scene_id=name, loaded_instance_count=1, reusable_instance_count=1)
            for name in self._scenes
        ]
        return sensorsim_pb2.LoadedScenesReturn(scenes=entries, loaded_instance_capacity=len(entries))

    def get_available_cameras(
        self, request: sensorsim_pb2.AvailableCamerasRequest
    ) -> sensorsim_pb2.AvailableCamerasReturn:
        """Describes the cameras of a run's rig.

        Args:
            request: names the scene.

        Returns:
            Lens, name and place on the rig of each, named as in the bundle.

        Raises:
            InputError: no such scene is served.
        """
        scene = self._find_scene(request.scene_id)
        cameras = [
            sensorsim_pb2.AvailableCamerasReturn.AvailableCamera(
                intrinsics=write_camera_spec(camera),
                rig_to_camera=write_pose(scene.frame.to_rig(camera.rig_SE3_camera)),
                logical_id=camera.name,
            )
            for camera in scene.renderer.cameras.values()
        ]
        return sensorsim_pb2.AvailableCamerasReturn(available_cameras=cameras)

    def get_available_trajectories(
        self, request: sensorsim_pb2.AvailableTrajectoriesRequest
    ) -> sensorsim_pb2.AvailableTrajectoriesReturn:
        """Gives the recorded path of the rig.

        Args:
            request: names the scene.

        Returns:
            One path in the local frame, one pose for each log frame.

        Raises:
            InputError: no such scene is served.
        """
        scene = self._find_scene(request.scene_id)
        times_s, world_SE3_ego = scene.renderer.ego_trajectory()
        poses = [
            common_pb2.PoseAtTime(pose=write_pose(pose), timestamp_us=to_microseconds(time_s))
            for time_s, pose in zip(times_s, scene.frame.place_rig(world_SE3_ego), strict=True)
        ]
        trajectory = sensorsim_pb2.AvailableTrajectoriesReturn.AvailableTrajectory(
            trajectory=common_pb2.Trajectory(poses=poses)
        )
        return sensorsim_pb2.AvailableTrajectoriesReturn(available_trajectories=[trajectory])

    def get_available_ego_masks(self, _: common_pb2.Empty) -> sensorsim_pb2.AvailableEgoMasksReturn:
        """Names the cameras whose images show the recording vehicle itself; a scene's name stands for its rig."""
        entries = [
            sensorsim_pb2.AvailableEgoMasksReturn.EgoMaskMetadata(
                ego_mask_id=sensorsim_pb2.EgoMaskId(camera_logical_id=camera, rig_config_id=name)
            )
            for name, scene in self._scenes.items()
            for camera in scene.masks
        ]
        return sensorsim_pb2.AvailableEgoMasksReturn(ego_mask_metadata=entries)

    def render_rgb(self, request: sensorsim_pb2.RGBRenderRequest) -> sensorsim_pb2.RGBRenderReturn:
        """Renders one image.

        Args:
            request: scene, camera, time and traffic.

        Returns:
            The encoded image.

        Raises:
            InputError: a value is missing or absurd, or no such scene is served.
            ConfigError: GenRe does not render such a camera, or does not encode such images.
            ResourceError: too many calls wait.
        """
        read = self._read(request)
        images = self._find_scene(request.scene_id).renderer.render_batch(read.requests)
        self._metrics.count_images(1)
        return self._encode(request, read.finish(images))

    def batch_render_rgb(self, request: sensorsim_pb2.BatchRGBRenderRequest) -> sensorsim_pb2.BatchRGBRenderReturn:
        """Renders several images, most often of all cameras at one moment.

        Args:
            request: the cameras' requests.

        Returns:
            An answer for each, in their order; one that cannot be rendered says so, and the others are rendered.

        Raises:
            InputError: there are more images than one call may have.
            ResourceError: too many calls wait.
        """
        most = min(scene.renderer.limits.max_batch for scene in self._scenes.values())
        if len(request.items) > most:
            raise InputError(f"{len(request.items)} images are too many for one call", remedy=f"Send at most {most}.")
        answers = [sensorsim_pb2.BatchRGBRenderReturnItem(camera_name=item.camera_name) for item in request.items]
        readable: dict[str, dict[int, ReadImage]] = {}
        for k, item in enumerate(request.items):
            try:
                readable.setdefault(item.request.scene_id, {})[k] = self._read(item.request)
            except (InputError, ConfigError) as error:
                answers[k].error_message = str(error)
        for scene_id, requests in readable.items():
            if not requests:
                continue
            for k, pixels in _render_all(self._find_scene(scene_id).renderer, requests).items():
                if isinstance(pixels, InputError):
                    answers[k].error_message = str(pixels)
                    continue
                answers[k].result.CopyFrom(self._encode(request.items[k].request, pixels))
                answers[k].success = True
        self._metrics.count_images(sum(answer.success for answer in answers))
        return sensorsim_pb2.BatchRGBRenderReturn(items=answers)

    def render_lidar(self, _: sensorsim_pb2.LidarRenderRequest) -> sensorsim_pb2.LidarRenderReturn:
        """Is not there: the protocol asks for sensors that no scene of GenRe has.

        Raises:
            ConfigError: always.
        """
        raise ConfigError(
            "LiDAR sweeps of PANDAR128 and AT128 sensors are not simulated",
            remedy="Simulate the log's own sensor: genre simulate RUN --sensors lidar.",
        )

    def render_aggregated(self, _: sensorsim_pb2.AggregatedRenderRequest) -> sensorsim_pb2.AggregatedRenderReturn:
        """Is not there: the protocol has calls for images alone.

        Raises:
            ConfigError: always.
        """
        raise ConfigError("render_aggregated is not served", remedy="Call batch_render_rgb.")

    def _find_scene(self, scene_id: str) -> ServedScene:
        scene = self._scenes.get(scene_id)
        if scene is None:
            raise InputError(f"no scene '{scene_id[:80]}' is served", remedy=f"Known: {', '.join(self._scenes)}.")
        return scene

    def _read(self, request: sensorsim_pb2.RGBRenderRequest) -> ReadImage:
        scene = self._find_scene(request.scene_id)
        check_format(request.image_format, request.image_quality)
        if request.insert_ego_mask:
            self._find_mask(request)
        return read_image_request(request, scene)

    def _encode(
        self, request: sensorsim_pb2.RGBRenderRequest, pixels: NDArray[np.uint8]
    ) -> sensorsim_pb2.RGBRenderReturn:
        if request.insert_ego_mask:
            mask = _resize_mask(self._find_mask(request), pixels.shape[0], pixels.shape[1])
            pixels = np.where(mask[..., None], np.uint8(_MASK_COLOR), pixels)
        encoded = encode_pixels(pixels, request.image_format, request.image_quality)
        return sensorsim_pb2.RGBRenderReturn(image_bytes=encoded)

    def _find_mask(self, request: sensorsim_pb2.RGBRenderRequest) -> NDArray[np.bool_]:
        mask_id = request.ego_mask_id
        mask = self._find_scene(request.scene_id).masks.get(mask_id.camera_logical_id)
        if mask is None or mask_id.rig_config_id != request.scene_id:
            raise InputError(
                f"there is no ego mask '{mask_id.camera_logical_id[:80]}' of '{mask_id.rig_config_id[:80]}'",
                remedy="Send one that get_available_ego_masks names, or insert none.",
            )
        return mask


def _render_all(renderer: SceneRenderer, wanted: Mapping[int, ReadImage]) -> dict[int, NDArray[np.uint8] | InputError]:
    """The images by number, or why one cannot be rendered."""
    try:
        images = iter(renderer.render_batch([request for read in wanted.values() for request in read.requests]))
    except InputError as error:
        if len(wanted) == 1:
            return dict.fromkeys(wanted, error)
        # The renderer takes all or none: one by one, those that can be rendered are.
        rendered: dict[int, NDArray[np.uint8] | InputError] = {}
        for k, read in wanted.items():
            rendered |= _render_all(renderer, {k: read})
        return rendered
    return {k: read.finish([next(images) for _ in read.requests]) for k, read in wanted.items()}


def _resize_mask(mask: NDArray[np.bool_], height: int, width: int) -> NDArray[np.bool_]:
    # The nearest pixel: a mask has no values in between.
    rows = (np.arange(height) + 0.5) * mask.shape[0] / height
    columns = (np.arange(width) + 0.5) * mask.shape[1] / width
    return np.asarray(mask[rows.astype(np.int64)[:, None], columns.astype(np.int64)])
