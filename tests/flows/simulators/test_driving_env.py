"""The driving environment: gymnasium's own checks, the recorded drive, collisions, the range, seeds and mistakes."""

from __future__ import annotations

import re
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from flows.simulation import stored_ranges
from flows.simulation.stored_ranges import SideRange
from flows.simulators import driving_world
from flows.simulators.driving_env import ENVIRONMENT_ID, GenreDrivingEnv, RewardWeights, StartRange
from flows.simulators.scene_renderer import SceneRenderer
from genre_tasks.ego_paths.bicycle import BicycleModel
from genre_tasks.ego_paths.world_actors import WorldActor
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.logs import vehicle_center
from genre_tasks.rollout.chunk_layout import ChunkLayout

STRAIGHT_ON = np.zeros(2, np.float32)


@pytest.fixture(scope="module")
def env(served: tuple[str, str]) -> GenreDrivingEnv:
    return GenreDrivingEnv(*served, reliable_m=3.0, render_mode="rgb_array", start=StartRange(0, 4, 0.5))


@pytest.fixture
def free_road(env: GenreDrivingEnv, monkeypatch: pytest.MonkeyPatch) -> GenreDrivingEnv:
    """Without other road users."""
    monkeypatch.setattr(env._world, "_actors", ())
    return env


def drive_on(env: GenreDrivingEnv, action: Any) -> tuple[list[float], bool, bool, dict[str, Any]]:
    rewards = []
    while True:
        _, reward, terminated, truncated, info = env.step(action)
        rewards.append(reward)
        if terminated or truncated:
            return rewards, terminated, truncated, info


def test_gymnasium_finds_nothing_wrong(served: tuple[str, str]) -> None:
    store, run = served
    env = gymnasium.make(ENVIRONMENT_ID, store=store, run=run, reliable_m=3.0, start=StartRange(0, 4, 0.5))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Actions are in m/s² and rad/s, as simulators have them; gymnasium has a wrapper that scales them.
        warnings.filterwarnings("ignore", message=".*symmetric and normalized.*")
        check_env(env.unwrapped)


def test_gymnasium_makes_it_by_its_name(served: tuple[str, str]) -> None:
    name = "flows.simulators.driving_env:genre/Driving-v0"
    store, run = served
    made = gymnasium.make(name, store=store, run=run, reliable_m=2.0, cameras=["front_left_camera"], width_px=32)
    observation, _ = made.reset(seed=1)
    assert {camera: image.shape for camera, image in observation["rgb"].items()} == {"front_left_camera": (18, 32, 3)}
    made.close()


def test_the_start_is_the_recorded_one(free_road: GenreDrivingEnv) -> None:
    observation, info = free_road.reset(options={"index": 2, "lateral_m": 0.0})
    times_s, poses = free_road._renderer.ego_trajectory()
    assert info["time_s"] == pytest.approx(times_s[2], abs=1e-6) and info["frame"] == 2
    assert np.allclose(info["world_SE3_ego"], poses[2], atol=0.05)
    speed = np.linalg.norm(poses[4][:2, 3] - poses[0][:2, 3]) / (times_s[4] - times_s[0])
    assert observation["ego"][3] == pytest.approx(speed, abs=0.3)
    assert free_road.observation_space.contains(observation)
    picture = free_road.render()
    assert picture is not None and picture.shape == (36, 128, 3)
    assert np.array_equal(picture[:, :64], observation["rgb"]["front_camera"])


