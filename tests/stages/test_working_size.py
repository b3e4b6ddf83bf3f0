"""Images keep their shape: a rig of another shape than the preset's gets as many pixels in its own."""

from __future__ import annotations

from dataclasses import replace

import pytest

from genre_tasks.config import IngestConfig
from genre_tasks.logs.log_selection import choose_working_size
from genre_tasks.logs.registry import open_log
from genre_tasks.logs.types import Camera, Lens
from genre_tasks.stages.ingest import ingest

WIDE = Camera("image_02", Lens(721.5, 721.5, 609.6, 172.9, 1242, 375))
PORTRAIT = replace(WIDE, name="front", lens=Lens(1777.0, 1777.0, 775.0, 1024.0, 1550, 2048))


def test_a_wide_rig_keeps_its_shape_and_the_number_of_pixels() -> None:
    width, height = choose_working_size(IngestConfig(width_px=320, height_px=180), [WIDE, WIDE])
    assert width / height == pytest.approx(1242 / 375, rel=0.02)
    assert width * height == pytest.approx(320 * 180, rel=0.02)


def test_a_size_in_the_images_shape_is_taken_as_it_is() -> None:
    assert choose_working_size(IngestConfig(width_px=480, height_px=145), [WIDE]) == (480, 145)


def test_cameras_of_several_shapes_share_the_configured_size() -> None:
    assert choose_working_size(IngestConfig(width_px=320, height_px=180), [WIDE, PORTRAIT]) == (320, 180)
    assert choose_working_size(IngestConfig(), []) == (1280, 720)


def test_images_are_not_enlarged_beyond_their_own_size() -> None:
    small = replace(WIDE, lens=WIDE.lens.resized(124, 38))
    width, height = choose_working_size(IngestConfig(), [small])
    # Sides are even.
    assert width <= 124 + 2 and height <= 38 + 2


def test_images_of_the_configured_shape_are_not_enlarged_either() -> None:
    small = replace(WIDE, lens=WIDE.lens.resized(320, 180))
    assert choose_working_size(IngestConfig(), [small]) == (320, 180)


def test_a_rig_of_several_shapes_is_as_large_as_its_largest_images() -> None:
    wide = replace(WIDE, lens=WIDE.lens.resized(640, 192))
    portrait = replace(PORTRAIT, lens=PORTRAIT.lens.resized(150, 200))
    width, height = choose_working_size(IngestConfig(), [wide, portrait])
    assert width / height == pytest.approx(16 / 9, rel=0.02)
    assert width * height == pytest.approx(640 * 192, rel=0.02)


def test_one_camera_of_fewer_pixels_does_not_reduce_the_others() -> None:
    large = replace(WIDE, lens=WIDE.lens.resized(1280, 720))
    small = replace(WIDE, lens=WIDE.lens.resized(640, 360))
    assert choose_working_size(IngestConfig(), [small, large]) == (1280, 720)


def test_a_chunk_has_the_size_that_was_chosen() -> None:
    log = open_log("synthetic:street?seed=900&frames=8&cameras=2&width=240&height=72&samples=1")
    chunk = ingest(IngestConfig(width_px=160, height_px=90), log, 0)
    assert (chunk.width_px, chunk.height_px) == choose_working_size(
        IngestConfig(width_px=160, height_px=90), log.cameras
    )
    assert chunk.width_px / chunk.height_px == pytest.approx(240 / 72, rel=0.03)
    assert {(v.lens.width_px, v.lens.height_px) for v in chunk.views} == {(chunk.width_px, chunk.height_px)}
    # Square pixels stay square.
    lens = chunk.views[0].lens
    original = log.cameras[0].lens
    assert lens.fx_px / lens.fy_px == pytest.approx(original.fx_px / original.fy_px, rel=0.03)
