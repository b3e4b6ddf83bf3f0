"""The ego mask where the vehicle stands for a part of the chunk, and where many parts reach an image's lower edge."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy import ndimage

from genre_tasks.config import IngestConfig
from genre_tasks.effects import ego_mask
from genre_tasks.effects.measurements import IMAGE_STEP_M, ChunkMeasurements
from genre_tasks.logs.registry import open_log
from genre_tasks.scene.chunk import Chunk
from genre_tasks.stages.ingest import ingest

# Without a bonnet, and large enough for its road not to stand still while the vehicle drives.
STREET = "synthetic:street?seed=901&cameras=1&width=320&height=180&samples=1"


@cache
def street() -> Chunk:
    return ingest(IngestConfig(width_px=320, height_px=180), open_log(STREET), 0)


def street_at(places: Sequence[int]) -> Chunk:
    """The street's chunk as if the vehicle had been, at each frame, where it was at another frame."""
    chunk = street()
    recorded = {view.frame: view for view in chunk.views}
    places_of_views = [recorded[places[view.frame]] for view in chunk.views]
    views = [
        replace(view, image=place.image, chunk_SE3_camera=place.chunk_SE3_camera)
        for view, place in zip(chunk.views, places_of_views, strict=True)
    ]
    return replace(chunk, views=tuple(views), chunk_SE3_ego=chunk.chunk_SE3_ego[list(places)])


def test_road_before_a_red_light_is_not_the_vehicle() -> None:
    measured = ChunkMeasurements(street_at([14] * 14 + list(range(14, 20))), ())
    measurement = ego_mask.measure(measured)
    assert measurement.value is not None and measurement.value < ego_mask.MIN_MASK_PERCENT
    assert not ego_mask.fit(measured).ego_masks
    positions = [street().views[frame].chunk_SE3_camera[:3, 3] for frame in range(14, 20)]
    assert np.linalg.norm(np.diff(positions, axis=0), axis=1).min() > IMAGE_STEP_M
    expected = [measured.decode_view(street().views[frame]) for frame in range(14, 20)]
    # The first of them is that of the place where the vehicle stood.
    assert np.array_equal(measured.images_over_time["front_camera"], expected)


def test_a_vehicle_that_comes_back_to_a_place_adds_no_image_of_it() -> None:
    forth_and_back = [0, 0, 0, 4, 8, 12, 16, 16, 16, 16, 16, 16, 12, 8, 4, 0, 0, 0, 0, 0]
    images = ChunkMeasurements(street_at(forth_and_back), ()).images_over_time["front_camera"]
    assert len(images) == 5


def test_too_few_places_say_why_nothing_is_compared() -> None:
    measurement = ego_mask.measure(ChunkMeasurements(street_at([0] * 8 + [10] * 8 + [19] * 4), ()))
    assert measurement.value is None
    assert measurement.explanation.startswith("no camera has 4 images taken 0.3 m apart")
    short = replace(street(), views=street().views[:3])
    assert ego_mask.measure(ChunkMeasurements(short, ())).explanation == "no camera has 4 images"


@pytest.mark.parametrize("step_m", [0.15, 1.0])
def test_a_vehicle_that_drives_all_the_time_has_the_same_images_as_ever(step_m: float) -> None:
    views = []
    for view in street().views:
        pose = view.chunk_SE3_camera.copy()
        # Every second image is compared.
        pose[:3, 3] = [0.5 * step_m * view.frame, 0.0, 0.0]
        views.append(replace(view, chunk_SE3_camera=pose))
    measured = ChunkMeasurements(replace(street(), views=tuple(views)), ())
    expected = [measured.decode_view(view) for view in views[::2]]
    assert np.array_equal(measured.images_over_time["front_camera"], expected)


def _find_by_testing_all(
    mask: np.ndarray, levels: np.ndarray, is_vehicle: Callable[[np.ndarray, np.ndarray], bool]
) -> np.ndarray:
    labels, _ = ndimage.label(mask)
    parts = [labels == label for label in np.unique(labels[-1][labels[-1] > 0])]
    parts = [part for part in parts if is_vehicle(part, levels)]
    return max(parts, key=lambda part: int(part.sum()), default=np.zeros(mask.shape, bool))


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("judge", ["_has_edge_around", "_changes_far_less_than_surroundings"])
def test_the_largest_part_is_that_of_testing_all(seed: int, judge: str) -> None:
    g = np.random.default_rng(seed)
    levels = ndimage.gaussian_filter(g.uniform(0, 1, (40, 60)), 1.0 + 0.3 * seed)
    levels = (60 * (levels - levels.min()) / np.ptp(levels)).astype(np.float32)
    mask = levels < np.quantile(levels, 0.4)
    is_vehicle = getattr(ego_mask, judge)
    found = ego_mask._find_largest_part(mask, levels, is_vehicle)
    assert np.array_equal(found, _find_by_testing_all(mask, levels, is_vehicle))


def test_parts_are_judged_from_the_largest_one_and_in_their_windows() -> None:
    mask = np.zeros((60, 400), bool)
    mask[-3:, ::4] = True
    mask[-20:, 202:235] = True
    judged: list[tuple[int, int]] = []

    def judge(part: np.ndarray, levels: np.ndarray) -> bool:
        judged.append((int(part.sum()), part.size))
        return len(judged) == 2

    found = ego_mask._find_largest_part(mask, mask.astype(np.float32), judge)
    assert [count for count, _ in judged] == [660, 3] and max(size for _, size in judged) < 30 * 60
    # Of parts of one size it is the first.
    assert found.sum() == 3 and found[-1, 0]
