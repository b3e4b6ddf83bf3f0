"""The synthetic street as a driving log, with its truth at any viewpoint."""

from __future__ import annotations

import hashlib
import io
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Generic, TypeVar
from urllib.parse import parse_qsl

import numpy as np
from numpy.typing import NDArray

from genre_tasks.errors import ConfigError, InputError
from genre_tasks.logs.synthetic.annotations import annotate
from genre_tasks.logs.synthetic.camera_images import camera_rays, draw_light, picture
from genre_tasks.logs.synthetic.ego_vehicle import FRAME_S, draw_ego, ego_SE3_camera, rig
from genre_tasks.logs.synthetic.imaging import Imaging
from genre_tasks.logs.synthetic.layout import Layout, lay_out
from genre_tasks.logs.synthetic.lidar import sweep
from genre_tasks.logs.synthetic.noise import rotated
from genre_tasks.logs.synthetic.parameters import parse_parameters
from genre_tasks.logs.synthetic.raycast import Scene
from genre_tasks.logs.synthetic.road import Road, generator
from genre_tasks.logs.types import Camera, CuboidTrack, Float64, Lens, Sweep

_EPOCH_S = 1.7e9
_IMAGE_CACHE_BYTES = 128 << 20
_PNG_CACHE_BYTES = 32 << 20

Value = TypeVar("Value")


class _Memo(Generic[Value]):
    """The values used last, up to a number of bytes; safe among threads."""

    def __init__(self, limit_bytes: int, size: Callable[[Value], int]) -> None:
        self._limit, self._size, self._held = limit_bytes, size, 0
        self._values: OrderedDict[Hashable, Value] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: Hashable, make: Callable[[], Value]) -> Value:
        with self._lock:
            if key in self._values:
                self._values.move_to_end(key)
                return self._values[key]
        value = make()
        with self._lock:
            if key not in self._values:
                self._values[key] = value
                self._held += self._size(value)
            while self._held > self._limit and len(self._values) > 1:
                self._held -= self._size(self._values.popitem(last=False)[1])
        return value


class StreetTruth:
    """``Truth`` of a street: the log's own ray-caster at any pose, remembered while it is likely to be asked again."""

    def __init__(self, street: SyntheticStreet) -> None:
        self._street = street
        self._memo: _Memo[NDArray[np.uint8]] = _Memo(_IMAGE_CACHE_BYTES, lambda image: image.nbytes)

    def image(
        self,
        frame: int,
        world_SE3_camera: Float64,  # [4, 4]
        lens: Lens,
    ) -> NDArray[np.uint8]:  # [H, W, 3] sRGB, H × W of the lens
        """What a camera at that pose would have seen at that frame's time. The array is the caller's own."""
        street = self._street
        street.check_frame(frame)
        pose = np.array(world_SE3_camera, np.float64)
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            raise InputError(
                f"expected a finite pose of shape (4, 4), got shape {pose.shape}",
                remedy="Check where the viewpoint comes from.",
                log=street.name,
                frame=frame,
            )
        pose[:3, 3] -= street.offset_m
        key = (frame, pose.tobytes(), lens)
        return self._memo.get(key, lambda: street.render(frame, pose, lens)).copy()


