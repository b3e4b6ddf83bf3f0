"""A picture of each kind of artifact: contact sheets, a scene seen from above, a plan's bars."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from storage.store import Artifact, Store

Image8 = NDArray[np.uint8]

_TILE_PX = 240
_MAX_TILES = 30
_GAP_PX = 4
_MAP_PX = 900
_BACKGROUND = 24
_POINTS_PER_PIXEL = 1.5
_PLAIN_LOGIT_OPACITY = -2.0
"""Gaussians that are more transparent than this are left out of a scene's map: they would hide what is below them."""


def contact_sheet(images: Sequence[Image8], columns: int) -> Image8 | None:
    """Arranges images row by row, each scaled to the width of one tile.

    Args:
        images: [H, W, 3] sRGB each, of any sizes.
        columns: how many images a row has.

    Returns:
        One image [H, W, 3], or ``None`` without images.

    >>> contact_sheet([np.zeros((90, 160, 3), np.uint8)] * 3, columns=2).shape
    (274, 484, 3)
    """
    tiles = [make_thumbnail(image) for image in images]
    if not tiles:
        return None
    rows = -(-len(tiles) // columns)
    step_y = max(tile.shape[0] for tile in tiles) + _GAP_PX
    step_x = _TILE_PX + _GAP_PX
    width = min(columns, len(tiles)) * step_x - _GAP_PX
    sheet = np.full((rows * step_y - _GAP_PX, width, 3), _BACKGROUND, np.uint8)
    for position, tile in enumerate(tiles):
        y = position // columns * step_y
        x = position % columns * step_x
        sheet[y : y + tile.shape[0], x : x + _TILE_PX] = tile
    return sheet


def make_thumbnail(image: Image8) -> Image8:
    """Scales an image to the width of a tile and keeps its shape.

    Args:
        image: [H, W, 3] sRGB.

    Returns:
        [h, 240, 3] sRGB.

    >>> make_thumbnail(np.zeros((180, 320, 3), np.uint8)).shape
    (135, 240, 3)
    """
    from PIL import Image

    # A wide panorama still has a line.
    height = max(1, round(image.shape[0] * _TILE_PX / image.shape[1]))
    return np.array(Image.fromarray(image).resize((_TILE_PX, height), Image.Resampling.BOX))


def spread_indices(count: int, most: int) -> list[int]:
    """Selects indices that are spread evenly, the first and the last one included.

    Args:
        count: how many there are to select from.
        most: how many to select at most.

    Returns:
        Ascending indices from 0 to ``count - 1``.

    >>> spread_indices(10, 4)
    [0, 3, 6, 9]
    """
    # linspace from 0 to -1 would give a negative index.
    if not count:
        return []
    return sorted(set(np.linspace(0, count - 1, min(count, most)).round().astype(int).tolist()))


def to_uint8(color: NDArray[np.float32]) -> Image8:
    """Converts display-referred colours to bytes.

    Args:
        color: any shape; values outside [0, 1] are clipped.

    Returns:
        The same shape, 0 to 255.

    >>> to_uint8(np.array([-0.5, 0.5, 1.0], np.float32))
    array([  0, 128, 255], dtype=uint8)
    """
    return (np.clip(color, 0, 1) * 255 + 0.5).astype(np.uint8)


def draw_from_above(
    positions: NDArray[np.float32],  # [N, 3] metres, z up
    colors: NDArray[np.float32],  # [N, 3] sRGB
) -> Image8 | None:
    """Draws points as a map, x to the right and y up, the highest point in front.

    A pixel is at least so large that it holds 1.5 points on average, so that few points still make surfaces.

    Args:
        positions: [N, 3] metres, z up. The farthest 1 % to each side are cut off.
        colors: [N, 3] sRGB in [0, 1].

    Returns:
        An image [H, W, 3], or ``None`` without points.
    """
    if not len(positions):
        return None
    # A few points of the sky or far outliers would shrink the street to a dot.
    low, high = np.percentile(positions[:, :2], [1, 99], axis=0)
    extent = np.maximum(high - low, 1.0)
    pixels_per_m = min(_MAP_PX / extent.max(), float(np.sqrt(len(positions) / _POINTS_PER_PIXEL / extent.prod())))
    width, height = (int(v) for v in np.floor(extent * pixels_per_m) + 1)
    # Later points overwrite earlier ones, so the highest are drawn last.
    order = np.argsort(positions[:, 2], kind="stable")
    pixel = np.floor((positions[order, :2] - low) * pixels_per_m).astype(int)
    inside = ((pixel >= 0) & (pixel < [width, height])).all(1)
    image = np.full((height, width, 3), _BACKGROUND, np.uint8)
    image[height - 1 - pixel[inside, 1], pixel[inside, 0]] = to_uint8(colors[order][inside])
    # Few points make large pixels; they are enlarged whole, as blurring would mix colours of different points.
    enlarge = max(1, _MAP_PX // max(height, width))
    return image.repeat(enlarge, 0).repeat(enlarge, 1)


def draw_artifact(store: Store, artifact: Artifact) -> NDArray[np.uint8] | None:
    """Draws one picture that shows an artifact, after its files are verified.

    Args:
        store: the store that holds the artifact.
        artifact: any kind.

    Returns:
        An sRGB image [H, W, 3], or ``None`` where there is nothing to show.

    Raises:
        ArtifactCorruptError: a file of the artifact is missing or damaged.
    """
    # A picture of a damaged artifact would show the damage as if it were the result.
    store.verify(artifact)
    draw = _DRAWING_FUNCTIONS.get(artifact.manifest.kind)
    return None if draw is None else draw(store.fetch(artifact))


def _draw_chunk(folder: Path) -> Image8 | None:
    from genre_tasks.scene.image_decoding import decode_pixels, read_image_size
    from storage.codecs.chunk import read

    chunk = read(folder)
    views = chunk.views_with_role("source")
    images = []
    for index in spread_indices(len(views), _MAX_TILES):
        data = views[index].image
        width, height = read_image_size(data)
        images.append(decode_pixels(data, _TILE_PX, max(1, round(height * _TILE_PX / width))))
    return contact_sheet(images, max(1, len(chunk.camera_names)))


def _draw_reconstruction(folder: Path) -> Image8 | None:
    from genre_tasks.scene.graph import DISTANT
    from storage.codecs.reconstruction import read

    scene = read(folder).scene
    # Actors are drawn in the middle of their time, when most of them are there.
    frames = sorted({int(frame) for actor in scene.actors for frame in actor.frames})
    gaussians = scene.gaussians_at(frames[len(frames) // 2] if frames else 0)
    shown = (scene.nodes != DISTANT) & (gaussians.logit_opacities > _PLAIN_LOGIT_OPACITY)
    return draw_from_above(gaussians.means[shown].numpy(), gaussians.colors[shown].numpy())


def _draw_novel_views(folder: Path) -> Image8 | None:
    """Each render beside the map of its LiDAR points."""
    from storage.codecs.novel_views import read_image, read_view_table

    _, files, shape = read_view_table(folder)
    images = []
    for index in spread_indices(len(files), _MAX_TILES // 2):
        layers = read_image(files[index], shape)
        images += [to_uint8(layers[""][0]), to_uint8(layers["lidar."][0])]
    return contact_sheet(images, 6)


def _draw_fixed_views(folder: Path) -> Image8 | None:
    from storage.codecs.fixed_views import read_image
    from storage.codecs.novel_views import read_view_table

    _, files, shape = read_view_table(folder)
    images = [to_uint8(read_image(files[index], shape)) for index in spread_indices(len(files), _MAX_TILES)]
    return contact_sheet(images, 6)


def _draw_pairs(folder: Path) -> Image8 | None:
    """Each render beside the truth."""
    from storage.codecs.pairs import read

    pairs = read(folder)
    images = []
    for index in spread_indices(len(pairs), _MAX_TILES // 2):
        images += [pairs.views.color[index], pairs.truth[index]]
    return contact_sheet([image.permute(1, 2, 0).numpy() for image in images], 6)


def _draw_evaluation(folder: Path) -> Image8 | None:
    from storage.codecs.evaluation import read

    pictures = read(folder).pictures
    # Sorted by name, a view and its truth stand side by side.
    return contact_sheet([pictures[name] for name in sorted(pictures)], 4)


def _draw_effects(folder: Path) -> Image8 | None:
    from flows.plots.effects_plot import plot_effects_plan
    from storage.codecs.effects import read

    return plot_effects_plan(read(folder))


def _draw_rollout_scores(folder: Path) -> Image8 | None:
    from flows.plots.rollout_scores_plot import plot_rollout_scores
    from storage.codecs.rollout_scores import read

    return plot_rollout_scores(read(folder))


_DRAWING_FUNCTIONS: dict[str, Callable[[Path], Image8 | None]] = {
    "chunk": _draw_chunk,
    "reconstruction": _draw_reconstruction,
    "novel_views": _draw_novel_views,
    "fixed_views": _draw_fixed_views,
    "pairs": _draw_pairs,
    "evaluation": _draw_evaluation,
    "effects": _draw_effects,
    "rollout_scores": _draw_rollout_scores,
}
"""Kind of artifact → what draws it from its folder."""
