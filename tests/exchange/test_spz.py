"""SPZ files."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path

import gsply
import numpy as np
import pytest
import zstandard
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from genre_tasks.errors import InputError
from genre_tasks.exchange.cloud_errors import CloudErrors, compare_clouds
from genre_tasks.exchange.clouds import transform_cloud
from genre_tasks.exchange.one_cloud import make_resting_scene
from genre_tasks.exchange.sh_rotation import compute_sh_rotations, evaluate_real_sh
from genre_tasks.exchange.spz.axes import SPZ_R_SCENE, turn_from_spz, turn_to_spz
from genre_tasks.exchange.spz.format import SPZ
from genre_tasks.exchange.types import SplatCloud
from tests.exchange.format_suite import FormatSuite
from tests.exchange.splat_clouds import change_one, make_cloud, same_bits

DATA = Path(__file__).parents[1] / "data" / "exchange"
STREAMS = ("positions", "opacities", "colors", "scales", "rotations", "sh_rest")
# A harmonic is rounded in the axes of SPZ, and turning it back adds up the errors of those that it is mixed from.
SH_STEP = 1 / 128
SH_MIXING = max(float(np.abs(matrix).sum(1).max()) for matrix in compute_sh_rotations(SPZ_R_SCENE, 4))
# Right, down, front, as PLY files of photographs: half a turn about x from SPZ's axes.
SCENE_R_PHOTO = SPZ_R_SCENE.T @ np.diag([1.0, -1.0, -1.0])


class TestSpz(FormatSuite):
    name = "spz"
    cut_attributes = frozenset({"sh_dc", "sh_rest", "log_scales"})
    tolerances = CloudErrors(
        means_m=0.5 / 4096 + 1e-6,
        log_scales=0.5 / 16 + 1e-6,
        angles_rad=0.005,
        opacities=0.5 / 255 + 1e-6,
        colors=0.5 / 255 / 0.15 * 0.2820948 + 1e-6,
        sh_rest=0.5 * SH_STEP * SH_MIXING + 1e-6,
    )


def write(path: Path, cloud: SplatCloud) -> Path:
    SPZ.write(path, make_resting_scene(cloud))
    return path


def read(path: Path) -> SplatCloud:
    return SPZ.read(path).nodes[0].cloud


def losses(cloud: SplatCloud) -> str:
    return " ".join(SPZ.describe_losses(make_resting_scene(cloud)))


def read_by_layout(data: bytes) -> dict[str, NDArray[np.uint8]]:
    """The streams of a file by the layout of version 4 alone, without the code that is tested."""
    magic, version, count, degree, _, _, streams, table = struct.unpack_from("<4sIIBBBBI", data)
    assert (magic, version, table) == (b"NGSP", 4, 32)
    assert data[20:32] == bytes(12)
    assert streams == (6 if degree else 5)
    start = table + 16 * streams
    found = {}
    for k in range(streams):
        packed, raw = struct.unpack_from("<QQ", data, table + 16 * k)
        stream = zstandard.decompress(data[start : start + packed])
        assert len(stream) == raw
        found[STREAMS[k]] = np.frombuffer(stream, np.uint8).reshape(count, -1)
        start += packed
    assert start == len(data)
    return found


def positions_by_layout(data: bytes) -> NDArray[np.float64]:
    rows = read_by_layout(data)["positions"].reshape(-1, 3, 3)
    fixed = [[int.from_bytes(part.tobytes(), "little", signed=True) for part in row] for row in rows]
    return np.array(fixed) / 2.0 ** data[13]


def measure_covariances(cloud: SplatCloud) -> NDArray[np.float64]:
    turn = Rotation.from_quat(np.roll(cloud.quats.astype(np.float64), -1, axis=1)).as_matrix()
    variance = np.exp(2 * cloud.log_scales.astype(np.float64))
    return np.asarray(turn @ (variance[:, :, None] * turn.transpose(0, 2, 1)))


# --- axes


def test_ahead_is_minus_z_left_is_minus_x_and_up_is_y(tmp_path: Path) -> None:
    cloud = replace(make_cloud(3), means=np.diag([10.0, 20.0, 30.0]).astype(np.float32))
    found = positions_by_layout(write(tmp_path / "scene.spz", cloud).read_bytes())
    np.testing.assert_array_equal(found, [[0, 0, -10], [-20, 0, 0], [0, 30, 0]])


def test_covariances_and_colours_turn_with_the_axes() -> None:
    cloud = make_cloud(20, 4)
    turned = turn_to_spz(cloud)
    expected = SPZ_R_SCENE @ measure_covariances(cloud) @ SPZ_R_SCENE.T
    np.testing.assert_allclose(measure_covariances(turned), expected, rtol=1e-5, atol=1e-7)
    direction = np.array([0.6, -0.48, 0.64])
    before = np.einsum("k,nkc->nc", evaluate_real_sh(direction, 4), cloud.sh_rest)
    after = np.einsum("k,nkc->nc", evaluate_real_sh(SPZ_R_SCENE @ direction, 4), turned.sh_rest)
    np.testing.assert_allclose(after, before, atol=1e-5)


def test_the_way_to_the_axes_and_back_keeps_bits() -> None:
    cloud = make_cloud(50, 1)
    assert same_bits(turn_from_spz(turn_to_spz(cloud)), cloud)


# --- what other tools write and read


@pytest.mark.parametrize("version", [3, 4])
def test_files_of_the_formats_authors(version: int) -> None:
    # Written by @playcanvas/splat-transform 2.7.1 with Niantic's library, from make_cloud(5, 3, seed=7, extent_m=30)
    # as a PLY file, whose axes it takes as right, down, front.
    pose = np.eye(4)
    pose[:3, :3] = SCENE_R_PHOTO
    expected = transform_cloud(make_cloud(5, 3, seed=7, extent_m=30), pose)
    found = read(DATA / f"five-v{version}.spz")
    errors = compare_clouds(expected, replace(found, log_scales=expected.log_scales, quats=expected.quats))
    # That tool keeps five bits of the first harmonics and four of the others.
    assert not errors.exceed(replace(TestSpz.tolerances, sh_rest=(1 / 16 + SH_STEP) * SH_MIXING))
    # Which of its axes a Gaussian's first scale belongs to depends on the tool; the ellipsoid does not.
    expected_covariances = measure_covariances(expected)
    size = np.abs(expected_covariances).max((1, 2), keepdims=True)
    assert (np.abs(measure_covariances(found) - expected_covariances) / size).max() < 0.08
    assert found.antialiased is False


def test_another_reader_finds_the_same(tmp_path: Path) -> None:
    cloud = make_cloud(200, 2)
    found = gsply.read_spz(str(write(tmp_path / "scene.spz", cloud)))
    turned = turn_to_spz(cloud)
    # That reader leaves the axes as they are.
    np.testing.assert_allclose(np.asarray(found.means), turned.means, atol=0.5 / 4096 + 1e-6)
    np.testing.assert_allclose(np.asarray(found.scales), turned.log_scales, atol=0.5 / 16 + 1e-6)
    alignment = np.abs((np.asarray(found.quats) * turned.quats).sum(1)) / np.linalg.norm(turned.quats, axis=1)
    assert alignment.min() > 1 - 1e-5


# --- ranges


@pytest.mark.parametrize(
    ("extent_m", "bits"), [(100.0, 12), (2047.9, 12), (2048.0, 11), (4100.0, 10), (16300.0, 9), (8388607.0, 0)]
)
def test_the_extent_chooses_the_precision(tmp_path: Path, extent_m: float, bits: int) -> None:
    cloud = change_one(make_cloud(10), "means", extent_m)
    data = write(tmp_path / "scene.spz", cloud).read_bytes()
    assert data[13] == bits
    found = read(tmp_path / "scene.spz")
    assert np.abs(found.means.astype(np.float64) - cloud.means).max() <= 0.5 / 2**bits


def test_what_does_not_fit_is_refused(tmp_path: Path) -> None:
    for attribute, value, problem in (("means", 8.4e6, "too far"), ("log_scales", 6.0, "too large")):
        with pytest.raises(InputError, match=problem) as caught:
            write(tmp_path / "scene.spz", change_one(make_cloud(4), attribute, value))
        assert caught.value.file == str(tmp_path / "scene.spz")
        assert not (tmp_path / "scene.spz").exists()


def test_a_quaternion_without_direction_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"Gaussian 2 .*no direction"):
        write(tmp_path / "scene.spz", change_one(make_cloud(4), "quats", 0.0, row=2))


def test_values_outside_are_counted() -> None:
    assert "outside" not in losses(make_cloud(4, 1))
    cloud = change_one(make_cloud(4, 1), "sh_dc", 3.5)
    cloud = change_one(cloud, "sh_rest", -1.5, row=0)
    cloud = change_one(cloud, "log_scales", -11.0, row=3)
    found = losses(cloud)
    assert "3 colour values" in found
    assert "9 values of view-dependent colour" in found
    assert "3 standard deviations" in found


@pytest.mark.parametrize(("antialiased", "flag"), [(True, 1), (False, 0), (None, 0)])
def test_the_flag_of_anti_aliasing(tmp_path: Path, antialiased: bool | None, flag: int) -> None:
    cloud = replace(make_cloud(4), antialiased=antialiased)
    assert write(tmp_path / "scene.spz", cloud).read_bytes()[14] == flag


def test_rotations_are_within_a_quarter_of_a_degree(tmp_path: Path) -> None:
    cloud = make_cloud(5000)
    errors = compare_clouds(cloud, read(write(tmp_path / "scene.spz", cloud)))
    assert np.degrees(errors.angles_rad) < 0.25