def test_the_first_pose_has_the_recorded_acceleration(
    free_road: GenreDrivingEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = free_road._world
    # A vehicle that brakes by 2 m/s² from the first moment on, and knows no earlier one.
    monkeypatch.setattr(world._reference, "measure_speed", lambda moments: 9.0 - 2.0 * np.maximum(moments, 0.0))
    model = BicycleModel(world.config.bounds)
    assert [world.start(k, 0.0, model).acceleration_m_s2 for k in (0, 2)] == pytest.approx([-2.0, -2.0])


def test_a_drive_ends_with_the_log(free_road: GenreDrivingEnv) -> None:
    free_road.reset(options={"index": 0, "lateral_m": 0.0})
    rewards, terminated, truncated, info = drive_on(free_road, STRAIGHT_ON)
    assert len(rewards) == 11 and terminated and not truncated and info["frame"] == 11
    # On the recorded path the reward is the progress.
    assert sum(rewards) == pytest.approx(info["arc_m"], abs=0.1)
    with pytest.raises(InputError, match="no episode"):
        free_road.step(STRAIGHT_ON)


def test_who_leaves_the_range_is_stopped(free_road: GenreDrivingEnv) -> None:
    free_road.reset(options={"index": 0, "lateral_m": 2.9})
    _, terminated, truncated, info = drive_on(free_road, np.array([0.0, 0.8], np.float32))
    assert truncated and not terminated and info["lateral_m"] > 3.0 and not info["reliable"]
    # Progress of less than a metre, less three metres for a tenth of a second.
    free_road.reset(options={"index": 0, "lateral_m": 2.9})
    _, reward, _, _, after = free_road.step(STRAIGHT_ON)
    assert reward == pytest.approx(after["progress_m"] - 0.1 * abs(after["lateral_m"]), abs=1e-3)


@pytest.mark.parametrize("lateral", [0.0, 4.0])
def test_the_lateral_distance_counts_by_its_weight(served: tuple[str, str], lateral: float) -> None:
    weighted = GenreDrivingEnv(*served, reliable_m=3.0, weights=RewardWeights(lateral=lateral))
    weighted.reset(options={"index": 0, "lateral_m": 1.5})
    _, reward, _, _, after = weighted.step(STRAIGHT_ON)
    assert abs(after["lateral_m"]) > 1.0
    assert reward == pytest.approx(after["progress_m"] - 0.1 * lateral * abs(after["lateral_m"]), abs=1e-3)


def test_a_collision_ends_the_drive(served: tuple[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    env = GenreDrivingEnv(*served, reliable_m=3.0, weights=RewardWeights(collision=7.0))
    _, info = env.reset(options={"index": 0})
    ahead = info["world_SE3_ego"].copy()
    ahead[:3, 3] += 8.0 * ahead[:3, 0]
    wall = WorldActor("wall", "car", (2.0, 4.0, 2.0), np.arange(12), np.tile(ahead, (12, 1, 1)))
    monkeypatch.setattr(env._world, "_actors", (wall,))
    rewards, terminated, truncated, info = drive_on(env, np.array([4.0, 0.0], np.float32))
    assert terminated and not truncated and info["collision"] == "wall" and info["frame"] < 11
    assert rewards[-1] < -6.0 < rewards[-2]


def test_a_bonnet_ahead_of_the_pose_collides_earlier(
    free_road: GenreDrivingEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Logs with poses at the rear axle say how far ahead the middle of the car is."""
    world = free_road._world
    _, info = free_road.reset(options={"index": 0, "lateral_m": 0.0})
    ahead = info["world_SE3_ego"].copy()
    ahead[:3, 3] += 4.5 * ahead[:3, 0]
    wall = WorldActor("wall", "car", (2.0, 4.0, 2.0), np.arange(12), np.tile(ahead, (12, 1, 1)))
    monkeypatch.setattr(world, "_actors", (wall,))
    assert world.find_collision(info["world_SE3_ego"], 0.0) is None
    monkeypatch.setattr(world, "_center_ahead_m", 1.3)
    assert world.find_collision(info["world_SE3_ego"], 0.0) is not None


def test_the_middle_of_the_car_is_the_logs(served: tuple[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(vehicle_center._CENTER_AHEAD_M, "synthetic", 1.3)
    assert GenreDrivingEnv(*served, reliable_m=3.0)._world._center_ahead_m == 1.3


@pytest.mark.parametrize(("frame_s", "fps"), [(0.5, 2), (3.0, 1)])
def test_films_are_as_fast_as_the_log(
    served: tuple[str, str], monkeypatch: pytest.MonkeyPatch, frame_s: float, fps: int
) -> None:
    monkeypatch.setattr(SceneRenderer, "frame_s", property(lambda self: frame_s))
    env = GenreDrivingEnv(*served, reliable_m=3.0)
    assert env.metadata["render_fps"] == fps
    assert GenreDrivingEnv.metadata["render_fps"] == 10


def test_seeds_choose_the_start(env: GenreDrivingEnv) -> None:
    starts = [env.reset(seed=seed)[1] for seed in (3, 3, 4, 5, 6)]
    places = [(info["frame"], info["lateral_m"]) for info in starts]
    assert places[0] == places[1] and len(set(places)) == 4
    assert all(frame <= 4 and abs(lateral_m) <= 0.51 for frame, lateral_m in places)


def test_the_range_is_that_of_simulations(served: tuple[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def find(scenes: Any, progress: Any) -> dict[int, SideRange]:
        asked.append(scenes.chunk_numbers)
        return {0: SideRange(left_m=1.0, right_m=2.0), 1: SideRange(left_m=0.5, right_m=2.0)}

    assert driving_world.find_side_ranges is stored_ranges.find_side_ranges
    monkeypatch.setattr(driving_world, "find_side_ranges", find)
    env = GenreDrivingEnv(*served)
    assert asked == [[0, 1]]
    assert [env.reset(options={"index": 1, "lateral_m": side})[1]["reliable"] for side in (0.8, -1.8, -2.2)] == [
        *(True, True, False)
    ]
    assert not env.reset(options={"index": 9, "lateral_m": 0.8})[1]["reliable"]


def test_the_guides_example_runs(served: tuple[str, str]) -> None:
    guide = (Path(__file__).resolve().parents[3] / "docs/guides/simulators.md").read_text()
    (example,) = re.findall(r"```python\n(.*?)```", guide, flags=re.DOTALL)
    store, run = served
    names: dict[str, Any] = {}
    exec(example.replace("genre-store", store).replace('"RUN"', f'"{run}"'), names)
    assert names["image"].shape == (36, 64, 3) and names["info"]["frame"] == 1


def test_mistakes_are_named(env: GenreDrivingEnv, served: tuple[str, str]) -> None:
    env.reset(seed=0)
    for action in (np.array([np.nan, 0.0]), np.zeros(3)):
        with pytest.raises(InputError, match="two finite numbers"):
            env.step(action)
    with pytest.raises(InputError, match=r"pose 11.*0 to 10"):
        env.reset(options={"index": 11})
    with pytest.raises(InputError, match="nan m beside"):
        env.reset(options={"lateral_m": float("nan")})
    for start in (StartRange(5, 2), StartRange(0, 0, -1.0)):
        with pytest.raises(ConfigError, match="no place lies in"):
            GenreDrivingEnv(*served, start=start, reliable_m=1.0)
    for reliable_m in (-1.0, float("nan"), float("inf"), "far"):
        with pytest.raises(ConfigError, match=r"reliable_m.*at least 0"):
            GenreDrivingEnv(*served, reliable_m=reliable_m)
    for width_px in (0, -64, 32.5):
        with pytest.raises(ConfigError, match=r"width_px.*at least 1"):
            GenreDrivingEnv(*served, reliable_m=1.0, width_px=width_px)
    with pytest.raises(ConfigError, match="human"):
        GenreDrivingEnv(*served, render_mode="human")
    with pytest.raises(InputError, match="Did you mean 'front_camera'"):
        GenreDrivingEnv(*served, cameras=["front_camra"], reliable_m=1.0)


def test_the_range_is_that_of_the_lane_that_is_driven_in(env: GenreDrivingEnv, monkeypatch: pytest.MonkeyPatch) -> None:
    world = env._world
    out = world.recorded.world_SE3_ego
    # As if the run went on with a way back, 3 m to the left, in a second chunk without any range.
    positions = np.concatenate([out[:, :2, 3], (out[:, :2, 3] + 3.0 * out[:, :2, 1])[::-1]])
    facings = np.concatenate([out[:, :2, 0], -out[::-1, :2, 0]])
    count = len(out)
    frames = np.arange(2.0 * count)
    layout = ChunkLayout((0, 1), (0, count), (count - 1, 2 * count - 1), frames, positions, facings)
    monkeypatch.setattr(world, "_layout", layout)
    monkeypatch.setattr(world, "_ranges", {0: SideRange(9.0, 9.0), 1: SideRange(0.0, 0.0)})
    state = world.start(4, 2.5, BicycleModel(world.config.bounds))
    assert world.locate(state, 4.0, world.find_arc(4)).reliable
    turned = replace(state, heading_rad=state.heading_rad + np.pi)
    assert not world.locate(turned, 4.0, world.find_arc(4)).reliable
