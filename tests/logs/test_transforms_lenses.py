"""Distortion in a ``transforms.json``: read as nerfstudio reads it, or refused, and never left out without a word."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from genre_tasks.errors import InputError
from genre_tasks.logs.posed_images.transforms_json import read_transforms

LENS = {"w": 80, "h": 60, "fl_x": 50.0, "fl_y": 50.0, "cx": 40.0, "cy": 30.0}


def read_distortion(folder: Path, shared: dict[str, Any], frame: dict[str, Any] | None = None) -> tuple[float, ...]:
    frames = [{"file_path": "0.png", "transform_matrix": np.eye(4).tolist(), **(frame or {})}]
    (folder / "transforms.json").write_text(json.dumps({**LENS, **shared, "frames": frames}))
    (image,) = read_transforms(folder / "transforms.json")
    return image.lens.distortion


def test_the_list_of_nerfstudio_has_its_order(tmp_path: Path) -> None:
    # k1, k2, k3, k4, p1, p2 there; k1, k2, p1, p2, k3 here.
    stated = [0.1, 0.2, 0.3, 0.0, 0.004, 0.005]
    assert read_distortion(tmp_path, {"distortion_params": stated}) == (0.1, 0.2, 0.004, 0.005, 0.3)
    assert read_distortion(tmp_path, {}, {"distortion_params": stated}) == (0.1, 0.2, 0.004, 0.005, 0.3)


def test_the_list_comes_before_names_of_their_own(tmp_path: Path) -> None:
    stated = {"distortion_params": [0.1, 0, 0, 0, 0, 0], "k1": 0.5, "p2": 0.5}
    assert read_distortion(tmp_path, stated) == (0.1, 0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("stated", [None, [], [0, 0, 0, 0], [0.0] * 6])
def test_a_list_that_says_nothing_leaves_the_names(tmp_path: Path, stated: Any) -> None:
    assert read_distortion(tmp_path, {"distortion_params": stated}) == ()
    assert read_distortion(tmp_path, {"distortion_params": stated, "k1": 0.1}) == (0.1, 0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("stated", "words"),
    [
        ({"distortion_params": [0.1, 0.0, 0.0, 0.2, 0.0, 0.0]}, "k4 is not supported"),
        ({"distortion_params": [0.1, 0.0, 0.0, 0.0]}, "no list of the six numbers k1, k2, k3, k4, p1, p2"),
        ({"distortion_params": [0.1] * 12}, "no list of the six numbers"),
        ({"distortion_params": [0.1, 0.0, 0.0, 0.0, 0.0, "0"]}, "no list of the six numbers"),
        ({"distortion_params": {"k1": 0.1}}, "no list of the six numbers"),
        ({"distortion_params": "0.1"}, "no list of the six numbers"),
        ({"k4": 0.1}, "k4 is not supported"),
        ({"distortion": [0.1, 0.0, 0.0, 0.0]}, "under distortion, which is not read"),
        ({"dist_coeffs": [[0.1, 0.0, 0.0, 0.0]]}, "under dist_coeffs, which is not read"),
        ({"D": [0.1], "k5": 0.1}, "under D, k5, which is not read"),
        ({"radial": {"k1": 0.1}}, "under radial, which is not read"),
    ],
)
@pytest.mark.parametrize("is_shared", [True, False])
def test_what_is_not_read_is_refused(tmp_path: Path, stated: dict[str, Any], words: str, is_shared: bool) -> None:
    with pytest.raises(InputError, match=words) as caught:
        read_distortion(tmp_path, *((stated, None) if is_shared else ({}, stated)))
    assert caught.value.remedy and caught.value.file == str(tmp_path / "transforms.json")


def test_zeros_under_other_names_say_nothing(tmp_path: Path) -> None:
    assert read_distortion(tmp_path, {"distortion": [0.0, 0.0], "D": 0, "k1": 0.1})[0] == 0.1
