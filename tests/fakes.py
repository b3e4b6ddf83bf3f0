"""A small in-memory driving log for tests: a ray-cast box world with a moving car, PNG images and LiDAR sweeps.

The world: ground z = 0, walls at y = ±8 m, a cross wall at x = 45 m, sky above, cars as boxes. The ego drives along +x
with its sensors 1.8 m above the ground; the LiDAR frame is x forward, y left, z up.
"""

from __future__ import annotations

import hashlib
import io
from dataclasses import dataclass, field, replace

import numpy as np
from PIL import Image

from genre_tasks.errors import InputError
from genre_tasks.logs.types import Camera, CuboidTrack, Float64, Lens, Sweep, Truth

SENSOR_HEIGHT_M = 1.8
WALL_Y_M = 8.0
WALL_HEIGHT_M = 5.0
END_X_M = 45.0


def yaw_pose(yaw_rad: float, position: tuple[float, float, float]) -> Float64:
    """[4, 4] turned about z."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    pose = np.eye(4)
    pose[:2, :2], pose[:3, 3] = [[c, -s], [s, c]], position
    return pose


def camera_turn(yaw_rad: float) -> Float64:
    """Rotation of a camera (x right, y down, z forward) looking along the ego's x, turned left by ``yaw_rad``."""
    forward = np.array([np.cos(yaw_rad), np.sin(yaw_rad), 0.0])
    down = np.array([0.0, 0.0, -1.0])
    return np.stack([np.cross(down, forward), down, forward], 1)


@dataclass(frozen=True)
class FakeCar:
    """A box on the ground that drives along x at ``speed_mps``."""

    track_id: str
    x_m: float
    y_m: float
    speed_mps: float = 0.0
    size_m: tuple[float, float, float] = (4.0, 1.8, 1.5)
    yaw_rad: float = 0.0

    def pose(self, time_s: float) -> Float64:
        """[4, 4], box to the fake world."""
        return yaw_pose(self.yaw_rad, (self.x_m + self.speed_mps * time_s, self.y_m, self.size_m[2] / 2))


DEFAULT_CARS = (FakeCar("mover", 6.0, 3.5, speed_mps=6.0), FakeCar("parked", 14.0, -4.0))


