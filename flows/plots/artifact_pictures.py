"""A picture of each kind of artifact: contact sheets, a scene seen from above, a plan's bars."""

from __future__ import annotations

import io
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


def contact_sheet(images: Sequence[Image8], columns: int) -> Image8 | None:
    """Images [H, W, 3] side by side, row by row, each scaled to one tile width; ``None`` without images."""
    tiles = [thumbnail(image) for image in images]
    if not tiles:
        return None
    height = max(t.shape[0] for t in tiles)
    rows = -(-len(tiles) // columns)
    step_y, step_x = height + _GAP_PX, _TILE_PX + _GAP_PX
    sheet = np.full((rows * step_y - _GAP_PX, min(columns, len(tiles)) * step_x - _GAP_PX, 3), 24, np.uint8)
    for k, tile in enumerate(tiles):
        y, x = k // columns * step_y, k % columns * step_x
        sheet[y : y + tile.shape[0], x : x + _TILE_PX] = tile
    return sheet


def thumbnail(image: Image8) -> Image8:
    """``image`` scaled to the width of a tile."""
    from PIL import Image

    height = max(1, round(image.shape[0] * _TILE_PX / image.shape[1]))
    return np.array(Image.fromarray(image).resize((_TILE_PX, height), Image.Resampling.BOX))


def evenly(count: int, most: int) -> list[int]:
    """At most ``most`` indices below ``count``, evenly spread."""
    return sorted(set(np.linspace(0, count - 1, min(count, most)).round().astype(int).tolist())) if count else []


def as_uint8(color: NDArray[np.float32]) -> Image8:
    """Display-referred [0, 1] → uint8, clipped."""
    return (np.clip(color, 0, 1) * 255 + 0.5).astype(np.uint8)


def from_above(
    positions: NDArray[np.float32],  # [N, 3] metres, z up
    colors: NDArray[np.float32],  # [N, 3] sRGB
) -> Image8 | None:
    """Points seen from above (x to the right, y up), the highest in front; the farthest 1 % are cut off.

    A pixel is at least so large that it holds 1.5 points on average, so that few points still make surfaces.
    """
    if not len(positions):
        return None
    low, high = np.percentile(positions[:, :2], [1, 99], axis=0)
    extent = np.maximum(high - low, 1.0)
    scale = min(_MAP_PX / extent.max(), float(np.sqrt(len(positions) / 1.5 / extent.prod())))
    width, height = (int(v) for v in np.floor(extent * scale) + 1)
    order = np.argsort(positions[:, 2], kind="stable")
    pixel = np.floor((positions[order, :2] - low) * scale).astype(int)
    inside = ((pixel >= 0) & (pixel < [width, height])).all(1)
    image = np.full((height, width, 3), 24, np.uint8)
    image[height - 1 - pixel[inside, 1], pixel[inside, 0]] = as_uint8(colors[order][inside])
    enlarge = max(1, _MAP_PX // max(height, width))
    return image.repeat(enlarge, 0).repeat(enlarge, 1)


def _chunk(folder: Path) -> Image8 | None:
    from PIL import Image

    from storage.codecs.chunk import read

    value = read(folder)
    views = value.of_role("source")
    images = []
    for view in (views[i] for i in evenly(len(views), _MAX_TILES)):
        with Image.open(io.BytesIO(view.image)) as image:
            image.draft("RGB", (2 * _TILE_PX, 2 * _TILE_PX))
            images.append(np.array(image.convert("RGB")))
    return contact_sheet(images, max(1, len(value.camera_names)))


def _reconstruction(folder: Path) -> Image8 | None:
    from genre_tasks.scene.graph import DISTANT
    from storage.codecs.reconstruction import read

    scene = read(folder).scene
    frames = sorted({int(f) for actor in scene.actors for f in actor.frames})
    g = scene.at(frames[len(frames) // 2] if frames else 0)
    shown = (scene.nodes != DISTANT) & (g.logit_opacities > -2)
    return from_above(g.means[shown].numpy(), g.colors[shown].numpy())


def _novel_views(folder: Path) -> Image8 | None:
    from storage.codecs.novel_views import read_image, read_views

    _, files, shape = read_views(folder)
    images = []
    for i in evenly(len(files), _MAX_TILES // 2):
        layers = read_image(files[i], shape)
        images += [as_uint8(layers[""][0]), as_uint8(layers["lidar."][0])]
    return contact_sheet(images, 6)


def _fixed_views(folder: Path) -> Image8 | None:
    from storage.codecs.fixed_views import read_image
    from storage.codecs.novel_views import read_views

    _, files, shape = read_views(folder)
    return contact_sheet([as_uint8(read_image(files[i], shape)) for i in evenly(len(files), _MAX_TILES)], 6)


def _pairs(folder: Path) -> Image8 | None:
    """Render beside truth."""
    from storage.codecs.pairs import read

    pairs = read(folder)
    tensors = [t[i] for i in evenly(len(pairs), _MAX_TILES // 2) for t in (pairs.views.color, pairs.truth)]
    return contact_sheet([t.permute(1, 2, 0).numpy() for t in tensors], 6)


def _evaluation(folder: Path) -> Image8 | None:
    from storage.codecs.evaluation import read

    pictures = read(folder).pictures
    return contact_sheet([pictures[name] for name in sorted(pictures)], 4)


def _effects(folder: Path) -> Image8 | None:
    from flows.plots.effects_plot import drawn
    from storage.codecs.effects import read

    return drawn(read(folder))


PICTURES: dict[str, Callable[[Path], Image8 | None]] = {
    "chunk": _chunk,
    "reconstruction": _reconstruction,
    "novel_views": _novel_views,
    "fixed_views": _fixed_views,
    "pairs": _pairs,
    "evaluation": _evaluation,
    "effects": _effects,
}
"""Kind of artifact → what draws it from its folder."""


def draw_artifact(store: Store, artifact: Artifact) -> NDArray[np.uint8] | None:
    """One sRGB image [H, W, 3] that shows the artifact, or ``None`` where there is nothing to show; verified first."""
    store.verify(artifact)
    draw = PICTURES.get(artifact.manifest.kind)
    return None if draw is None else draw(artifact.path)
