"""The synthetic street as a driving log: contract, determinism, options."""

import hashlib
import io
import os
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from genre_tasks.errors import InputError
from genre_tasks.logs.synthetic import SyntheticStreet, open_synthetic
from genre_tasks.logs.types import Truth
from genre_tasks.threads import torch_threads

SMALL = "street?seed=1000&frames=4&width=64&height=36&lidar_beams=16&lidar_azimuths=120"


@pytest.fixture(scope="module")
def street() -> SyntheticStreet:
    return open_synthetic(SMALL)


def decoded(data: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(data)))


def test_rig_is_in_the_known_order():
    log = open_synthetic("street?cameras=6&frames=1")
    names = [c.name for c in log.cameras]
    assert names == [
        "front_camera",
        "front_left_camera",
        "front_right_camera",
        "left_camera",
        "right_camera",
        "back_camera",
    ]
    front = log.cameras[0].lens
    assert 2 * np.degrees(np.arctan(front.width_px / 2 / front.fx_px)) == pytest.approx(52, abs=0.5)
    ego = log.world_SE3_lidar(0)
    views = {c.name: np.linalg.inv(ego) @ log.world_SE3_camera(c.name, 0) for c in log.cameras}
    assert views["front_camera"][0, 2] > 0.99 and views["back_camera"][0, 2] < -0.99
    assert views["left_camera"][1, 2] > 0.99 and views["front_left_camera"][1, 2] > 0.8
    assert views["right_camera"][1, 2] < -0.99 and views["front_right_camera"][1, 2] < -0.8
    for view in views.values():
        assert np.linalg.det(view[:3, :3]) == pytest.approx(1, abs=1e-12)
        assert view[2, 1] == pytest.approx(-1)


def test_image_is_png_of_the_cameras_size_and_equals_truth(street: SyntheticStreet):
    assert isinstance(street.truth, Truth)
    for camera in street.cameras:
        data = street.image_bytes(camera.name, 2)
        image = decoded(data)
        assert image.shape == (36, 64, 3) and image.dtype == np.uint8
        np.testing.assert_array_equal(
            image, street.truth.image(2, street.world_SE3_camera(camera.name, 2), camera.lens)
        )
        assert street.image_bytes(camera.name, 2) is data


def test_truth_belongs_to_its_caller(street: SyntheticStreet):
    pose, lens = street.world_SE3_camera("front_camera", 1), street.cameras[0].lens
    first = street.truth.image(1, pose, lens)
    kept = first.copy()
    first[:] = 0
    np.testing.assert_array_equal(street.truth.image(1, pose, lens), kept)


def test_shifted_view_differs_but_shows_the_same_street(street: SyntheticStreet):
    pose, lens = street.world_SE3_camera("front_camera", 0), street.cameras[0].lens
    here = street.truth.image(0, pose, lens).astype(float)
    pose[:3, 3] += 3 * street.world_SE3_lidar(0)[:3, 1]
    there = street.truth.image(0, pose, lens).astype(float)
    assert np.abs(here - there).mean() > 8
    assert np.abs(here.mean((0, 1)) - there.mean((0, 1))).max() < 40


def test_ego_drives_forward_at_its_speed():
    for seed in range(5):
        log = open_synthetic(f"street?seed={seed}&frames=20")
        poses = np.stack([log.world_SE3_lidar(f) for f in range(20)])
        steps = np.diff(poses[:, :3, 3], axis=0)
        speed = np.linalg.norm(steps, axis=1) / 0.1
        assert (speed > 3.3).all() and (speed < 11.5).all()
        # The car points where it goes.
        along = np.einsum("fi,fi->f", steps, poses[:-1, :3, 0]) / np.linalg.norm(steps, axis=1)
        assert along.min() > 0.9999


def test_standstill_does_not_move():
    log = open_synthetic("street?seed=1&standstill=1&frames=5")
    np.testing.assert_array_equal(log.world_SE3_lidar(0), log.world_SE3_lidar(4))
    assert log.frame_timestamp_s(4) > log.frame_timestamp_s(0)


