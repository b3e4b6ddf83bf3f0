"""Which distortion coefficients are read, and which are refused with a reason."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from genre_tasks.errors import InputError
from genre_tasks.logs.lens_validity import find_distortion_faults, measure_distortion_reach, read_distortion
from genre_tasks.logs.pandaset.reader import open_pandaset
from genre_tasks.logs.pandaset.writer import write_pandaset
from genre_tasks.logs.types import Lens
from genre_tasks.scene.lens_distortion import fold_radius
from tests.logs.pandaset_folder import edit_json, small_log

WIDE = (922.5, 922.5, 945.6, 538.1, 1920, 1080)
# cam 3 of KITTI's raw images of 2011_09_26.
KITTI_3 = Lens(903.7, 901.9, 695.7, 224.2, 1392, 512, (-0.3639558, 0.1788651, 0.0006, -0.0004, -0.0538246))


def words(*coefficients: float) -> list[tuple[str, str]]:
    return [(finding.word, finding.severity) for finding in find_distortion_faults(Lens(*WIDE, coefficients))]


class TestReading:
    @pytest.mark.parametrize("count", [0, 1, 2, 4, 5])
    def test_counts_of_the_model(self, count: int) -> None:
        coefficients = (-0.05, 0.01, 0.001, -0.001, 0.002)[:count]
        assert read_distortion({"distortion": list(coefficients)}) == coefficients

    @pytest.mark.parametrize("count", [8, 12, 14])
    def test_trailing_zeros_say_nothing(self, count: int) -> None:
        coefficients = [-0.05, 0.01, 0.001, -0.001, 0.002]
        assert read_distortion({"distortion": coefficients + [0.0] * (count - 5)}) == tuple(coefficients)

    @pytest.mark.parametrize("intrinsics", [{}, {"distortion": None}, {"distortion": [0, 0, 0]}, {"k1": 0.0, "D": []}])
    def test_no_distortion(self, intrinsics: dict[str, Any]) -> None:
        assert not any(read_distortion(intrinsics))

    @pytest.mark.parametrize(
        "intrinsics",
        [
            {"distortion": "0.1"},
            {"distortion": "12345"},
            {"distortion": 0.1},
            {"distortion": {"k1": 0.1}},
            {"distortion": [[-0.05, 0.01, 0.0, 0.0, 0.0]]},
            {"distortion": [-0.24, -0.21, 0.32]},
            {"distortion": [None, 0.1]},
        ],
    )
    def test_what_cannot_be_understood(self, intrinsics: dict[str, Any]) -> None:
        """Report: colmap/colmap#163 asks in which order five coefficients are; three are ambiguous."""
        with pytest.raises(InputError) as raised:
            read_distortion(intrinsics, file="intrinsics.json")
        assert raised.value.remedy and raised.value.file == "intrinsics.json"

    @pytest.mark.parametrize("key", ["distortion_model", "camera_model", "model"])
    @pytest.mark.parametrize(
        "name", ["fisheye", "equidistant", "OPENCV_FISHEYE", "Kannala-Brandt", "thin prism", "mei"]
    )
    def test_other_lens_models(self, key: str, name: str) -> None:
        """Report: nerfstudio-project/nerfstudio#868 (fisheye coefficients used as those of a perspective lens)."""
        with pytest.raises(InputError, match=name):
            read_distortion({key: name, "distortion": [0.01, 0.0, 0.0, 0.0]})

    @pytest.mark.parametrize("name", ["plumb_bob", "radtan", "OPENCV", "Brown-Conrady", "rational_polynomial"])
    def test_names_of_the_model(self, name: str) -> None:
        assert read_distortion({"distortion_model": name, "distortion": [0.01]}) == (0.01,)
        assert read_distortion({"model": "acA1920-40gc", "distortion": [0.01]}) == (0.01,)

    @pytest.mark.parametrize("key", ["k1", "k3", "p2", "D", "dist_coeffs", "distortion_coefficients", "distCoeffs"])
    def test_coefficients_under_another_name(self, key: str) -> None:
        """Report: none found; case 5 of the list of odd logs."""
        with pytest.raises(InputError, match=key):
            read_distortion({key: 0.1 if len(key) == 2 else [0.1, 0.2, 0.0, 0.0]})


