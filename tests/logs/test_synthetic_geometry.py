"""Cameras, LiDAR and cuboids of the synthetic street see one and the same world."""

import numpy as np
import pytest

from genre_tasks.logs.synthetic import SyntheticStreet, open_synthetic
from genre_tasks.logs.synthetic.camera_images import camera_rays
from genre_tasks.logs.types import CuboidTrack, Lens


@pytest.fixture(scope="module")
def street() -> SyntheticStreet:
    return open_synthetic("street?seed=1000&frames=12&cameras=6&pedestrians=8")


def seen_by(log: SyntheticStreet, camera: str, frame: int, points: np.ndarray) -> np.ndarray:
    """Points in camera coordinates."""
    camera_SE3_world = np.linalg.inv(log.world_SE3_camera(camera, frame))
    return points @ camera_SE3_world[:3, :3].T + camera_SE3_world[:3, 3]


def in_box(points: np.ndarray, world_SE3_box: np.ndarray) -> np.ndarray:
    return (points - world_SE3_box[:3, 3]) @ world_SE3_box[:3, :3]


def test_first_pixel_centre_is_a_half():
    lens = Lens(100, 110, 33, 17, 64, 36)
    rays = camera_rays(lens, 1).reshape(36, 64, 3)
    uv = rays[..., :2] / rays[..., 2:] * [100, 110] + [33, 17]
    np.testing.assert_allclose(uv[0, 0], [0.5, 0.5], atol=1e-12)
    np.testing.assert_allclose(uv[35, 63], [63.5, 35.5], atol=1e-12)
    four = camera_rays(lens, 4).reshape(36, 64, 4, 3)
    spread = four[..., :2] / four[..., 2:] * [100, 110] + [33, 17]
    np.testing.assert_allclose(spread.mean(2), uv, atol=1e-12)
    np.testing.assert_allclose(np.ptp(spread, axis=2), 0.5, atol=1e-9)


def test_rays_invert_the_lens_distortion():
    k1, k2, p1, p2, k3 = distortion = (-0.12, 0.03, 0.001, -0.002, 0.005)
    lens = Lens(300, 300, 160, 90, 320, 180, distortion)
    rays = camera_rays(lens, 1)
    x, y = (rays[:, :2] / rays[:, 2:]).T
    r = x * x + y * y
    radial = 1 + k1 * r + k2 * r**2 + k3 * r**3
    u = 300 * (x * radial + 2 * p1 * x * y + p2 * (r + 2 * x * x)) + 160
    v = 300 * (y * radial + p1 * (r + 2 * y * y) + 2 * p2 * x * y) + 90
    np.testing.assert_allclose(np.stack([u, v], 1).reshape(180, 320, 2)[40, 7], [7.5, 40.5], atol=1e-6)


@pytest.mark.parametrize("camera", ["front_camera", "left_camera", "back_camera"])
def test_lidar_depth_agrees_with_the_cameras_depth(street: SyntheticStreet, camera: str):
    sweep = street.sweep(5)
    assert sweep is not None
    lens = next(c.lens for c in street.cameras if c.name == camera).resized(1920, 1080)
    local = seen_by(street, camera, 5, sweep.points_world)
    u = local[:, 0] / local[:, 2] * lens.fx_px + lens.cx_px
    v = local[:, 1] / local[:, 2] * lens.fy_px + lens.cy_px
    inside = (local[:, 2] > 1) & (u >= 0) & (u < 1920) & (v >= 0) & (v < 1080)
    depth = street.depth(5, street.world_SE3_camera(camera, 5), lens)
    picture, point = depth[v[inside].astype(int), u[inside].astype(int)], local[inside, 2]
    assert len(point) > 3000
    # What the roof sees and the camera does not lies behind what the camera sees.
    unoccluded = point < picture + 0.3
    assert unoccluded.mean() > 0.75
    error = np.abs(point - picture)[unoccluded]
    assert np.median(error) < 0.03
    assert (error < 0.15).mean() > 0.9


