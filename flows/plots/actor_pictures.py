"""Pictures of a run's actors: each where it is largest in a recorded view, cut out of the image or of a render."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from flows.plots.artifact_pictures import contact_sheet
from genre_tasks.render import render_views
from genre_tasks.scene.box_projection import project_box
from genre_tasks.scene.chunk import Actor, View
from genre_tasks.scene.image_decoding import decode_pixels, read_image_size
from genre_tasks.scene_edits.chunk_scene import ChunkScene, SceneSource
from storage.codecs.png import to_pixels

Image8 = NDArray[np.uint8]

_TILE_PX = (240, 160)
_COLUMNS = 5
_MARGIN = 0.15
_BACKGROUND = 24


@dataclass(frozen=True)
class _BestView:
    chunk: int
    view: View
    low: NDArray[np.int64]
    high: NDArray[np.int64]
    area: int


def draw_actors(source: SceneSource, names: Mapping[str, str], is_recorded: bool) -> Image8 | None:
    """Draws all actors of a run on one sheet, with their names.

    Args:
        source: the scenes of the run.
        names: readable name by track id, in the order of the sheet.
        is_recorded: whether the recorded images show the actors; those of an edited run are rendered.

    Returns:
        sRGB [H, W, 3]; an actor that is in no recorded view is a dark tile. ``None`` for a run without actors.
    """
    best: dict[str, _BestView] = {}
    tiles: dict[str, Image8] = {}
    # One chunk after the other: only the latest two stay in memory.
    for number in source.chunk_numbers:
        chunk_scene = source.load(number)
        for actor in chunk_scene.chunk.actors:
            found = _find_best_view(actor, number, chunk_scene)
            if found is not None and (actor.track_id not in best or found.area > best[actor.track_id].area):
                best[actor.track_id] = found
                tiles[actor.track_id] = _cut_tile(chunk_scene, found, is_recorded)
    blank = np.full((_TILE_PX[1], _TILE_PX[0], 3), _BACKGROUND, np.uint8)
    return contact_sheet([_write_name(tiles.get(t, blank), name) for t, name in names.items()], _COLUMNS)


def _find_best_view(actor: Actor, number: int, chunk_scene: ChunkScene) -> _BestView | None:
    best: _BestView | None = None
    for view in chunk_scene.chunk.views:
        low, high = project_box(actor, view)
        width, height = high - low
        # One that the image's edge cuts off counts half.
        is_cut = bool((low <= 0).any() or high[0] >= view.lens.width_px or high[1] >= view.lens.height_px)
        area = int(width * height) // (2 if is_cut else 1)
        if area > (0 if best is None else best.area):
            best = _BestView(number, view, low, high, area)
    return best


def _cut_tile(chunk_scene: ChunkScene, best: _BestView, is_recorded: bool) -> Image8:
    lens = best.view.lens
    if is_recorded:
        width, height = read_image_size(best.view.image)
        pixels = decode_pixels(best.view.image, width, height)
    else:
        with torch.no_grad():
            color = render_views(chunk_scene.scene, [best.view]).color[0]
        pixels = to_pixels(color)
    scale = pixels.shape[1] / lens.width_px
    size = (best.high - best.low) * (1 + 2 * _MARGIN) * scale
    # Widened to the tile's shape, so that nothing is stretched.
    zoom = max(size[0] / _TILE_PX[0], size[1] / _TILE_PX[1], 1e-3)
    half = np.array(_TILE_PX) * zoom / 2
    middle = (best.low + best.high) / 2 * scale
    box = (*(middle - half), *(middle + half))
    # What is outside of the image is black.
    tile = Image.fromarray(pixels).transform(
        _TILE_PX, Image.Transform.EXTENT, tuple(float(v) for v in box), Image.Resampling.BILINEAR
    )
    return np.asarray(tile, np.uint8)


def _write_name(tile: Image8, name: str) -> Image8:
    image = Image.fromarray(tile)
    draw = ImageDraw.Draw(image)
    box = draw.textbbox((4, 2), name)
    draw.rectangle((0, 0, box[2] + 4, box[3] + 3), fill=(0, 0, 0))
    draw.text((4, 2), name, fill=(255, 255, 255))
    return np.asarray(image, np.uint8)
