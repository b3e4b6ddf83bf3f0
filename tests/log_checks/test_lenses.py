"""Intrinsics that do not belong to the images, in growing strength, and those of real rigs."""

from __future__ import annotations

from dataclasses import replace

import pytest

from genre_tasks.logs.types import Lens
from tests.log_checks.edited_log import EditedLog, assess_lenses, is_complete, street, with_lens

# Calibrations as the datasets have them, cx and cy from the corner of the image where a reader says so.
REAL = {
    "pandaset front": Lens(1970.0131, 1970.0091, 970.5, 483.8, 1920, 1080),
    "pandaset front right": Lens(930.0407, 930.0324, 965.6, 463.9, 1920, 1080),
    "pandaset back": Lens(933.4667, 934.6754, 897.0, 507.9, 1920, 1080),
    "pandaset left": Lens(930.4514, 930.0891, 992.2, 542.1, 1920, 1080),
    "kitti rectified": Lens(721.5377, 721.5377, 609.5593, 172.854, 1242, 375),
    "kitti raw 0": Lens(984.24, 980.81, 690.0, 233.2, 1392, 512, (-0.3728755, 0.2037299, 0.00222, 0.00138, -0.0723)),
    "kitti raw 2": Lens(959.79, 956.93, 696.0, 224.2, 1392, 512, (-0.3691481, 0.1968681, 0.00135, 0.00057, -0.0677)),
    "argoverse front": Lens(1776.04, 1776.04, 777.99, 1013.52, 1550, 2048, (-0.240732, -0.212243, 0.0, 0.0, 0.325902)),
    "argoverse left": Lens(1687.53, 1687.53, 1031.44, 768.25, 2048, 1550, (-0.281782, -0.037336, 0.0, 0.0, 0.104648)),
    "nuscenes front": Lens(1266.4172, 1266.4172, 816.267, 491.507, 1600, 900),
    "nuscenes back": Lens(809.221, 809.221, 829.2196, 481.7784, 1600, 900),
    "waymo front": Lens(2055.55615, 2055.55615, 939.65747, 641.072182, 1920, 1280),
}


@pytest.mark.parametrize("name", REAL)
def test_real_lenses_are_plausible(name: str) -> None:
    """Report: waymo-research/waymo-open-dataset#24 has the numbers of Waymo's front camera."""
    assert assess_lenses(with_lens(street(), lambda _: REAL[name])) == {}


def resize_images(lens: Lens, factor: float) -> Lens:
    """The lens of images that were resized while the intrinsics stayed."""
    return replace(lens, width_px=round(lens.width_px * factor), height_px=round(lens.height_px * factor))


@pytest.mark.parametrize("name", [name for name in REAL if "raw" not in name])
@pytest.mark.parametrize("factor", [0.25, 0.5, 2.0])
def test_resized_images_are_named_with_their_factor(name: str, factor: float) -> None:
    """Report: nv-tlabs/lift-splat-shoot#35."""
    finding = assess_lenses(with_lens(street(), lambda _: resize_images(REAL[name], factor)))["odd_principal_point"]
    assert finding.severity == "warning" and is_complete(finding)
    assert finding.numbers["factor"] == pytest.approx(factor, rel=0.1)
    assert f"look resized by {finding.numbers['factor']:.2g}" in finding.remedy


def test_where_resizing_is_seen() -> None:
    """Below a quarter, principal points of real rigs are as far from the middle."""
    lens = REAL["nuscenes front"]
    found = [
        factor
        for factor in (0.5, 0.6, 0.7, 0.75, 0.9, 1.0, 1.1, 1.5, 2.0)
        if assess_lenses(with_lens(street(), lambda _, factor=factor: resize_images(lens, factor)))
    ]
    assert found == [0.5, 0.6, 0.7, 0.75, 1.5, 2.0]


@pytest.mark.parametrize(
    "change",
    [
        {"cx_px": 0.0, "cy_px": 0.0},
        {"cx_px": 300.0},
        {"cx_px": -970.0},
        {"cy_px": 1000.0},
        {"cx_px": 540.0, "cy_px": 960.0},
        {"width_px": 960},
        {"height_px": 540},
    ],
)
def test_cropped_stretched_or_foreign_images(change: dict[str, float]) -> None:
    """Report: colmap/colmap#365 has a principal point of (0, 0)."""
    finding = assess_lenses(with_lens(street(), lambda _: replace(REAL["nuscenes front"], **change)))[
        "odd_principal_point"
    ]
    assert is_complete(finding) and finding.camera == "left"


def test_images_of_waymo_sides_are_cropped_and_sound() -> None:
    """A principal point a quarter of the height from the upper edge is that of images whose sky was cut off."""
    assert assess_lenses(with_lens(street(), lambda _: Lens(2055.0, 2055.0, 968.0, 240.0, 1920, 886))) == {}


@pytest.mark.parametrize(
    ("lens", "reason"),
    [
        (Lens(0.58, 1.92, 0.5, 0.5, 1242, 375), "fractions of the image's size"),
        (Lens(1.03, 1.82, 1.0, 1.0, 1920, 1080), "fractions of the image's size"),
        (Lens(4.6, 4.6, 3.6, 2.7, 1920, 1080), "millimetres"),
        (Lens(25.0, 25.0, 12.0, 8.0, 1920, 1080), "unit of the intrinsics"),
        (Lens(19700.0, 19700.0, 970.0, 532.0, 1920, 1080), "unit of the intrinsics"),
    ],
)
def test_focal_lengths_in_other_units(lens: Lens, reason: str) -> None:
    """Report: nianticlabs/monodepth2#6 (intrinsics divided by the image's size), zhenzhiwang/HumanVid#12."""
    found = assess_lenses(with_lens(street(), lambda _: lens))
    assert set(found) == {"odd_focal_length"} and is_complete(found["odd_focal_length"])
    assert reason in found["odd_focal_length"].remedy


@pytest.mark.parametrize(("aspect", "fires"), [(0.5, True), (0.8, True), (0.9, False), (1.1, False), (1.25, True)])
def test_pixels_that_are_not_square(aspect: float, fires: bool) -> None:
    """Report: diode-dataset/diode-devkit#2; princeton-vl/DeepV2D#5 has 10 % that are right."""
    found = assess_lenses(with_lens(street(), lambda lens: replace(lens, fx_px=lens.fy_px * aspect)))
    assert set(found) == ({"odd_pixel_aspect"} if fires else set())
    assert all(is_complete(finding) for finding in found.values())


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 0.0, -50.0])
def test_focal_lengths_that_are_none(value: float) -> None:
    """Report: none found; case 2 of the list of odd logs."""
    found = assess_lenses(with_lens(street(), lambda lens: replace(lens, fx_px=value)))
    assert found["odd_focal_length"].severity == "fatal"


def test_a_distortion_that_folds_is_fatal_for_any_reader() -> None:
    """Report: opencv/opencv#14596 (a calibration whose distortion is not monotonic)."""
    found = assess_lenses(with_lens(street(), lambda lens: replace(lens, distortion=(-0.9, 0.0, 0.0, 0.0, 0.0))))
    assert set(found) == {"folding_distortion"}
    assert found["folding_distortion"].severity == "fatal" and is_complete(found["folding_distortion"])


def test_each_camera_is_judged() -> None:
    front, left = street().cameras
    log = EditedLog(street(), cameras=(front, replace(left, lens=resize_images(left.lens, 0.5))))
    assert assess_lenses(log)["odd_principal_point"].camera == "left"