def test_a_ray_to_a_noiseless_point_meets_it():
    log = open_synthetic("street?seed=7&frames=2&noise_m=0&sweep_s=0&lidar_azimuths=300&moving=7")
    sweep = log.sweep(1)
    assert sweep is not None
    local = seen_by(log, "front_camera", 1, sweep.points_world)
    ahead = local[(local[:, 2] > 2) & (np.abs(local[:, 0]) < local[:, 2])]
    worst, seen = [], 0
    for p in ahead[:: max(1, len(ahead) // 150)]:
        # A lens of one pixel whose centre looks exactly at the point.
        lens = Lens(1000, 1000, 0.5 - 1000 * p[0] / p[2], 0.5 - 1000 * p[1] / p[2], 1, 1)
        found = float(log.depth(1, log.world_SE3_camera("front_camera", 1), lens)[0, 0])
        assert found < p[2] + 0.02
        if found > p[2] - 0.05:
            seen += 1
            worst.append(abs(found - p[2]))
    assert seen > 80
    assert np.quantile(worst, 0.95) < 0.002


def test_range_noise_is_what_was_asked():
    query = "street?seed=5&frames=1&sweep_s=0&lidar_azimuths=200"
    noisy, clean = (open_synthetic(query + f"&noise_m={n}").sweep(0) for n in (0.01, 0))
    assert noisy is not None and clean is not None
    moved = np.linalg.norm(noisy.points_world - clean.points_world, axis=1)
    assert np.sqrt((moved**2).mean()) == pytest.approx(0.01, rel=0.05)


def test_sweep_values(street: SyntheticStreet):
    sweep = street.sweep(3)
    assert sweep is not None
    n = len(sweep.points_world)
    assert n > 30_000 and sweep.points_world.dtype == np.float64
    assert sweep.intensity.shape == sweep.timestamps_s.shape == (n,) and sweep.intensity.dtype == np.float32
    assert sweep.intensity.min() >= 0 and sweep.intensity.max() <= 1 and np.ptp(sweep.intensity) > 0.3
    late = sweep.timestamps_s - street.frame_timestamp_s(3)
    assert np.abs(late).max() <= 0.05 + 1e-6 and np.ptp(late) > 0.09
    local = in_box(sweep.points_world, street.world_SE3_lidar(3))
    # Forward is scanned at the frame's time, on average.
    forward = (local[:, 0] > 5) & (np.abs(local[:, 1]) < 1)
    assert abs(late[forward].mean()) < 2e-3
    assert np.linalg.norm(local, axis=1).max() < 103
    road = (np.abs(local[:, 1]) < 1.5) & (np.abs(local[:, 0]) < 8)
    assert np.abs(np.median(local[road, 2])) < 0.03


def moved_box(track: CuboidTrack, street: SyntheticStreet, k: int, late: float) -> np.ndarray:
    """The box of the track's k-th frame, carried on for ``late`` seconds at constant velocity."""
    box = track.world_SE3_box[k].copy()
    box[:3, 3] += (track.world_SE3_box[k + 1] - track.world_SE3_box[k - 1])[:3, 3] / 0.2 * late
    return box


def test_moving_cars_hold_their_points_at_the_points_own_times(street: SyntheticStreet):
    sweep = street.sweep(5)
    assert sweep is not None
    checked = 0
    for track in street.tracks():
        if not track.moving or track.label != "Car" or 5 not in track.frames[1:-1]:
            continue
        k = int(np.flatnonzero(track.frames == 5)[0])
        half = np.array(track.size_m) / 2
        near = np.abs(in_box(sweep.points_world, track.world_SE3_box[k])) < half + 0.6
        near = near.all(1)
        local = np.array(
            [
                in_box(p, moved_box(track, street, k, t - street.frame_timestamp_s(5)))
                for p, t in zip(sweep.points_world[near], sweep.timestamps_s[near], strict=True)
            ]
        ).reshape(-1, 3)
        above = local[local[:, 2] > -half[2] + 0.2]
        if len(above) < 20:
            continue
        checked += 1
        # 5 cm: mirrors and range noise.
        assert (np.abs(above) < half + 0.12).all(1).mean() > 0.995
        assert np.abs(above[:, 0]).max() > half[0] - 0.25
    assert checked >= 2


def test_tracks(street: SyntheticStreet):
    tracks = street.tracks()
    moving = [t for t in tracks if t.moving]
    assert len({t.track_id for t in tracks}) == len(tracks)
    assert {t.label for t in tracks} == {"Car", "Pedestrian"}
    assert sum(t.label == "Car" for t in moving) == 4
    assert any(not t.moving and t.label == "Pedestrian" for t in tracks)
    assert sum(not t.moving and t.label == "Car" for t in tracks) >= 5
    for t in tracks:
        assert (np.diff(t.frames) > 0).all() and t.world_SE3_box.shape == (len(t.frames), 4, 4)
        rotation = t.world_SE3_box[:, :3, :3]
        np.testing.assert_allclose(
            rotation @ rotation.transpose(0, 2, 1), np.broadcast_to(np.eye(3), rotation.shape), atol=1e-9
        )
        step = np.linalg.norm(np.diff(t.world_SE3_box[:, :3, 3], axis=0), axis=1)
        assert (step.max(initial=0) > 0.01) == t.moving
        if t.moving and t.label == "Car":
            ahead = np.einsum("fi,fi->f", np.diff(t.world_SE3_box[:, :3, 3], axis=0), t.world_SE3_box[:-1, :3, 0])
            assert (ahead > 0.2).all()


@pytest.mark.parametrize("seed", range(6))
def test_the_corridor_of_shifted_cameras_is_free(seed: int):
    log = open_synthetic(f"street?seed={seed}&frames=20&moving=7&pedestrians=8")
    for frame in (0, 10, 19):
        ego = log.world_SE3_lidar(frame)
        for t in log.tracks():
            k = np.flatnonzero(t.frames == frame)
            if len(k) == 0:
                continue
            box = t.world_SE3_box[int(k[0])]
            corners = np.array([[x, y, 0] for x in (-0.5, 0.5) for y in (-0.5, 0.5)]) * t.size_m
            local = in_box(corners @ box[:3, :3].T + box[:3, 3], ego)
            beside = (local[:, 0].min() < 2.0) & (local[:, 0].max() > -1.5)
            # Cameras sit up to 0.7 m beside the axis and are shifted by up to 5 m.
            assert not beside or np.abs(local[:, 1]).min() > 5.7, t.track_id


def test_a_shadow_falls_and_sky_is_sky(street: SyntheticStreet):
    camera = street.cameras[0]
    pose = street.world_SE3_camera(camera.name, 0)
    image = street.truth.image(0, pose, camera.lens).astype(float)
    depth = street.depth(0, pose, camera.lens)
    sky = ~np.isfinite(depth)
    assert 0.02 < sky.mean() < 0.6
    assert (image[sky][:, 2] >= image[sky][:, 0] - 1).mean() > 0.9
    assert np.isfinite(depth[120:]).all() and (depth > 0).all()


def test_people_walk_with_their_arms_and_as_near_as_asked_for():
    near = "street?seed=1020&frames=12&cameras=1&pedestrians=8&pedestrians_aside_m=5.3"
    still, walking = open_synthetic(near), open_synthetic(near + "&stride=1")
    assert open_synthetic(near + "&stride=0").image_bytes("front_camera", 7) == still.image_bytes("front_camera", 7)
    for a, b in zip(still.tracks(), walking.tracks(), strict=True):
        np.testing.assert_array_equal(a.world_SE3_box, b.world_SE3_box)
    pose, lens = still.world_SE3_camera("front_camera", 7), still.cameras[0].lens
    images = [log.truth.image(7, pose, lens) for log in (still, walking)]
    changed = (images[0] != images[1]).any(2)
    assert 0.0003 < changed.mean() < 0.05
    arms = []
    for log in (still, walking):
        # A sweep is a ray cast of the street: once a frame, not once a track.
        points = {frame: log.sweep(frame).points_world for frame in range(0, 12, 2)}
        for track in (t for t in log.tracks() if t.label == "Pedestrian" and t.moving):
            for frame in range(0, 12, 2):
                at = np.flatnonzero(track.frames == frame)
                local = in_box(points[frame], track.world_SE3_box[at[0]])
                hands = (np.abs(local[:, 1]) > 0.2) & (np.abs(local[:, 1]) < 0.34) & (np.abs(local[:, 2]) < 0.25)
                arms.append((log is walking, local[hands & (np.abs(local[:, 0]) < 0.6), 0]))
    reach = [np.abs(np.concatenate([x for own, x in arms if own is which])).max() for which in (False, True)]
    assert reach[0] < 0.2 and reach[1] > 0.2
    aside = [abs(in_box(t.world_SE3_box[0, None, :3, 3], still.world_SE3_lidar(0))[0, 1]) for t in still.tracks()[:4]]
    assert all(t.label != "Pedestrian" or 3 < a < 8 for t, a in zip(still.tracks(), aside, strict=False))