def test_timestamps_are_unix_seconds_at_10_hz(street: SyntheticStreet):
    t = np.array([street.frame_timestamp_s(f) for f in range(4)])
    assert t[0] > 1.6e9
    np.testing.assert_allclose(np.diff(t), 0.1, atol=1e-6)
    assert street.camera_timestamp_s("front_camera", 3) == t[3]


def test_absent_things_are_absent():
    log = open_synthetic("street?cuboids=0&lidar=0&frames=2&cameras=1")
    assert log.tracks() == () and log.sweep(0) is None and log.sweep(1) is None


def test_faults_name_frame_and_camera(street: SyntheticStreet):
    with pytest.raises(InputError, match="frame 4") as caught:
        street.sweep(4)
    assert caught.value.log == street.name
    with pytest.raises(InputError, match="front_camera, front_left_camera"):
        street.image_bytes("rear_camera", 0)
    broken = np.eye(4)
    broken[0, 3] = np.nan
    with pytest.raises(InputError, match="finite"):
        street.truth.image(0, broken, street.cameras[0].lens)


def test_a_far_origin_shows_the_same_image_and_shifts_the_points():
    near, far = open_synthetic(SMALL), open_synthetic(SMALL + "&origin_m=1000000")
    assert far.world_SE3_lidar(1)[0, 3] - near.world_SE3_lidar(1)[0, 3] == pytest.approx(1e6, abs=1e-6)
    a, b = (decoded(k.image_bytes("front_camera", 1)).astype(int) for k in (near, far))
    # The pose is rounded at 1e-10 m; a rare sample may fall on the other side of an edge.
    assert (a != b).mean() < 1e-3
    p, q = near.sweep(1), far.sweep(1)
    assert p is not None and q is not None
    np.testing.assert_allclose(q.points_world - [1e6, 0, 0], p.points_world, atol=1e-6)


def test_digest_follows_parameters_without_building():
    same = [open_synthetic(f"street?{q}") for q in ("seed=1&frames=20", "frames=20&seed=1", "seed=1")]
    assert len({k.digest() for k in same}) == 1
    others = [open_synthetic(f"street?{q}").digest() for q in ("seed=2", "seed=1&moving=5", "seed=1&noise_m=0.02")]
    assert len({same[0].digest(), *others}) == 4
    assert len(same[0].digest()) == 64
    assert "_built" not in vars(same[0])


_PROBE = f"""
import hashlib
from genre_tasks.logs.synthetic import open_synthetic
log = open_synthetic({SMALL!r})
sweep = log.sweep(1)
state = hashlib.sha256(log.image_bytes("front_left_camera", 1))
for part in (sweep.points_world, sweep.intensity, sweep.timestamps_s, *(t.world_SE3_box for t in log.tracks())):
    state.update(part.tobytes())
assert __name__ == "__main__"
import sys
sys.stdout.write(state.hexdigest())
"""


def test_same_seed_same_bytes_in_two_processes(street: SyntheticStreet):
    # The other process may use another number of threads.
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "2")
    command = [sys.executable, "-c", _PROBE]
    run = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120, env=os.environ | threads)
    sweep = street.sweep(1)
    assert sweep is not None
    state = hashlib.sha256(street.image_bytes("front_left_camera", 1))
    parts = (sweep.points_world, sweep.intensity, sweep.timestamps_s, *(t.world_SE3_box for t in street.tracks()))
    for part in parts:
        state.update(part.tobytes())
    assert run.stdout == state.hexdigest()


def test_an_image_has_the_same_bytes_at_any_number_of_threads():
    images = []
    for threads in (1, 3):
        # More rays than are cast at once, so that threads have bands to share.
        street = open_synthetic("street?seed=3&frames=2&cameras=1&width=320&height=180")
        with torch_threads(threads):
            images.append(street.image_bytes("front_camera", 1))
    assert images[0] == images[1]


def test_opening_a_log_and_its_digest_need_no_torch():
    code = (
        "import sys\n"
        "from genre_tasks.logs.synthetic import open_synthetic\n"
        "open_synthetic('street?seed=3').digest()\n"
        "sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_seeds_differ():
    a, b = (decoded(open_synthetic(SMALL.replace("1000", s)).image_bytes("front_camera", 0)) for s in ("1", "2"))
    assert np.abs(a.astype(int) - b).mean() > 10
