"""``genre render``: pictures and films of a finished run's scene, on and beside the path."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flows.cli.options import RunArgument, RunChunkOption, SceneStageOption, StoreOption
from flows.cli.parsing import parse_path
from flows.defaults import DEFAULT_STORE

if TYPE_CHECKING:
    from genre_tasks.render import Render
    from genre_tasks.scene.chunk import Chunk
    from genre_tasks.scene.graph import SceneGraph
    from genre_tasks.scene.novel_views import NovelView

_MAX_SHIFT_M = 1000.0
"""Farther beside the path no log has recorded anything."""


def render(
    run: RunArgument,
    out: Annotated[
        Path,
        typer.Option(
            parser=parse_path,
            metavar="PATH",
            help="The file to write: x.mp4 for a film of all frames, x.png for one frame, or x.exr for one frame with "
            "opacity and depth. An existing file is replaced.",
        ),
    ],
    stage: SceneStageOption = None,
    shift: Annotated[
        float, typer.Option(help="How many metres to the left of the path; negative is to the right.")
    ] = 0.0,
    camera: Annotated[str | None, typer.Option(help="A camera of the log. The first one if not given.")] = None,
    chunk: RunChunkOption = None,
    frame: Annotated[
        int | None, typer.Option(help="The frame of the log, for .png and .exr. The middle one if not given.")
    ] = None,
    store: StoreOption = DEFAULT_STORE,
) -> None:
    """Render an image or a film of a finished run's scene.

    The views are the recorded ones, or the recorded ones shifted to the side. A film plays as fast as the log was
    recorded: over a pause the image stands still, for 3 seconds at most.

    Example:

    \b
        genre render 4b1c --shift 3 --camera front_camera --out beside.mp4
    """
    from flows.cli.existing_store import open_existing_store
    from flows.cli.output_paths import check_output_file
    from flows.cli.parsing import check_number
    from flows.reconstruction.stored_values import find_last_stage, read_stage_scene, read_stage_value
    from genre_tasks.effects.apply_plan import apply_plan
    from genre_tasks.errors import ConfigError, InputError

    # Checked first, because reading a scene takes seconds.
    check_output_file(out, "--out", (".mp4", ".png", ".exr"))
    is_film = out.suffix.lower() == ".mp4"
    if is_film and frame is not None:
        remedy = "Give --out x.png for that frame alone, or leave out --frame."
        raise ConfigError(f"--frame {frame} is for one image, and a film has all frames", remedy=remedy)
    check_number(shift, "--shift", -_MAX_SHIFT_M, _MAX_SHIFT_M)
    open_existing_store(store)
    number, ingested = read_stage_value(store, run, chunk, "ingest")
    # Scenes are fitted to refined poses and straight lenses, where the plan has any.
    planned = apply_plan(ingested, read_stage_value(store, run, number, "effects")[1])
    stage = find_last_stage(store, run, number) if stage is None else stage
    scene = read_stage_scene(store, run, number, stage)
    frames = list(ingested.frames) if is_film else [_select_frame(ingested, frame)]
    camera = ingested.camera_names[0] if camera is None else camera
    if camera not in ingested.camera_names:
        raise InputError(
            f"the chunk has no camera '{camera}'", remedy=f"It has {', '.join(ingested.camera_names)}.", chunk=number
        )
    views = _place_views(planned, camera, frames, shift)
    _write_images(out, _render(scene, views), ingested, [view.frame for view in views])
    count = "1 frame" if len(frames) == 1 else f"{len(frames)} frames"
    typer.echo(f"wrote {out}: {count} of {camera}, {shift:+g} m, chunk {number}, after {stage}")


def _select_frame(chunk: Chunk, frame: int | None) -> int:
    from genre_tasks.errors import InputError

    selected = chunk.frames[len(chunk.frames) // 2] if frame is None else frame
    if selected not in chunk.frames:
        raise InputError(
            f"the chunk has no frame {selected}",
            remedy=f"It has {chunk.frames[0]} to {chunk.frames[-1]}.",
            frame=selected,
        )
    return selected


def _place_views(chunk: Chunk, camera: str, frames: list[int], shift_m: float) -> list[NovelView]:
    from genre_tasks.errors import InputError
    from genre_tasks.scene.novel_poses import place_novel_views

    views = [view for view in place_novel_views(chunk, (shift_m,), frames=frames) if view.camera == camera]
    if not views:
        raise InputError(
            "the log has no image of this camera at that frame", remedy="Choose another --frame.", camera=camera
        )
    return views


def _render(scene: SceneGraph, views: list[NovelView]) -> Render:
    import torch

    from genre_tasks.render import render_views

    # Without gradients the renderer keeps nothing for a backward pass, which takes memory.
    with torch.no_grad():
        return render_views(scene, views)


def _write_images(path: Path, images: Render, chunk: Chunk, frames: list[int]) -> None:
    from genre_tasks.atomic_path import atomic_path

    path.parent.mkdir(parents=True, exist_ok=True)
    # A film takes a while to encode: until it is complete, an earlier file of that name stays.
    with atomic_path(path) as part:
        if path.suffix.lower() == ".exr":
            _write_exr(part, images)
        elif path.suffix.lower() == ".png":
            _write_png(part, images)
        else:
            _write_film(part, images, chunk, frames)


def _write_exr(path: Path, images: Render) -> None:
    from storage.codecs.exr import write_exr

    write_exr(path, images.color[0].numpy(), images.alpha[0].numpy(), images.expected_depth()[0].numpy())


def _write_png(path: Path, images: Render) -> None:
    import imageio.v3 as imageio

    from storage.codecs.png import to_pixels

    # Named here, as the library looks for suffixes in lower case alone.
    imageio.imwrite(path, to_pixels(images.color)[0], extension=".png")


def _write_film(path: Path, images: Render, chunk: Chunk, frames: list[int]) -> None:
    from flows.simulation.film import FilmWriter, count_repeats
    from genre_tasks.ego_paths.recorded_path import list_image_times, measure_frame_s, measure_frame_times
    from storage.codecs.png import to_pixels

    pixels = to_pixels(images.color)
    frame_s = measure_frame_s([chunk])
    repeats = count_repeats(measure_frame_times(frames, list_image_times(chunk)), frame_s)
    film = FilmWriter(path, pixels.shape[2], pixels.shape[1], 1 / frame_s)
    try:
        for image, count in zip(pixels, repeats, strict=True):
            for _ in range(count):
                film.write(image)
        film.close()
    except BaseException:
        film.abort()
        raise
