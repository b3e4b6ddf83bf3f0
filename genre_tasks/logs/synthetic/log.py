"""The synthetic street as a driving log, with its truth at any viewpoint.

Two frames: the *street's*, in which everything is built (origin near the start of the drive, so that float32 suffices
for ray-casting), and the *world* of the log, shifted from it by ``offset_m``, so that code which confuses a local frame
with the world's does not go unnoticed.
"""

from __future__ import annotations

import hashlib
import io
import threading
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from urllib.parse import parse_qsl

import numpy as np
from numpy.typing import NDArray

from genre_tasks.code_closure import digest_modules
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.logs.synthetic.annotations import annotate_actors
from genre_tasks.logs.synthetic.camera_effects import CameraEffects
from genre_tasks.logs.synthetic.camera_images import Renderer, camera_rays
from genre_tasks.logs.synthetic.ego_vehicle import FRAME_S, build_rig, draw_drive, ego_SE3_camera
from genre_tasks.logs.synthetic.lidar import scan_sweep
from genre_tasks.logs.synthetic.noise import rotate
from genre_tasks.logs.synthetic.parameters import parse_parameters
from genre_tasks.logs.synthetic.pose_errors import PoseErrors
from genre_tasks.logs.synthetic.raycast import RayCaster
from genre_tasks.logs.synthetic.recent_values import RecentValues
from genre_tasks.logs.synthetic.road import Road, make_generator
from genre_tasks.logs.synthetic.shading import draw_light
from genre_tasks.logs.synthetic.street_layout import StreetLayout, build_layout
from genre_tasks.logs.synthetic.truth import StreetTruth
from genre_tasks.logs.types import Camera, CuboidTrack, Float64, Lens, Sweep

# In 2023: a time as recorded logs have it, which a float32 cannot hold to the second.
_EPOCH_S = 1.7e9
# A chunk's images are drawn once, however large they are: a PNG takes no more than its pixels.
_CACHED_FRAMES = 20
_LEAST_CACHE_BYTES = 32 << 20
_PIXEL_BYTES = 3


def open_synthetic(rest: str) -> SyntheticStreet:
    """Opens a synthetic log.

    Args:
        rest: ``street?seed=1000&frames=20``, which is what follows ``synthetic:`` in a URI.

    Returns:
        The log.

    Raises:
        ConfigError: no such kind of log, or a parameter that is unknown, given twice or out of range.

    >>> open_synthetic("street?seed=1000&frames=12").name
    'street-seed=1000-frames=12'
    """
    kind, _, query = rest.partition("?")
    if kind != "street":
        raise ConfigError(f"there is no synthetic log {kind!r}", remedy="Write synthetic:street?seed=1000.")
    try:
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=bool(query))
    except ValueError as error:
        raise ConfigError(f"cannot read the parameters {query!r}", remedy="Write key=value&key=value.") from error
    keys = [key for key, _ in pairs]
    repeated = next((key for key in keys if keys.count(key) > 1), None)
    if repeated is not None:
        raise ConfigError(f"the parameter {repeated!r} is given twice", remedy="Give each parameter once.")
    return SyntheticStreet(dict(pairs))


