"""What tables 1 and 3 compare as a picture: a row for each method, a column for each shift, the truth where known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Literal, get_args

from flows.experiments.stages import StageRunner, run_stages
from flows.paper_tables.comparison_strips import ComparisonStrip, Pixels
from flows.paper_tables.request import CheckedRequest
from flows.perception.camera_names import select_front_camera
from flows.pipeline.definition import stages_until
from flows.pipeline.log_cache import cached_log
from flows.pipeline.stage_runner import read_artifact
from genre_tasks.errors import ConfigError, InputError
from storage.codecs.png import to_pixels

if TYPE_CHECKING:
    from genre_tasks.scene.chunk import Chunk
    from genre_tasks.scene.novel_views import NovelView

Kind = Literal["recon", "fixers", "swerve", "manipulation", "agreement"]
TABLE: Mapping[str, int] = {"recon": 1, "fixers": 3, "swerve": 6, "manipulation": 6, "agreement": 7}
"""The table whose methods a kind of figure shows."""
SHIFTS_M: Mapping[str, tuple[float, ...]] = {"recon": (0.0, 1.0, 3.0, 5.0), "fixers": (1.0, 2.0, 3.0)}
"""Metres to the left of the path, a column each; of the kinds that compare shifts."""


def parse_kind(name: str) -> Kind:
    """Checks the name of a kind of figure.

    Raises:
        ConfigError: there is no such figure.

    >>> parse_kind("recon")
    'recon'
    """
    for kind in get_args(Kind):
        if name == kind:
            return kind  # type: ignore[no-any-return]  # one of the literals
    raise ConfigError(f"there is no figure {name!r}", remedy=f"Choose from {', '.join(TABLE)}.")


def comparison_strips(
    kind: Kind, checked: CheckedRequest, runner: StageRunner, camera: str | None = None, frame: int | None = None
) -> list[ComparisonStrip]:
    """Renders or fixes the same views with every method, on the request's first chunk.

    Args:
        kind: which figure, a key of ``SHIFTS_M``.
        checked: the table's rows and chunks; rows that cannot be measured are left out.
        runner: runs one stage.
        camera: name of a camera; the first front one if ``None``.
        frame: a source frame of the log; the middle one if ``None``.

    Returns:
        The methods in the order of their table; before them what fixers get as input, after them the truth where the
        log can tell it.

    Raises:
        ConfigError: the settings leave out novel views that the figure shows.
        InputError: the chunk has no source image of this camera and frame.
    """
    # Found before hours of computing.
    missing = set(SHIFTS_M[kind]) - set(checked.config.novel_views.shifts_m)
    if kind == "fixers" and missing:
        raise ConfigError(
            f"no image is fixed at {', '.join(f'{shift:g}' for shift in sorted(missing))} m, which the figure shows",
            remedy="Leave out the setting of novel_views.shifts_m.",
        )
    strips: list[ComparisonStrip] = []
    captions = tuple(f"{shift:g} m" for shift in SHIFTS_M[kind])
    # Every method has the same ingest, so the last row's chunk and views serve the truth too.
    views: list[NovelView] = []
    # One chunk only: a picture of several would need a row for each method and chunk.
    where = checked.places[0]
    for row in checked.measurable_rows:
        job = checked.basis.job(checked.layout, row.method, where)
        refs = run_stages(stages_until(row.method.end), job, runner)
        chunk = read_artifact(job, refs["ingest"])
        views = _select_views(chunk, SHIFTS_M[kind], camera, frame)
        if kind == "recon":
            scene = read_artifact(job, refs[row.method.end]).scene
            strips.append(ComparisonStrip(row.label, _render(scene, views), captions))
            continue
        novel = read_artifact(job, refs["novel_views"])
        fixed = read_artifact(job, refs["fnet"])
        # Looked up by name, because the fixer's stage may hold more views than the figure shows.
        index = {(v.camera, v.frame, v.shift_m): i for i, v in enumerate(novel.views)}
        chosen = [index[v.camera, v.frame, v.shift_m] for v in views]
        # All fixers get the same renders, so one strip of inputs stands for all.
        if not strips:
            strips.append(ComparisonStrip("what they are given", tuple(to_pixels(novel.color[chosen])), captions))
        strips.append(ComparisonStrip(row.label, tuple(to_pixels(fixed.color[chosen])), captions))
    truth = _true_strip(where.log, chunk, views, captions) if views else None
    return strips if truth is None else [*strips, truth]


def _true_strip(
    log: str, chunk: Chunk, views: Sequence[NovelView], captions: tuple[str, ...]
) -> ComparisonStrip | None:
    from genre_tasks.metrics.scoring import truth_image

    truth = cached_log(log).truth
    if truth is None:
        return None
    return ComparisonStrip("the truth", tuple(truth_image(chunk, truth, v) for v in views), captions)


def _select_views(chunk: Chunk, shifts_m: Sequence[float], camera: str | None, frame: int | None) -> list[NovelView]:
    from genre_tasks.scene.novel_poses import place_novel_views

    # Only source frames: the stage places novel views at these, so others have no fixed image.
    frames = sorted({v.frame for v in chunk.views_with_role("source")})
    name = camera or select_front_camera(chunk.camera_names)
    chosen = frames[len(frames) // 2] if frame is None else frame
    if name not in chunk.camera_names or chosen not in frames:
        raise InputError(
            f"the chunk has no source image of camera {name} at frame {chosen}",
            remedy=f"Cameras: {', '.join(chunk.camera_names)}; frames: {', '.join(map(str, frames))}.",
            log=chunk.log,
            chunk=chunk.index,
        )
    views = [v for v in place_novel_views(chunk, shifts_m, [chosen]) if v.camera == name]
    if not views:
        raise InputError(
            "this image is missing in the log", remedy="Choose another --frame.", camera=name, frame=chosen
        )
    return views


def _render(scene: object, views: Sequence[NovelView]) -> tuple[Pixels, ...]:
    import torch

    from genre_tasks.render import render_views

    # The scene's tensors may ask for gradients, whose buffers a picture does not need.
    with torch.no_grad():
        return tuple(to_pixels(render_views(scene, views).color))  # type: ignore[arg-type]  # read back from the store