class SyntheticStreet:
    """A procedural street, drawn from a seed; implements ``DrivingLog``.

    ``uri_query``: the parameters of ``StreetParameters`` as text. Raises ``ConfigError`` on unknown or bad ones.
    Opening is cheap: geometry is built when the first image, sweep or track is asked for.
    """

    def __init__(self, uri_query: Mapping[str, str]) -> None:
        self.parameters = parse_parameters(uri_query)
        self._uri = "synthetic:street?" + "&".join(f"{k}={v}" for k, v in uri_query.items())
        self._cameras = rig(self.parameters)
        self._road = Road(self.parameters.seed)
        self._ego = draw_ego(self.parameters, self._road)
        self.imaging = Imaging(self.parameters, self._ego)
        rng = generator(self.parameters.seed, "origin")
        self.offset_m = np.add(rng.uniform([-40, -40, -10], [40, 40, 10]), [self.parameters.origin_m, 0.0, 0.0])
        self._start_s = _EPOCH_S + 60.0 * (self.parameters.seed % 100_000)
        self._png: _Memo[bytes] = _Memo(_PNG_CACHE_BYTES, len)
        self._truth = StreetTruth(self)
        self._build = threading.Lock()

    @property
    def uri(self) -> str:
        return self._uri

    @property
    def dataset(self) -> str:
        return "synthetic"

    @property
    def name(self) -> str:
        return "street-" + self.parameters.query(separator="-")

    @property
    def frame_count(self) -> int:
        return self.parameters.frames

    @property
    def cameras(self) -> tuple[Camera, ...]:
        return self._cameras

    @property
    def truth(self) -> StreetTruth:
        return self._truth

    def frame_timestamp_s(self, frame: int) -> float:
        self.check_frame(frame)
        return self._start_s + frame * FRAME_S

    def camera_timestamp_s(self, camera: str, frame: int) -> float:
        """The frame's own time: all cameras fire together; a rolling shutter reads its middle row then."""
        self._lens(camera)
        return self.frame_timestamp_s(frame)

    def world_SE3_lidar(self, frame: int) -> Float64:
        """[4, 4]; on the ground below the roof, as in PandaSet: x forward, y left, z up."""
        self.check_frame(frame)
        return self._in_world(self._ego.pose(np.array([frame * FRAME_S]))[0])

    def world_SE3_camera(self, camera: str, frame: int) -> Float64:
        self._lens(camera)
        return self.world_SE3_lidar(frame) @ ego_SE3_camera(camera)

    def image_bytes(self, camera: str, frame: int) -> bytes:
        """PNG; its pixels are ``truth.image`` at the recorded pose, unless a parameter says how the camera errs."""
        lens = self._lens(camera)
        self.check_frame(frame)

        def encode() -> bytes:
            if self.imaging.plain:
                return _png(self._truth.image(frame, self.world_SE3_camera(camera, frame), lens))
            light = draw_light(self.parameters.seed, self.parameters.gloss)
            return _png(self.imaging.image(self._scene, light, camera, frame * FRAME_S, lens))

        return self._png.get((camera, frame), encode)

    def sweep(self, frame: int) -> Sweep | None:
        self.check_frame(frame)
        if not self.parameters.lidar:
            return None
        return sweep(self._scene, self._ego, self.parameters, frame, self.offset_m, self._start_s)

    def tracks(self) -> tuple[CuboidTrack, ...]:
        if not self.parameters.cuboids:
            return ()
        return annotate(self._layout, self._ego, self.parameters.frames, self.offset_m)

    def digest(self) -> str:
        """sha256 over the parameters and the generator's own source: no rendering."""
        state = hashlib.sha256(self.parameters.query(all_keys=True).encode())
        for file in sorted(Path(__file__).parent.glob("*.py")):
            state.update(file.name.encode() + b"\0" + file.read_bytes())
        return state.hexdigest()

    def depth(self, frame: int, world_SE3_camera: Float64, lens: Lens) -> Float64:
        """[H, W] true depth along the camera's z axis at pixel centres, metres; inf is sky."""
        self.check_frame(frame)
        rays = camera_rays(lens, 1)
        origin = world_SE3_camera[:3, 3] - self.offset_m
        hits = self._scene.cast(origin, rotated(world_SE3_camera[:3, :3], rays), frame * FRAME_S)
        return (hits.distance_m.astype(np.float64) * rays[:, 2]).reshape(lens.height_px, lens.width_px)

    def render(self, frame: int, street_SE3_camera: Float64, lens: Lens) -> NDArray[np.uint8]:
        """[H, W, 3] at a pose in the street's own coordinates; not remembered."""
        light = draw_light(self.parameters.seed, self.parameters.gloss)
        return picture(self._scene, light, frame * FRAME_S, street_SE3_camera, lens, self.parameters.samples)

    def check_frame(self, frame: int) -> None:
        """Raises ``InputError`` for a frame that the log does not have."""
        if not 0 <= frame < self.parameters.frames:
            raise InputError(
                f"the log has {self.parameters.frames} frames",
                remedy=f"Ask for frames 0 to {self.parameters.frames - 1}, or open it with more frames.",
                log=self.name,
                frame=frame,
            )

    @cached_property
    def _built(self) -> tuple[Layout, Scene]:
        layout = lay_out(self.parameters, self._road, self._ego)
        return layout, Scene(layout)

    @property
    def _layout(self) -> Layout:
        with self._build:
            return self._built[0]

    @property
    def _scene(self) -> Scene:
        with self._build:
            return self._built[1]

    def _in_world(self, street_SE3_x: Float64) -> Float64:
        out = street_SE3_x.copy()
        out[:3, 3] += self.offset_m
        return out

    def _lens(self, camera: str) -> Lens:
        for known in self._cameras:
            if known.name == camera:
                return known.lens
        names = ", ".join(c.name for c in self._cameras)
        raise InputError(f"the log has no camera {camera!r}", remedy=f"It has {names}.", log=self.name, camera=camera)


def open_synthetic(rest: str) -> SyntheticStreet:
    """Opens ``street?seed=1000&frames=20``: what follows ``synthetic:`` in a URI. Raises ``ConfigError``."""
    kind, _, query = rest.partition("?")
    if kind != "street":
        raise ConfigError(f"there is no synthetic log {kind!r}", remedy="Write synthetic:street?seed=1000.")
    try:
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=bool(query))
    except ValueError as error:
        raise ConfigError(f"cannot read the parameters {query!r}", remedy="Write key=value&key=value.") from error
    keys = [key for key, _ in pairs]
    twice = next((key for key in keys if keys.count(key) > 1), None)
    if twice is not None:
        raise ConfigError(f"the parameter {twice!r} is given twice", remedy="Give each parameter once.")
    return SyntheticStreet(dict(pairs))


def _png(image: NDArray[np.uint8]) -> bytes:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="PNG", compress_level=6)
    return buffer.getvalue()