class SyntheticStreet:
    """A procedural street, drawn from a seed; a ``DrivingLog`` (see there for methods, units and axes).

    Opening is cheap: geometry is built when the first image, sweep or track is asked for.

    Args:
        uri_query: the parameters of ``StreetParameters`` as text.

    Attributes:
        parameters: what the query asked for.
        camera_effects: how the cameras record the street.
        pose_errors: by how much recorded camera poses err.
        offset_m: [3] added to the street's coordinates to get the world's.

    Raises:
        ConfigError: a parameter is unknown or out of range.
    """

    def __init__(self, uri_query: Mapping[str, str]) -> None:
        self.parameters = parse_parameters(uri_query)
        self._uri = "synthetic:street?" + "&".join(f"{key}={value}" for key, value in uri_query.items())
        self._cameras = build_rig(self.parameters)
        self._road = Road(self.parameters.seed)
        self._ego = draw_drive(self.parameters, self._road)
        self.camera_effects = CameraEffects(self.parameters, self._ego)
        self.pose_errors = PoseErrors(self.parameters)
        # A random offset, so that a method which forgets a translation fails on this log too.
        rng = make_generator(self.parameters.seed, "origin")
        self.offset_m = np.add(rng.uniform([-40, -40, -10], [40, 40, 10]), [self.parameters.origin_m, 0.0, 0.0])
        # Logs of different seeds do not share a time, as recorded logs do not.
        self._start_s = _EPOCH_S + 60.0 * (self.parameters.seed % 100_000)
        frame_bytes = self.parameters.cameras * self.parameters.width * self.parameters.height * _PIXEL_BYTES
        self._png_images: RecentValues[bytes] = RecentValues(max(_LEAST_CACHE_BYTES, _CACHED_FRAMES * frame_bytes), len)
        self._truth = StreetTruth(self.render, self.offset_m, self.name)
        self._build_lock = threading.Lock()

    @property
    def uri(self) -> str:
        """What the user wrote."""
        return self._uri

    @property
    def dataset(self) -> str:
        """The first folder of the store's layout."""
        return "synthetic"

    @property
    def name(self) -> str:
        """``street-seed=…`` and the parameters that are not the defaults."""
        return "street-" + self.parameters.query(separator="-")

    @property
    def frame_count(self) -> int:
        """How many frames the log has."""
        return self.parameters.frames

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The first cameras of PandaSet's rig, as many as were asked for."""
        return self._cameras

    @property
    def truth(self) -> StreetTruth:
        """The true image at any viewpoint."""
        return self._truth

    def frame_timestamp_s(self, frame: int) -> float:
        """See ``DrivingLog``."""
        self._check_frame(frame)
        return self._start_s + frame * FRAME_S

    def camera_timestamp_s(self, camera: str, frame: int) -> float:
        """See ``DrivingLog``; all cameras fire together, and a rolling shutter reads its middle row then.

        Returns:
            The frame's own time, seconds.
        """
        self._find_lens(camera)
        return self.frame_timestamp_s(frame)

    def world_SE3_lidar(self, frame: int) -> Float64:
        """See ``DrivingLog``; on the ground below the roof, as in PandaSet.

        Returns:
            [4, 4]; axes x forward, y left, z up.
        """
        self._check_frame(frame)
        world_SE3_ego = self._ego.pose(np.array([frame * FRAME_S]))[0]
        world_SE3_ego[:3, 3] += self.offset_m
        return world_SE3_ego

    def world_SE3_camera(self, camera: str, frame: int) -> Float64:
        """See ``DrivingLog``; with the errors that the parameters ask for.

        Returns:
            [4, 4]; axes x right, y down, z forward.
        """
        self._find_lens(camera)
        if self.pose_errors.is_exact:
            return self.world_SE3_lidar(frame) @ ego_SE3_camera(camera)
        world_SE3_rig = self.world_SE3_lidar(frame) @ self.pose_errors.ego_SE3_recorded_ego(frame * FRAME_S)
        pose: Float64 = world_SE3_rig @ ego_SE3_camera(camera) @ self.pose_errors.camera_SE3_recorded_camera(camera)
        return pose

    def true_world_SE3_camera(self, camera: str, frame: int) -> Float64:
        """Poses a camera where it is when it takes an image; other logs do not know it.

        Args:
            camera: name of the camera.
            frame: log frame.

        Returns:
            [4, 4]; axes x right, y down, z forward.
        """
        self._find_lens(camera)
        self._check_frame(frame)
        pose = self.camera_effects.street_SE3_camera(camera, frame * FRAME_S + self.parameters.camera_delay_s)
        pose[:3, 3] += self.offset_m
        return pose

    def image_bytes(self, camera: str, frame: int) -> bytes:
        """See ``DrivingLog``.

        Returns:
            A PNG; its pixels are ``truth.image`` at the recorded pose, unless a parameter says how the camera errs.
        """
        lens = self._find_lens(camera)
        self._check_frame(frame)

        def encode() -> bytes:
            if self.camera_effects.is_ideal and self.pose_errors.is_exact:
                return _encode_png(self._truth.image(frame, self.world_SE3_camera(camera, frame), lens))
            taken_s = frame * FRAME_S + self.parameters.camera_delay_s
            return _encode_png(self.camera_effects.record_image(self._renderer, camera, taken_s, lens))

        return self._png_images.get((camera, frame), encode)

    def sweep(self, frame: int) -> Sweep | None:
        """See ``DrivingLog``.

        Returns:
            The sweep, or ``None`` with ``lidar=0``.
        """
        self._check_frame(frame)
        if not self.parameters.lidar:
            return None
        return scan_sweep(
            self._caster,
            self._ego,
            self.parameters,
            frame,
            offset_m=self.offset_m,
            start_s=self._start_s,
        )

    def tracks(self) -> tuple[CuboidTrack, ...]:
        """See ``DrivingLog``.

        Returns:
            Cars and people that come within 80 m; none with ``cuboids=0``.
        """
        if not self.parameters.cuboids:
            return ()
        return annotate_actors(self._layout, self._ego, self.parameters.frames, self.offset_m)

    def digest(self) -> str:
        """Identifies the log by its parameters and the generator's own code; nothing is rendered.

        Returns:
            sha256, hexadecimal.
        """
        state = hashlib.sha256(self.parameters.query(all_keys=True).encode())
        # A change of the generator is another log: what was computed from the old one no longer fits.
        for name, digest in digest_modules(__name__, Path(__file__).resolve().parents[3]):
            state.update(f"\0{name}\0{digest}".encode())
        return state.hexdigest()

    def depth(self, frame: int, world_SE3_camera: Float64, lens: Lens) -> Float64:
        """Casts one ray through the centre of every pixel.

        Args:
            frame: log frame.
            world_SE3_camera: [4, 4] pose of the camera.
            lens: of the camera.

        Returns:
            [H, W] true depth along the camera's z axis, metres; inf is sky.
        """
        self._check_frame(frame)
        rays = camera_rays(lens, 1)
        origin = world_SE3_camera[:3, 3] - self.offset_m
        hits = self._caster.cast(origin, rotate(world_SE3_camera[:3, :3], rays), frame * FRAME_S)
        return (hits.distance_m.astype(np.float64) * rays[:, 2]).reshape(lens.height_px, lens.width_px)

    def render(self, frame: int, street_SE3_camera: Float64, lens: Lens) -> NDArray[np.uint8]:
        """Renders an image without remembering it.

        Args:
            frame: log frame.
            street_SE3_camera: [4, 4] pose of the camera in the street's own coordinates.
            lens: of the camera.

        Returns:
            [H, W, 3] sRGB.
        """
        self._check_frame(frame)
        return self._renderer.render_srgb(frame * FRAME_S, street_SE3_camera, lens)

    def _check_frame(self, frame: int) -> None:
        count = self.parameters.frames
        if not 0 <= frame < count:
            remedy = f"Ask for frames 0 to {count - 1}, or open it with more frames."
            raise InputError(f"the log has {count} frames", remedy=remedy, log=self.name, frame=frame)

    @cached_property
    def _built(self) -> tuple[StreetLayout, RayCaster]:
        layout = build_layout(self.parameters, self._road, self._ego)
        return layout, RayCaster(layout)

    @property
    def _layout(self) -> StreetLayout:
        # Two threads that ask at once would build the street twice.
        with self._build_lock:
            return self._built[0]

    @property
    def _caster(self) -> RayCaster:
        with self._build_lock:
            return self._built[1]

    @property
    def _renderer(self) -> Renderer:
        # Cheap enough to draw for every image.
        light = draw_light(self.parameters.seed, self.parameters.gloss)
        return Renderer(self._caster, light, self.parameters.samples)

    def _find_lens(self, camera: str) -> Lens:
        for known in self._cameras:
            if known.name == camera:
                return known.lens
        names = ", ".join(known.name for known in self._cameras)
        raise InputError(f"the log has no camera {camera!r}", remedy=f"It has {names}.", log=self.name, camera=camera)


def _encode_png(image: NDArray[np.uint8]) -> bytes:
    from PIL import Image

    buffer = io.BytesIO()
    # Lossless, so that a pixel can be compared with the truth.
    Image.fromarray(image).save(buffer, format="PNG", compress_level=6)
    return buffer.getvalue()
