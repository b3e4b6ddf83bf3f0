"""Pictures of a run's actors: each as the scene shows it, where it is largest in a recorded view."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from flows.plots.artifact_pictures import contact_sheet
from genre_tasks.render import render_views
from genre_tasks.scene.box_projection import project_box
from genre_tasks.scene.chunk import Actor, View
from genre_tasks.scene_edits.chunk_scene import ChunkScene, SceneSource

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


def draw_actors(source: SceneSource, names: Mapping[str, str]) -> Image8 | None:
    """Draws all actors of a run on one sheet, with their names.

    Args:
        source: the scenes of the run.
        names: readable name by track id, in the order of the sheet.

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
                tiles[actor.track_id] = _render_tile(chunk_scene, found)
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


def _render_tile(chunk_scene: ChunkScene, best: _BestView) -> Image8:
    # The view's camera with a longer lens, so that far actors are rendered and not magnified pixels.
    size = (best.high - best.low) * (1 + 2 * _MARGIN)
    scale = float(min(_TILE_PX[0] / max(size[0], 1), _TILE_PX[1] / max(size[1], 1)))
    middle = (best.low + best.high) / 2
    lens = best.view.lens
    zoomed = replace(
        lens,
        fx_px=lens.fx_px * scale,
        fy_px=lens.fy_px * scale,
        cx_px=(lens.cx_px - middle[0]) * scale + _TILE_PX[0] / 2,
        cy_px=(lens.cy_px - middle[1]) * scale + _TILE_PX[1] / 2,
        width_px=_TILE_PX[0],
        height_px=_TILE_PX[1],
    )
    with torch.no_grad():
        image = render_views(chunk_scene.scene, [replace(best.view, lens=zoomed, shutter=None, blur=None)]).color[0]
    return np.asarray((image.clamp(0, 1) * 255).round().byte().numpy(), np.uint8)


def _write_name(tile: Image8, name: str) -> Image8:
    image = Image.fromarray(tile)
    draw = ImageDraw.Draw(image)
    box = draw.textbbox((4, 2), name)
    draw.rectangle((0, 0, box[2] + 4, box[3] + 3), fill=(0, 0, 0))
    draw.text((4, 2), name, fill=(255, 255, 255))
    return np.asarray(image, np.uint8)
