"""Renders the images that simulators ask for, from the scenes of a finished run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
import torch
from numpy.typing import NDArray

from flows.simulation.edited_runs import open_run, open_shown_scenes
from flows.simulation.run_scenes import RunScenes
from flows.simulators.image_request import (
    ActorDescription,
    ActorPose,
    CameraDescription,
    ImageRequest,
    RenderLimits,
)
from flows.simulators.placed_actors import ActorPlacer, Readout, place_actors
from flows.simulators.render_queue import RenderQueue
from flows.simulators.request_checks import check_batch, check_request
from flows.simulators.run_facts import read_run_facts
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.errors import InputError
from genre_tasks.logs.types import Float64
from genre_tasks.render import render_views
from genre_tasks.render.types import RenderSettings
from genre_tasks.rollout.camera_motion import place_rollout_views
from genre_tasks.rollout.chunk_layout import lay_out_chunks
from genre_tasks.rollout.handover import cut_at_borders
from genre_tasks.rollout.rig import RigCamera, RolloutView
from genre_tasks.rollout.scene_schedule import SceneSchedule
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.transforms import interpolate_pose, invert_se3
from genre_tasks.scene_edits.actor_names import name_actors
from genre_tasks.scene_edits.chunk_scene import ChunkScene
from genre_tasks.suggestions import did_you_mean
from genre_tasks.threads import torch_threads
from storage.codecs.png import to_pixels

__all__ = [
    "ActorDescription",
    "ActorPose",
    "CameraDescription",
    "ImageRequest",
    "RenderLimits",
    "SceneRenderer",
]

DEFAULT_LIMITS = RenderLimits()
_CHUNKS_IN_MEMORY = 4
"""A client may ask for moments in any order, with actors of other chunks; a rollout drives on and needs two."""
_CALL_PIXELS = 8_000_000
"""That are rendered at once: each takes twenty bytes, and more within the renderer."""


@dataclass(frozen=True)
class _PlacedImage:
    """An image, ready to be rendered: images of one ``group`` share a render.

    Scenes are compared by their identity, so both stay alive for as long as the image waits.
    """

    chunk_scene: ChunkScene
    scene: SceneGraph
    view: RolloutView

    @property
    def group(self) -> tuple[int, int, int, float]:
        # Views of one render share the velocities of actors at a frame, and so the time to the next frame.
        frame_s = 0.0 if self.view.shutter is None else self.view.shutter.frame_s
        return id(self.scene), self.view.lens.width_px, self.view.lens.height_px, frame_s


class SceneRenderer:
    """Renders what cameras see at any pose and moment of a run, with recorded actors or with a simulator's.

    Background and recorded traffic come from the same scenes as those of a rollout: the background by the place, the
    actors by the moment. Several threads may ask at once; one render runs at a time.

    Args:
        store: folder (or URI) of the store.
        run: the run's name, or the start of it.
        stage: initial, gnet or enet; ``None``: the last one of each chunk.
        limits: what one client may ask for.

    Attributes:
        name: of the scene: the run's name.
        cameras: of the rig, by name.
        time_range_s: absolute seconds of the first and the last recorded image.
        limits: what one client may ask for.

    Raises:
        InputError: there is no such run or stage, or an artifact is gone.
        ArtifactCorruptError: an artifact is damaged.
    """

    def __init__(
        self, store: str, run: str, stage: str | None = None, *, limits: RenderLimits = DEFAULT_LIMITS
    ) -> None:
        self._scenes = RunScenes(store, run, stage, chunks_in_memory=_CHUNKS_IN_MEMORY)
        self._facts = read_run_facts(self._scenes, _find_edited_names(store, run, stage))
        layout = lay_out_chunks(self._scenes)
        self._layout = layout
        self._schedule = SceneSchedule(self._scenes, layout, cut_at_borders(layout))
        self._placer = ActorPlacer(self._scenes, self._facts.chunks_by_track, self._facts.names)
        self._settings = RenderSettings(threads=torch.get_num_threads())
        self._queue = RenderQueue(limits.max_waiting)
        self.limits = limits
        self.name: str = str(self._scenes.record["run"])
        self.cameras: Mapping[str, CameraDescription] = MappingProxyType(self._facts.cameras)
        self.time_range_s: tuple[float, float] = self._facts.clock.range_s

    @property
    def scenes(self) -> RunScenes:
        """The scenes of the run, for what else a protocol has to know of it."""
        return self._scenes

    @property
    def queue_length(self) -> int:
        """Calls that are rendered or wait."""
        return self._queue.length

    @property
    def frame_s(self) -> float:
        """Seconds of a log frame."""
        return self._facts.clock.frame_s

    def find_time(self, frame: float) -> float:
        """Gives the absolute seconds of a log frame, or of a moment between two.

        Args:
            frame: log frame of the run.
        """
        return self._facts.clock.find_time(frame)

    def select_cameras(self, names: Sequence[str] | None) -> dict[str, CameraDescription]:
        """Takes some cameras of the rig.

        Args:
            names: of the cameras; ``None``: all.

        Returns:
            The cameras by name, in the order of ``names``.

        Raises:
            InputError: the run has no such camera.
        """
        for name in names or ():
            self._check_camera(name)
        return {name: self.cameras[name] for name in (self.cameras if names is None else names)}

    def ego_trajectory(self) -> tuple[Float64, Float64]:
        """Gives where the recorded vehicle was.

        Returns:
            Absolute seconds [F], one for each log frame, and world_SE3_ego [F, 4, 4], x forward, y left, z up.
        """
        return self._facts.clock.times_s.copy(), self._facts.world_SE3_ego.copy()

    def actors(self) -> tuple[ActorDescription, ...]:
        """Lists the moving actors of the run, in the order in which they appear."""
        return self._facts.actors

    def ego_mask(self, camera: str) -> NDArray[np.bool_] | None:
        """Gives where the recording vehicle itself is in a camera's images.

        Args:
            camera: its name.

        Returns:
            [H, W] at the working resolution, true on the vehicle; ``None`` where the run has no such mask.

        Raises:
            InputError: the run has no such camera.
        """
        self._check_camera(camera)
        mask = self._facts.ego_masks.get(camera)
        return None if mask is None else mask.copy()

    def find_actors(self, words: Sequence[str]) -> tuple[str, ...]:
        """Finds which actors of the run are meant.

        Args:
            words: the log's ids, or readable names.

        Returns:
            The log's id of each.

        Raises:
            InputError: an actor is not known, or is there twice.
        """
        return self._placer.resolve(words)

    def render(self, request: ImageRequest) -> NDArray[np.uint8]:
        """Renders one image.

        Args:
            request: of a client.

        Returns:
            [H, W, 3] sRGB.

        Raises:
            InputError: an actor is not known, the time is outside of the run, a pose is not finite, or the lens or the
                size is out of bounds.
            ResourceError: too many calls wait, or memory does not suffice.
        """
        return self.render_batch([request])[0]

    def render_batch(self, requests: Sequence[ImageRequest]) -> list[NDArray[np.uint8]]:
        """Renders several images; those of one moment share most of the work.

        Args:
            requests: of one client.

        Returns:
            [H, W, 3] sRGB for each, in their order.

        Raises:
            InputError, ResourceError: as :meth:`render`.
        """
        check_batch(requests, self.limits)
        for request in requests:
            self._check(request)
        if not requests:
            return []
        # The renderer's kernel has threads of its own. Those of torch would spin next to them, and make a small image
        # many times slower wherever OMP_WAIT_POLICY is not PASSIVE, as in a program of a user's own.
        with self._queue.turn(), torch_threads(1):
            return self._render(requests)

    def _render(self, requests: Sequence[ImageRequest]) -> list[NDArray[np.uint8]]:
        scenes: dict[tuple[object, ...], SceneGraph] = {}
        placed = [self._place(request, scenes) for request in requests]
        groups: dict[tuple[int, int, int, float], list[int]] = {}
        for k, image in enumerate(placed):
            groups.setdefault(image.group, []).append(k)
        pixels: dict[int, NDArray[np.uint8]] = {}
        for (_, width_px, height_px, _), group in groups.items():
            # A call takes memory by its pixels, so a large group is rendered in parts.
            size = max(1, _CALL_PIXELS // (width_px * height_px))
            for begin in range(0, len(group), size):
                members = group[begin : begin + size]
                # Without gradients the renderer keeps nothing for a backward pass, which takes memory.
                with torch.no_grad():
                    color = render_views(
                        placed[members[0]].scene, [placed[k].view for k in members], self._settings
                    ).color
                pixels |= dict(zip(members, to_pixels(color), strict=True))
        return [pixels[k] for k in range(len(placed))]

    def _place(self, request: ImageRequest, scenes: dict[tuple[object, ...], SceneGraph]) -> _PlacedImage:
        middle = interpolate_pose(request.start_world_SE3_camera, request.end_world_SE3_camera, 0.5)
        readout_s = request.end_s - request.start_s
        middle_s = request.start_s + readout_s / 2
        frame = self._facts.clock.find_frame(middle_s, request.camera)
        chunk_scene = self._find_scene(request, middle, frame, middle_s)
        if request.actors is None:
            scene = chunk_scene.scene
            times = (request.start_s, middle_s, request.end_s) if readout_s else (middle_s,)
            frames = np.array([self._facts.clock.find_frame(time_s, request.camera) for time_s in times])
        else:
            readout = Readout(round(frame), readout_s)
            # A placed actor rests for an image that is taken at once, and recorded ones are where they were.
            frames = np.array([frame]) if request.recorded_actors else readout.frames
            ids = self._placer.resolve([actor.track_id for actor in request.actors])
            wanted = dict(zip(ids, request.actors, strict=True))
            chunk_scene = self._placer.gather(chunk_scene, list(wanted))
            # Images of one moment with equal actors share a scene, and so a render.
            poses = (_describe_pose(track_id, pose) for track_id, pose in wanted.items())
            key = (id(chunk_scene), readout, request.recorded_actors, *poses)
            if key not in scenes:
                scenes[key] = place_actors(chunk_scene, wanted, readout, request.recorded_actors)
            scene = scenes[key]
        return _PlacedImage(chunk_scene, scene, _place_view(request, middle, frames, chunk_scene))

    def _find_scene(self, request: ImageRequest, middle: Float64, frame: float, middle_s: float) -> ChunkScene:
        """The scene whose background is that of the place, and whose traffic is that of the moment."""
        clock = self._facts.clock
        position = middle[:2, 3]
        # A camera of the simulator's own may look anywhere: it does not say where the vehicle faces.
        facing: Float64 | None = None
        lead = 0.0
        if request.camera is not None:
            world_SE3_ego = middle @ invert_se3(self.cameras[request.camera].rig_SE3_camera)
            position = world_SE3_ego[:2, 3]
            facing = world_SE3_ego[:2, 0]
            # Images of one frame belong together, although the vehicle drives on from one camera to the next.
            lead = frame - clock.find_frame(middle_s)
        place = self._layout.find_place(position, frame - lead, facing) + lead
        return self._schedule.find(place, frame)[0].chunk_scene

    def _check(self, request: ImageRequest) -> None:
        if request.camera is not None:
            self._check_camera(request.camera)
        check_request(request, self.limits, self._facts.world_SE3_ego[:, :3, 3])
        first_s, last_s = self.time_range_s
        slack_s = self.frame_s / 2
        if not first_s - slack_s <= (request.start_s + request.end_s) / 2 <= last_s + slack_s:
            raise InputError(
                f"{request.start_s:.6f} to {request.end_s:.6f} s is outside of the run",
                remedy=f"It lasts from {first_s:.6f} to {last_s:.6f} s.",
            )
        if request.actors is not None:
            self.find_actors([actor.track_id for actor in request.actors])

    def _check_camera(self, camera: str) -> None:
        if camera not in self.cameras:
            remedy = f"{did_you_mean(camera, self.cameras)}It has {', '.join(self.cameras)}."
            raise InputError(f"the run has no camera '{camera}'", remedy=remedy)


def _find_edited_names(store: str, run: str, stage: str | None) -> Mapping[str, str] | None:
    """Names of an edited run's actors, which keep those of the recorded run; ``None`` for a recorded one."""
    if not len(open_run(store, run, stage).edits):
        return None
    return name_actors(open_shown_scenes(store, run))


def _place_view(request: ImageRequest, middle: Float64, frames: Float64, chunk_scene: ChunkScene) -> RolloutView:
    """The view of an image: the camera drives from start to end while it is read out."""
    readout_s = request.end_s - request.start_s
    # The camera itself is the vehicle of a path of three poses, so that its motion is measured as a rollout's is.
    rig = (RigCamera(request.camera or "", request.lens, np.eye(4), readout_s),)
    poses = [request.start_world_SE3_camera, middle, request.end_world_SE3_camera] if readout_s else [middle]
    times = readout_s * np.array([0.0, 0.5, 1.0] if readout_s else [0.0])
    path = EgoPath(times, frames, np.stack(poses))
    (view,) = place_rollout_views(path, len(poses) // 2, rig, chunk_scene)
    return view


def _describe_pose(track_id: str, pose: ActorPose) -> tuple[str, bytes, bytes]:
    return track_id, pose.start_world_SE3_box.tobytes(), pose.end_world_SE3_box.tobytes()
