"""Checks that all formats share, and conversions of values."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from genre_tasks.errors import InputError
from genre_tasks.exchange.activations import (
    colors_to_sh_dc,
    logits_to_opacities,
    opacities_to_logits,
    scales_to_logs,
    sh_dc_to_colors,
)
from genre_tasks.exchange.checks import check_claimed_size, check_finite_cloud, read_file
from genre_tasks.exchange.cloud_errors import compare_clouds
from tests.exchange.splat_clouds import change_one, make_cloud

FILE = Path("a.ply")


@pytest.mark.parametrize("attribute", ["means", "log_scales", "quats", "logit_opacities", "sh_dc", "sh_rest"])
def test_values_that_are_not_finite_are_named(attribute: str) -> None:
    cloud = change_one(change_one(make_cloud(9, 2), attribute, np.nan, row=7), attribute, -np.inf, row=4)
    with pytest.raises(InputError, match=rf"{attribute} is not finite in 2 Gaussians, the first is number 4 .*a\.ply"):
        check_finite_cloud(FILE, cloud)
    check_finite_cloud(FILE, make_cloud(9, 2))


def test_a_file_may_be_longer_than_it_claims() -> None:
    check_claimed_size(FILE, 10, 11, "1 Gaussian")
    with pytest.raises(InputError, match="1 Gaussian need 12 bytes, and 11 are there"):
        check_claimed_size(FILE, 12, 11, "1 Gaussian")


def test_the_beginning_of_a_file(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"0123456789")
    assert read_file(tmp_path / "a", 4) == b"0123"
    # More than the file has takes no more memory than the file.
    assert read_file(tmp_path / "a", 1 << 60) == read_file(tmp_path / "a") == b"0123456789"


def test_values_there_and_back() -> None:
    opacities = np.linspace(1e-6, 1 - 1e-6, 1001)
    np.testing.assert_allclose(logits_to_opacities(opacities_to_logits(opacities)), opacities, atol=2e-7)
    assert np.isfinite(opacities_to_logits(np.array([0.0, 1.0]))).all()
    assert logits_to_opacities(np.array([-1e30, 1e30], np.float32)).tolist() == [0, 1]
    colors = np.linspace(-1, 2, 301)
    np.testing.assert_allclose(sh_dc_to_colors(colors_to_sh_dc(colors)), colors, atol=2e-7)


def test_scales_of_nothing_are_refused() -> None:
    for scale in (0.0, -1.0, np.nan):
        with pytest.raises(InputError, match="2 Gaussians are not above 0, the first is number 1 "):
            scales_to_logs(FILE, np.array([[1, 1, 1], [1, scale, 1], [scale, 1, 1]], np.float32))


def test_differences_of_clouds() -> None:
    cloud = make_cloud(5, 1)
    same = change_one(cloud, "quats", 0.0)
    same.quats[:] = -2 * cloud.quats
    # A quaternion of any length and its negative are one rotation.
    assert compare_clouds(cloud, same).angles_rad < 1e-6
    assert compare_clouds(cloud, make_cloud(5, 1, seed=1)).exceed(compare_clouds(cloud, cloud)) == (
        "means_m",
        "log_scales",
        "angles_rad",
        "opacities",
        "colors",
        "sh_rest",
    )
    broken = change_one(cloud, "means", np.nan)
    assert compare_clouds(cloud, broken).exceed(compare_clouds(cloud, same)) == ("means_m",)
    with pytest.raises(ValueError, match="expected 5 Gaussians, got 4"):
        compare_clouds(cloud, make_cloud(4, 1))
