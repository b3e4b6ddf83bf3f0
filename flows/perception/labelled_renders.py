"""Labelled images of a chunk: a scene rendered next to the recorded path, and the recorded images themselves."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from genre_tasks.errors import InputError
from genre_tasks.progress import Progress, silent

if TYPE_CHECKING:
    from genre_tasks.config import IngestConfig
    from genre_tasks.logs.types import DrivingLog, Lens
    from genre_tasks.render import RenderSettings
    from genre_tasks.scene.chunk import Chunk, View
    from genre_tasks.scene.graph import SceneGraph
    from genre_tasks.scene.novel_views import NovelView
    from genre_tasks.training_sets.label_boxes import LogLabeller
    from genre_tasks.training_sets.labelled_images import LabelledImage


def render_labelled_images(
    log: DrivingLog,
    chunk: Chunk,
    scene: SceneGraph,
    shifts_m: Sequence[float],
    frames: Sequence[int] | None = None,
    every: int = 1,
    recorded: bool = True,
    progress: Progress = silent,
    settings: RenderSettings | None = None,
    ingest: IngestConfig | None = None,
) -> Iterator[LabelledImage]:
    """Renders a scene at recorded poses moved to the side, labels the renders, and labels the recorded images too.

    The scene's depth tells how much of each box nearer surfaces hide, in recorded images too. A pixel that the scene
    covers by less than half hides nothing. Recorded images keep the lens of the log, renders have the lens that the
    scene was fitted with.

    Args:
        log: with annotations; the chunk is of it.
        chunk: with its plan's effects applied.
        scene: to render.
        shifts_m: metres to the left; 0 renders the recorded path.
        frames: log frames of the chunk; ``None``: every n-th one.
        every: n, from 1.
        recorded: whether the recorded images are among the results.
        progress: called with the images done and their total.
        settings: of the renderer; ``None``: its own.
        ingest: that the chunk was made with; ``None``: the default. Renders have no box of a moving object that it left
            out.

    Yields:
        LabelledImage: frame by frame; within a frame recorded images first, then renders in the order of ``shifts_m``,
        each in the order of the rig.

    Raises:
        InputError: the log has no annotations or is not the chunk's, the chunk lacks one of the frames, or an image
            cannot be read.
        NonFiniteError: an image is not finite.
    """
    from genre_tasks.config import IngestConfig
    from genre_tasks.scene.novel_poses import place_novel_views
    from genre_tasks.training_sets.absent_objects import find_absent_objects
    from genre_tasks.training_sets.label_boxes import labeller_of

    chosen = _choose_frames(chunk, frames, every)
    if log.name != chunk.log:
        raise InputError(f"the chunk is of another log, {chunk.log}", remedy="Give its own log.", log=log.uri)
    labeller = labeller_of(log)
    absent = find_absent_objects(log.tracks(), chunk, ingest or IngestConfig())
    lenses = {camera.name: camera.lens.resized(chunk.width_px, chunk.height_px) for camera in log.cameras}
    total = sum(view.frame in chosen for view in chunk.views) * (len(shifts_m) + recorded)
    done = 0
    for frame in chosen:
        groups: list[Sequence[View | NovelView]] = []
        if recorded:
            groups.append([replace(v, lens=_lens_of(v, lenses)) for v in chunk.views if v.frame == frame])
        groups += [place_novel_views(chunk, (shift_m,), frames=(frame,)) for shift_m in shifts_m]
        for views in groups:
            for image in _label_renders(labeller, chunk, scene, views, settings, absent):
                progress(done, total, f"frame {frame}")
                yield image
                done += 1


def _choose_frames(chunk: Chunk, frames: Sequence[int] | None, every: int) -> list[int]:
    if every < 1:
        raise ValueError(f"expected every n-th frame with n from 1, got {every}")
    if frames is None:
        return list(chunk.frames[::every])
    unknown = sorted(set(frames) - set(chunk.frames))
    if unknown:
        remedy = f"It has {chunk.frames[0]} to {chunk.frames[-1]}."
        raise InputError(
            f"the chunk has no frame {unknown[0]}", remedy=remedy, log=chunk.log, chunk=chunk.index, frame=unknown[0]
        )
    return sorted(frames)


def _lens_of(view: View, lenses: dict[str, Lens]) -> Lens:
    # A plan may take lenses to be free of distortion; recorded images have what their cameras had.
    return lenses.get(view.camera, view.lens)


def _label_renders(
    labeller: LogLabeller,
    chunk: Chunk,
    scene: SceneGraph,
    views: Sequence[View | NovelView],
    settings: RenderSettings | None,
    absent: frozenset[str],
) -> Iterator[LabelledImage]:
    """The images of one frame and shift: of recorded views the recorded ones, of others the renders."""
    import torch

    from genre_tasks.checks import check_finite
    from genre_tasks.render import RenderSettings, render_views
    from genre_tasks.rollout.instance_masks import MIN_ALPHA
    from genre_tasks.scene.novel_views import NovelView
    from storage.codecs.png import to_pixels

    # A frame may lack the images of all cameras.
    if not views:
        return
    with torch.no_grad():
        render = render_views(scene, views, settings or RenderSettings())
    # A veil of faint splats would otherwise hide what shows through it.
    depths = torch.where(render.alpha >= MIN_ALPHA, render.expected_depth(), 0.0)
    for name, values in (("color", render.color), ("depth", depths)):
        check_finite(values, name, "augment", log=chunk.log, chunk=chunk.index)
    for view, color, depth in zip(views, render.color, depths.cpu().numpy(), strict=True):
        if isinstance(view, NovelView):
            pixels = to_pixels(color)
            yield labeller.label_view(
                chunk, view, pixels, shift_m=view.shift_m, rendered=True, depth=depth, absent=absent
            )
        else:
            yield labeller.label_recorded_image(chunk, view, depth)
