"""A finished run as a gymnasium environment: a driver sees its cameras, steers and accelerates."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.simulators.driving_world import DrivingWorld
from flows.simulators.image_request import CameraDescription, ImageRequest, RenderLimits
from flows.simulators.scene_renderer import SceneRenderer
from genre_tasks.ego_paths.bicycle import MAX_STEER_RATE_RAD_S, BicycleModel
from genre_tasks.ego_paths.collisions import Collision
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.logs.types import Float32, Float64
from genre_tasks.progress import Progress, silent

try:
    import gymnasium
except ModuleNotFoundError as error:
    raise ConfigError(
        "the driving environment needs the package gymnasium", remedy="Install it: pip install 'genre[simulators]'."
    ) from error

ENVIRONMENT_ID = "genre/Driving-v0"

Observation = dict[str, Any]
_REACH_M = 1e4
_UNLIMITED_PX = 1 << 20


@dataclass(frozen=True)
class RewardWeights:
    """What a step is worth: metres of progress along the recorded path, less what is weighed here.

    Attributes:
        lateral: for each metre beside the recorded path and second spent there.
        collision: for running into a road user.
    """

    lateral: float = 1.0
    collision: float = 100.0


@dataclass(frozen=True)
class StartRange:
    """Where episodes start; the seed chooses within it.

    Attributes:
        first_index: earliest recorded pose to start from.
        last_index: latest one.
        lateral_m: largest distance to the side of the recorded path.
    """

    first_index: int = 0
    last_index: int = 0
    lateral_m: float = 0.0


DEFAULT_WEIGHTS = RewardWeights()
DEFAULT_START = StartRange()


class GenreDrivingEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """Drives through a finished run: a step is one log frame, and all others drive as recorded.

    An observation has ``rgb``, an image [H, W, 3] for each camera, and ``ego`` [6]: metres ahead and to the left of
    the first recorded pose, heading against it in rad, speed in m/s, acceleration in m/s², and steering angle in rad.
    An action is the acceleration in m/s² and the rate of the steering angle in rad/s; to the left is positive. The
    vehicle is a kinematic bicycle within the bounds of the run's section ``simulate``.

    An episode is terminated by a collision and at the end of the log. It is truncated where the vehicle leaves the
    range in which the scenes can be trusted. The reward of a step is the progress along the recorded path in metres,
    less lateral distance and collision as :class:`RewardWeights` weighs them.

    ``reset`` takes the options ``index``, the recorded pose to start from, and ``lateral_m``, metres to its left.

    Args:
        store: folder (or URI) of the store.
        run: the run's name, or the start of it.
        cameras: names; ``None``: all of the rig.
        width_px: of the images; ``None``: the run's working width.
        stage: initial, gnet or enet; ``None``: the last one of each chunk.
        reliable_m: how far to both sides of the recorded path one may drive; ``None``: as measured, which takes
            minutes the first time and is then read from the store.
        start: where episodes start.
        weights: of the reward.
        progress: called while that range is measured.
        render_mode: ``rgb_array``: :meth:`render` gives the images next to each other; ``None``.

    Raises:
        InputError: there is no such run, stage or camera.
        ConfigError: a value is out of range.
    """

    # Not a class variable for type checkers: the base class declares it so.
    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(
        self,
        store: str,
        run: str,
        *,
        cameras: Sequence[str] | None = None,
        width_px: int | None = None,
        stage: str | None = None,
        reliable_m: float | None = None,
        start: StartRange = DEFAULT_START,
        weights: RewardWeights = DEFAULT_WEIGHTS,
        progress: Progress = silent,
        render_mode: str | None = None,
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ConfigError(f"unknown render_mode '{render_mode}'", remedy="Take rgb_array, or None.")
        if start.first_index > start.last_index or start.lateral_m < 0:
            remedy = "Give first_index up to last_index, and lateral_m of at least 0."
            raise ConfigError(f"no place lies in {start}", remedy=remedy)
        _check_numbers(width_px, reliable_m)
        self.render_mode = render_mode
        # Limits are for clients of a network, and this process has none.
        self._renderer = SceneRenderer(store, run, stage, limits=RenderLimits(_UNLIMITED_PX, _UNLIMITED_PX))
        # Logs have frame rates of their own, and films of the environment are to be as fast as the drive.
        self.metadata = {**self.metadata, "render_fps": max(1, round(1 / self._renderer.frame_s))}
        self._world = DrivingWorld(store, run, stage, reliable_m, progress)
        self._model = BicycleModel(self._world.config.bounds)
        self._cameras = _resize(self._renderer.select_cameras(cameras), width_px)
        self._start = start
        self._weights = weights
        self._check_start(start.first_index, start.lateral_m)
        self._check_start(start.last_index, start.lateral_m)
        self._origin = self._world.start(0, 0.0, self._model)
        self.observation_space = self._make_observation_space()
        bounds = self._world.config.bounds
        self.action_space = gymnasium.spaces.Box(
            np.array([-bounds.max_deceleration_m_s2, -MAX_STEER_RATE_RAD_S], np.float32),
            np.array([bounds.max_acceleration_m_s2, MAX_STEER_RATE_RAD_S], np.float32),
        )
        self._index: int | None = None
        self._images: dict[str, NDArray[np.uint8]] = {}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts an episode at the recorded vehicle's speed.

        Args:
            seed: of where it starts, if it may start at several places.
            options: ``index`` and ``lateral_m``.

        Returns:
            Observation and info.

        Raises:
            InputError: the options name no place of the run.
        """
        super().reset(seed=seed)
        wanted = options or {}
        start = self._start
        drawn = int(self.np_random.integers(start.first_index, start.last_index + 1))
        side_m = float(self.np_random.uniform(-start.lateral_m, start.lateral_m)) if start.lateral_m else 0.0
        index = wanted.get("index", drawn)
        lateral_m = wanted.get("lateral_m", side_m)
        self._check_start(index, lateral_m)
        self._index = int(index)
        self._state = self._world.start(self._index, float(lateral_m), self._model)
        self._place = self._world.locate(self._state, self._frame, self._world.find_arc(self._index))
        self._pose = self._world.place_ego(self._state, self._place)
        return self._observe(), self._describe(None, 0.0)

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Drives on to the next log frame.

        Args:
            action: [2] acceleration in m/s² and steering rate in rad/s.

        Returns:
            Observation, reward, terminated, truncated and info.

        Raises:
            InputError: the action is not of two finite numbers, or the episode has ended.
        """
        values = np.asarray(action, np.float64)
        if values.shape != (2,) or not np.isfinite(values).all():
            raise InputError(
                f"an action of {np.array2string(values, threshold=6)}", remedy="Give two finite numbers: m/s², rad/s."
            )
        if self._index is None or self._index + 1 >= len(self._world.recorded):
            raise InputError("no episode is under way", remedy="Call reset first.")
        times = self._world.recorded.times_s
        seconds = float(times[self._index + 1] - times[self._index])
        self._state = self._model.advance(self._state, float(values[0]), float(values[1]), seconds)
        self._index += 1
        before_m = self._place.arc_m
        self._place = self._world.locate(self._state, self._frame, before_m)
        self._pose = self._world.place_ego(self._state, self._place)
        collision = self._world.find_collision(self._pose, self._frame)
        progress_m = self._place.arc_m - before_m
        reward = progress_m - self._weights.lateral * abs(self._place.lateral_m) * seconds
        reward -= self._weights.collision * (collision is not None)
        terminated = collision is not None or self._index + 1 == len(self._world.recorded)
        info = self._describe(collision, progress_m)
        observation = self._observe()
        if terminated or not self._place.reliable:
            self._index = None
        return observation, reward, terminated, not self._place.reliable, info

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]
        """Gives the latest images next to each other, [H, C · W, 3]; ``None`` without a render mode."""
        if self.render_mode is None or not self._images:
            return None
        return np.concatenate(list(self._images.values()), axis=1)

    @property
    def _frame(self) -> float:
        return float(self._world.recorded.frames[self._index or 0])

    def _make_observation_space(self) -> gymnasium.spaces.Dict:
        images: dict[str, gymnasium.Space[Any]] = {
            name: gymnasium.spaces.Box(0, 255, (camera.lens.height_px, camera.lens.width_px, 3), np.uint8)
            for name, camera in self._cameras.items()
        }
        bounds = self._world.config.bounds
        largest_steer = self._model.max_steer_rad
        low = [-_REACH_M, -_REACH_M, -math.pi, 0.0, -bounds.max_deceleration_m_s2, -largest_steer]
        high = [_REACH_M, _REACH_M, math.pi, bounds.max_speed_m_s, bounds.max_acceleration_m_s2, largest_steer]
        # Single precision rounds a bound that the state may reach.
        margin = np.array(1e-3, np.float32)
        ego = gymnasium.spaces.Box(np.array(low, np.float32) - margin, np.array(high, np.float32) + margin)
        return gymnasium.spaces.Dict({"rgb": gymnasium.spaces.Dict(images), "ego": ego})

    def _observe(self) -> Observation:
        time_s = self._renderer.find_time(self._frame)
        requests = []
        for name, camera in self._cameras.items():
            pose = self._pose @ camera.rig_SE3_camera
            requests.append(ImageRequest(camera.lens, pose, pose, time_s, time_s, camera=name))
        self._images = dict(zip(self._cameras, self._renderer.render_batch(requests), strict=True))
        return {"rgb": dict(self._images), "ego": self._measure_ego()}

    def _measure_ego(self) -> Float32:
        state = self._state
        cosine = math.cos(self._origin.heading_rad)
        sine = math.sin(self._origin.heading_rad)
        dx = state.x_m - self._origin.x_m
        dy = state.y_m - self._origin.y_m
        heading = math.remainder(state.heading_rad - self._origin.heading_rad, 2 * math.pi)
        ahead_left = (cosine * dx + sine * dy, cosine * dy - sine * dx)
        return np.array([*ahead_left, heading, state.speed_m_s, state.acceleration_m_s2, state.steer_rad], np.float32)

    def _describe(self, collision: Collision | None, progress_m: float) -> dict[str, Any]:
        """Info of a step: what a planner's judge asks for, in plain values."""
        pose: Float64 = self._pose.copy()
        return {
            "frame": self._frame,
            "time_s": self._renderer.find_time(self._frame),
            "world_SE3_ego": pose,
            "lateral_m": self._place.lateral_m,
            "progress_m": progress_m,
            "arc_m": self._place.arc_m,
            "reliable": self._place.reliable,
            "collision": None if collision is None else collision.actor_id,
        }

    def _check_start(self, index: object, lateral_m: object) -> None:
        # The last pose is the end of every episode.
        latest = len(self._world.recorded) - 2
        if not isinstance(index, int | np.integer) or not 0 <= index <= latest:
            raise InputError(f"an episode cannot start at pose {index!r}", remedy=f"Take 0 to {latest}.")
        if not isinstance(lateral_m, int | float) or not abs(lateral_m) <= _REACH_M:
            raise InputError(
                f"an episode cannot start {lateral_m!r} m beside the path", remedy="Give metres to the left."
            )


def _check_numbers(width_px: object, reliable_m: object) -> None:
    if width_px is not None and not (isinstance(width_px, int | np.integer) and width_px >= 1):
        raise ConfigError(f"images of width_px {width_px!r}", remedy="Give a whole number of at least 1, or None.")
    is_number = isinstance(reliable_m, int | float | np.number)
    if reliable_m is not None and not (is_number and 0 <= reliable_m < math.inf):  # type: ignore[operator]
        remedy = "Give metres of at least 0, or None for the range as measured."
        raise ConfigError(f"nobody can drive within a reliable_m of {reliable_m!r}", remedy=remedy)


def _resize(cameras: Mapping[str, CameraDescription], width_px: int | None) -> dict[str, CameraDescription]:
    if width_px is None:
        return dict(cameras)
    return {name: replace(camera, lens=camera.lens.resized_to_width(width_px)) for name, camera in cameras.items()}


gymnasium.register(ENVIRONMENT_ID, entry_point="flows.simulators.driving_env:GenreDrivingEnv")
