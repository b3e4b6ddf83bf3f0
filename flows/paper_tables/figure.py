"""What tables 1 and 3 compare as a picture: a row for each method, a column for each shift, the truth where known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from flows.paper_tables.measure import Produce, run_stages
from flows.paper_tables.request import Planned
from flows.pipeline.definition import reconstructing_until
from flows.pipeline.log_cache import opened_log
from flows.pipeline.stage_runner import value_of
from genre_tasks.errors import ConfigError, InputError

if TYPE_CHECKING:
    from torch import Tensor

    from genre_tasks.scene.chunk import Chunk
    from genre_tasks.scene.novel_views import NovelView

Kind = Literal["recon", "fixers"]
TABLE: Mapping[str, int] = {"recon": 1, "fixers": 3}
"""The table whose methods a kind shows."""
SHIFTS_M: Mapping[str, tuple[float, ...]] = {"recon": (0.0, 1.0, 3.0, 5.0), "fixers": (1.0, 2.0, 3.0)}
"""To the left of the path."""

Pixels = NDArray[np.uint8]  # [H, W, 3] sRGB


@dataclass(frozen=True)
class Strip:
    """A row of the picture: its label and an image for each shift."""

    label: str
    images: tuple[Pixels, ...]


def kind_of(name: str) -> Kind:
    """Raises ``ConfigError`` for a figure that there is not."""
    for kind in get_args(Kind):
        if name == kind:
            return kind  # type: ignore[no-any-return]  # one of the literals
    raise ConfigError(f"there is no figure {name!r}", remedy=f"Choose from {', '.join(TABLE)}.")


def strips(
    kind: Kind, plan: Planned, produce: Produce, camera: str | None = None, frame: int | None = None
) -> list[Strip]:
    """Of the request's first chunk: methods in the order of their table, what fixers were given, the truth.

    ``camera``: the first front one without it; ``frame`` of the log, a source frame: the middle one without it.
    Methods without weights are not among them. Raises ``InputError`` for a camera or frame that the chunk has not.
    """
    from genre_tasks.metrics.scoring import true_pixels

    place = plan.places[0]
    out: list[Strip] = []
    views: list[NovelView] = []
    for row in plan.layout.rows:
        if row.label in plan.missing:
            continue
        job = plan.basis.job(plan.layout, row.method, place)
        refs = run_stages(reconstructing_until(row.method.end), job, produce)
        chunk = value_of(job, refs["ingest"])
        views = _views(chunk, SHIFTS_M[kind], camera, frame)
        if kind == "recon":
            out.append(Strip(row.label, _rendered(value_of(job, refs[row.method.end]).scene, views)))
            continue
        novel, fixed = (value_of(job, refs[name]) for name in ("novel_views", "fnet"))
        at = {(v.camera, v.frame, v.shift_m): i for i, v in enumerate(novel.views)}
        chosen = [at[v.camera, v.frame, v.shift_m] for v in views]
        if not out:
            out.append(Strip("what they are given", _pixels(novel.color[chosen])))
        out.append(Strip(row.label, _pixels(fixed.color[chosen])))
    truth = opened_log(place.log).truth
    if truth is not None and views:
        out.append(Strip("the truth", tuple(true_pixels(chunk, truth, v) for v in views)))
    return out


def drawn(kind: Kind, found: Sequence[Strip], title: str) -> Pixels:
    """[H, W, 3]: a row for each strip."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    height, width = found[0].images[0].shape[:2]
    columns, dpi = len(SHIFTS_M[kind]), 100
    size = ((columns * width + 40) / dpi, (len(found) * (height + 24) + 40) / dpi)
    figure = Figure(figsize=size, dpi=dpi, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=9)
    panels = figure.subplots(len(found), columns, squeeze=False)
    for line, strip in zip(panels, found, strict=True):
        for axes, image, shift in zip(line, strip.images, SHIFTS_M[kind], strict=True):
            axes.imshow(image, interpolation="nearest")
            axes.set_axis_off()
            axes.set_title(f"{strip.label}, {shift:g} m", fontsize=8, pad=2)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _views(chunk: Chunk, shifts_m: Sequence[float], camera: str | None, frame: int | None) -> list[NovelView]:
    from genre_tasks.scene.novel_poses import novel_view_poses

    frames = sorted({v.frame for v in chunk.of_role("source")})
    name = camera or min(chunk.camera_names, key=lambda c: ("front" not in c, len(c)))
    chosen = frames[len(frames) // 2] if frame is None else frame
    if name not in chunk.camera_names or chosen not in frames:
        raise InputError(
            f"the chunk has no source image of camera {name} at frame {chosen}",
            remedy=f"Cameras: {', '.join(chunk.camera_names)}; frames: {', '.join(map(str, frames))}.",
            log=chunk.log,
            chunk=chunk.index,
        )
    views = [v for v in novel_view_poses(chunk, shifts_m, [chosen]) if v.camera == name]
    if not views:
        raise InputError(
            "this image is missing in the log", remedy="Choose another --frame.", camera=name, frame=chosen
        )
    return views


def _rendered(scene: object, views: Sequence[NovelView]) -> tuple[Pixels, ...]:
    import torch

    from genre_tasks.render import render_views

    with torch.no_grad():
        return _pixels(render_views(scene, views).color)  # type: ignore[arg-type]  # read back from the store


def _pixels(color: Tensor) -> tuple[Pixels, ...]:
    return tuple((color.clamp(0, 1) * 255).round().byte().cpu().numpy())
