"""Images of another size than their intrinsics: all readers scale the lens, or do not, by one rule."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from genre_tasks.errors import InputError
from genre_tasks.logs.image_sizes import ImageSizes, choose_lens
from genre_tasks.logs.posed_images.image_files import fit_lens
from genre_tasks.logs.types import Lens

RESAMPLED = [
    ((1242, 375), (124, 37)),
    ((1242, 375), (124, 38)),
    ((1920, 1081), (960, 540)),
    ((960, 540), (1920, 1081)),
    ((375, 1242), (37, 124)),
]
OTHER_SHAPE = [
    # A video encoder adds rows, so that their number divides by 16.
    ((1920, 1080), (1920, 1088)),
    ((1920, 1080), (1920, 1070)),
    ((1080, 1920), (1088, 1920)),
    ((1242, 375), (124, 33)),
    ((640, 480), (480, 640)),
]


@pytest.mark.parametrize(("stated", "size"), RESAMPLED)
def test_rounded_sizes_scale_the_lens(tmp_path: Path, stated: tuple[int, int], size: tuple[int, int]) -> None:
    lens = lens_of(*stated)
    chosen, findings = choose_lens(lens, ImageSizes({0: size}, {}), "front")
    assert chosen == lens.resized(*size)
    assert [finding.word for finding in findings] == ["resampled_images"]
    assert fit_lens(lens, "front", [write_image(tmp_path, size)]) == chosen


@pytest.mark.parametrize(("stated", "size"), OTHER_SHAPE)
def test_cropped_and_padded_images_scale_no_lens(
    tmp_path: Path, stated: tuple[int, int], size: tuple[int, int]
) -> None:
    lens = lens_of(*stated)
    chosen, findings = choose_lens(lens, ImageSizes({0: size}, {}), "front")
    assert chosen == lens
    assert [finding.word for finding in findings] == ["odd_image_size"]
    with pytest.raises(InputError, match=f"images of front are {size[0]}×{size[1]}"):
        fit_lens(lens, "front", [write_image(tmp_path, size)])


def lens_of(width_px: int, height_px: int) -> Lens:
    return Lens(0.6 * width_px, 0.6 * width_px, width_px / 2, height_px / 2, width_px, height_px)


def write_image(folder: Path, size: tuple[int, int]) -> Path:
    path = folder / "0.png"
    Image.new("L", size).save(path)
    return path