@dataclass(frozen=True)
class FakeLog:
    """See the module; every fault of a test is a field."""

    frame_count: int = 20
    camera_names: tuple[str, ...] = ("front", "left")
    width_px: int = 96
    height_px: int = 64
    speed_mps: float = 3.0
    cars: tuple[FakeCar, ...] = DEFAULT_CARS
    world_offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    lidar_rings: int = 32
    lidar_azimuths: int = 480
    missing_images: frozenset[tuple[str, int]] = frozenset()
    corrupt_images: frozenset[tuple[str, int]] = frozenset()
    missing_sweeps: frozenset[int] = frozenset()
    unreadable_sweeps: frozenset[int] = frozenset()
    no_lidar: bool = False
    timestamps_s: tuple[float, ...] | None = None
    extra_tracks: tuple[CuboidTrack, ...] = ()
    without_tracks: bool = False
    track_every: int = 1
    ego_yaw_rad: float = 0.0
    uri: str = "fake:street"
    dataset: str = "fake"
    name: str = "street"
    truth: Truth | None = None
    _images: dict[tuple[str, int], bytes] = field(default_factory=dict, compare=False, repr=False)

    @property
    def lens(self) -> Lens:
        return Lens(
            self.width_px * 0.6,
            self.width_px * 0.6,
            self.width_px / 2,
            self.height_px / 2,
            self.width_px,
            self.height_px,
        )

    @property
    def cameras(self) -> tuple[Camera, ...]:
        return tuple(Camera(n, self.lens) for n in self.camera_names)

    def with_(self, **changes: object) -> FakeLog:
        """A copy with other fields (and no images kept)."""
        return replace(self, _images={}, **changes)  # type: ignore[arg-type]

    def _offset(self, pose: Float64) -> Float64:
        out = pose.copy()
        out[:3, 3] += np.asarray(self.world_offset_m)
        return out

    def _fake_SE3_lidar(self, frame: int) -> Float64:
        return yaw_pose(self.ego_yaw_rad, (self.speed_mps * frame * 0.1, 0.0, SENSOR_HEIGHT_M))

    def _fake_SE3_camera(self, camera: str, frame: int) -> Float64:
        yaw = {"front": 0.0, "left": np.pi / 2, "right": -np.pi / 2, "back": np.pi}[camera]
        ego_SE3_camera = np.eye(4)
        ego_SE3_camera[:3, :3], ego_SE3_camera[:3, 3] = camera_turn(yaw), (0.3, 0.0, -0.2)
        return self._fake_SE3_lidar(frame) @ ego_SE3_camera

    def frame_timestamp_s(self, frame: int) -> float:
        return 0.1 * frame if self.timestamps_s is None else self.timestamps_s[frame]

    def world_SE3_lidar(self, frame: int) -> Float64:
        return self._offset(self._fake_SE3_lidar(frame))

    def world_SE3_camera(self, camera: str, frame: int) -> Float64:
        return self._offset(self._fake_SE3_camera(camera, frame))

    def camera_timestamp_s(self, camera: str, frame: int) -> float:
        return self.frame_timestamp_s(frame)

    def image_bytes(self, camera: str, frame: int) -> bytes | None:
        key = (camera, frame)
        if key in self.missing_images:
            return None
        if key not in self._images:
            colors = self.render(self._fake_SE3_camera(camera, frame), self.lens, frame)
            stream = io.BytesIO()
            Image.fromarray(colors).save(stream, "PNG", compress_level=1)
            self._images[key] = stream.getvalue()
        data = self._images[key]
        return data[: len(data) // 2] if key in self.corrupt_images else data

    def render(self, fake_SE3_camera: Float64, lens: Lens, frame: int) -> np.ndarray:
        """[H, W, 3] uint8: the true image at a pose of the fake world (without ``world_offset_m``)."""
        u, v = np.meshgrid(np.arange(lens.width_px) + 0.5, np.arange(lens.height_px) + 0.5)
        rays = np.stack([(u - lens.cx_px) / lens.fx_px, (v - lens.cy_px) / lens.fy_px, np.ones_like(u)], -1)
        directions = rays.reshape(-1, 3) @ fake_SE3_camera[:3, :3].T
        _, colors = cast(fake_SE3_camera[:3, 3], directions, self.cars, 0.1 * frame)
        return colors.reshape(lens.height_px, lens.width_px, 3)

    def sweep(self, frame: int) -> Sweep | None:
        if self.no_lidar or frame in self.missing_sweeps:
            return None
        if frame in self.unreadable_sweeps:
            raise InputError("cannot read the sweep", remedy="Fetch the file again.", frame=frame, file=f"{frame}.bin")
        elevation = np.deg2rad(np.linspace(-25.0, 12.0, self.lidar_rings))[:, None]
        azimuth = (np.arange(self.lidar_azimuths) * 2 * np.pi / self.lidar_azimuths)[None]
        directions = np.stack(
            np.broadcast_arrays(
                np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
            ),
            -1,
        ).reshape(-1, 3)
        origin = self._fake_SE3_lidar(frame)[:3, 3]
        distance, _ = cast(origin, directions, self.cars, 0.1 * frame)
        hit = distance < 80.0
        points = origin + directions[hit] * distance[hit, None]
        count = len(points)
        return Sweep(
            points + np.asarray(self.world_offset_m),
            np.full(count, 0.5, np.float32),
            np.full(count, self.frame_timestamp_s(frame)),
        )

    def tracks(self) -> tuple[CuboidTrack, ...]:
        if self.without_tracks:
            return ()
        frames = np.arange(0, self.frame_count, self.track_every, dtype=np.int64)
        made = tuple(
            CuboidTrack(
                c.track_id,
                "car",
                frames,
                np.stack([self._offset(c.pose(0.1 * f)) for f in frames]),
                c.size_m,
                abs(c.speed_mps) > 0,
            )
            for c in self.cars
        )
        return made + self.extra_tracks

    def digest(self) -> str:
        return hashlib.sha256(repr(self).encode()).hexdigest()


def cast(origin: Float64, directions: Float64, cars: tuple[FakeCar, ...], time_s: float) -> tuple[Float64, np.ndarray]:
    """First hits of rays: distance [R] in units of the direction (inf for the sky) and colour [R, 3] uint8."""
    with np.errstate(divide="ignore", invalid="ignore"):
        best = np.full(len(directions), np.inf)
        shade = np.stack([0.45 + 0.0 * best.clip(0, 1), np.full(len(best), 0.65), np.full(len(best), 0.9)], -1)
        surfaces = [
            (2, 0.0, (0.35, 0.35, 0.38)),
            (1, WALL_Y_M, (0.7, 0.45, 0.3)),
            (1, -WALL_Y_M, (0.4, 0.6, 0.4)),
            (0, END_X_M, (0.6, 0.6, 0.3)),
            (0, -END_X_M, (0.5, 0.3, 0.5)),
        ]
        for axis, at, color in surfaces:
            t = (at - origin[axis]) / directions[:, axis]
            hit = origin + t[:, None] * directions
            ok = (t > 1e-6) & (t < best)
            if axis != 2:
                ok &= (hit[:, 2] >= 0) & (hit[:, 2] <= WALL_HEIGHT_M)
            a, b = [hit[:, k] for k in range(3) if k != axis]
            wave = 0.15 * np.sin(1.9 * a) * np.cos(2.3 * b) + 0.08 * np.sin(0.6 * a + b)
            best[ok] = t[ok]
            shade[ok] = (np.asarray(color) + wave[:, None])[ok]
        for index, car in enumerate(cars):
            pose = car.pose(time_s)
            o, d = (origin - pose[:3, 3]) @ pose[:3, :3], directions @ pose[:3, :3]
            half = np.asarray(car.size_m) / 2
            one, two = (-half - o) / d, (half - o) / d
            near, far = np.minimum(one, two).max(1), np.maximum(one, two).min(1)
            ok = (near < far) & (near > 1e-6) & (near < best)
            local = o + near[:, None] * d
            base = np.array([0.85, 0.15, 0.15]) if index % 2 == 0 else np.array([0.15, 0.2, 0.85])
            best[ok] = near[ok]
            shade[ok] = (base + 0.1 * np.sin(3 * local[:, :1]) * np.cos(4 * local[:, 2:]))[ok]
    return best, np.round(shade.clip(0, 1) * 255).astype(np.uint8)