class TestJudging:
    @pytest.mark.parametrize("count", [6, 8, 12, 14])
    def test_more_coefficients_than_the_model_has(self, count: int) -> None:
        """Report: koide3/direct_visual_lidar_calibration#69, nerfstudio-project/nerfstudio#3355."""
        coefficients = (0.1, -0.05, 0.0, 0.0, 0.01) + (0.0,) * (count - 6) + (0.1,)
        (finding,) = find_distortion_faults(Lens(*WIDE, coefficients))
        assert finding.word == "unsupported_distortion" and finding.severity == "fatal"
        assert f"has {count} coefficients" in finding.message and "Undistort" in finding.remedy

    @pytest.mark.parametrize("value", [float("nan"), float("inf")])
    def test_not_finite(self, value: float) -> None:
        assert words(0.1, value) == [("invalid_distortion", "fatal")]

    @pytest.mark.parametrize("k1", [-0.08, -0.1, 0.02, 0.1, 0.5, 1.0])
    def test_sound_strengths(self, k1: float) -> None:
        assert words(k1) == []

    @pytest.mark.parametrize("k1", [-0.11, -0.15, -0.3, -1.0, -30.0, -1e3, -1e6])
    def test_folding_in_growing_strength(self, k1: float) -> None:
        """Report: opencv/opencv#15993 (a distortion that is not monotonic is a failed calibration)."""
        assert words(k1) == [("folding_distortion", "fatal")]
        radius = fold_radius((k1, 0.0, 0.0, 0.0, 0.0))
        measured = measure_distortion_reach(Lens(*WIDE, (k1,))).fold_radius_px
        assert measured == pytest.approx(922.5 * radius * (1 + k1 * radius**2), rel=1e-3)

    @pytest.mark.parametrize("coefficients", [(10.0,), (1e3,), (1e6,), (0.0, 1e3), (0.0, 0.0, 0.0, 0.0, 1e3)])
    def test_out_of_all_proportion(self, coefficients: tuple[float, ...]) -> None:
        """Report: valeoai/RADIal#33 has coefficients of −13 and 59, whose corrected images bend at the edges."""
        assert words(*coefficients) == [("extreme_distortion", "fatal")]

    def test_tangential_terms_count(self) -> None:
        """Report: colmap/colmap#163 (the order of the coefficients)."""
        assert words(0.0, 0.0, 0.01, -0.01) == []
        assert words(0.0, 0.0, 0.05) == [("odd_tangential_distortion", "warning")]
        assert words(0.0, 0.0, 0.3) == words(0.0, 0.0, 0.0, -0.3) == [("folding_distortion", "fatal")]

    def test_a_corner_of_a_real_image_may_fold(self) -> None:
        """Of a KITTI camera, 0.07 % of the image: worth a note, no refusal."""
        (finding,) = find_distortion_faults(KITTI_3)
        assert finding.severity == "note" and finding.numbers["lost_percent"] < 0.1

    def test_narrow_images_see_no_fold(self) -> None:
        assert find_distortion_faults(Lens(3000.0, 3000.0, 960.0, 540.0, 1920, 1080, (-0.6,))) == ()

    def test_reach_does_not_depend_on_resolution(self) -> None:
        lens = Lens(*WIDE, (-0.2, 0.01, 0.001, 0.002, 0.0))
        half = measure_distortion_reach(lens.resized(960, 540))
        full = measure_distortion_reach(lens)
        assert half.lost_fraction == full.lost_fraction
        assert 2 * half.fold_radius_px == pytest.approx(full.fold_radius_px) and np.isfinite(full.fold_radius_px)


class TestPandaSet:
    @pytest.mark.parametrize(
        ("distortion", "problem"),
        [
            ([0.1, -0.05, 0.0, 0.0, 0.01, 0.1, 0.0, 0.0], "has 8 coefficients"),
            ([1e3], "by the factor"),
            ([-1e3], "folds back"),
            ([float("nan")], "not finite"),
        ],
    )
    def test_refused_with_file_and_remedy(self, tmp_path: Path, distortion: list[float], problem: str) -> None:
        """Report: nerfstudio-project/nerfstudio#3611 asks for an error on more coefficients than are used."""
        folder = write_pandaset(small_log(), tmp_path / "002")
        file = folder / "camera/left/intrinsics.json"
        edit_json(file, lambda value: {**value, "distortion": distortion})
        with pytest.raises(InputError, match=problem) as raised:
            _ = open_pandaset(str(folder)).cameras
        assert raised.value.file == str(file) and raised.value.camera == "left" and raised.value.remedy

    def test_sound_coefficients_are_read_as_they_are(self, tmp_path: Path) -> None:
        folder = write_pandaset(small_log(), tmp_path / "002")
        edit_json(folder / "camera/left/intrinsics.json", lambda value: {**value, "distortion": [0.1, -0.05]})
        lenses = {camera.name: camera.lens for camera in open_pandaset(str(folder)).cameras}
        assert lenses["left"].distortion == (0.1, -0.05) and lenses["front"].distortion == ()
        assert "distortion" not in json.loads((folder / "camera/front/intrinsics.json").read_text())
