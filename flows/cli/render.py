"""``genre render``: pictures and films of a finished run's scene, on and beside the path."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from genre_tasks.scene.chunk import Chunk
    from genre_tasks.scene.graph import SceneGraph


def render(
    run: Annotated[str, typer.Argument(help="A run's name (or its start), as `genre show runs` lists it.")],
    out: Annotated[Path, typer.Option(help="x.mp4 (all frames), x.png or x.exr (one frame).")],
    stage: Annotated[str | None, typer.Option(help="initial, gnet or enet; the run's last without it.")] = None,
    shift: Annotated[float, typer.Option(help="Metres to the left of the path; negative is to the right.")] = 0.0,
    camera: Annotated[str | None, typer.Option(help="A camera of the rig; the first one without it.")] = None,
    chunk: Annotated[int | None, typer.Option(help="A chunk of the run; the first one without it.")] = None,
    frame: Annotated[
        int | None, typer.Option(help="With .png and .exr: a frame of the log; the middle one without it.")
    ] = None,
    store: Annotated[str, typer.Option(help="The run's store.")] = "genre-store",
) -> None:
    """Render a scene of a finished run at the recorded poses or shifted to the side."""
    from flows.reconstruction.run_records import last_stage, stage_scene, stage_value
    from genre_tasks.errors import InputError

    if out.suffix not in (".mp4", ".png", ".exr"):
        raise InputError(f"cannot write '{out.suffix}'", remedy="Use .mp4, .png or .exr.", file=out)
    number, ingested = stage_value(store, run, chunk, "ingest")
    stage = stage or last_stage(store, run, number)
    scene = stage_scene(store, run, number, stage)
    frames = _frames(ingested, frame, every=out.suffix == ".mp4")
    name = camera or ingested.camera_names[0]
    if name not in ingested.camera_names:
        raise InputError(
            f"the chunk has no camera '{name}'", remedy=f"It has {', '.join(ingested.camera_names)}.", chunk=number
        )
    images = _rendered(ingested, scene, name, frames, shift)
    _write(out, images)
    count = f"{len(frames)} frame{'s' * (len(frames) > 1)}"
    typer.echo(f"wrote {out}: {count} of {name}, {shift:+g} m, chunk {number}, after {stage}")


def _frames(chunk: Chunk, frame: int | None, every: bool) -> list[int]:
    from genre_tasks.errors import InputError

    if every:
        return list(chunk.frames)
    chosen = chunk.frames[len(chunk.frames) // 2] if frame is None else frame
    if chosen not in chunk.frames:
        raise InputError(
            f"the chunk has no frame {chosen}", remedy=f"It has {chunk.frames[0]} to {chunk.frames[-1]}.", frame=chosen
        )
    return [chosen]


def _rendered(chunk: Chunk, scene: SceneGraph, camera: str, frames: list[int], shift: float) -> Any:
    import torch

    from genre_tasks.errors import InputError
    from genre_tasks.render import render_views
    from genre_tasks.scene.novel_poses import novel_view_poses

    views = [v for v in novel_view_poses(chunk, (shift,), frames=frames) if v.camera == camera]
    if not views:
        raise InputError(
            "the log has no image of this camera at that frame", remedy="Choose another --frame.", camera=camera
        )
    with torch.no_grad():
        return render_views(scene, views)


def _write(out: Path, images: Any) -> None:
    out.parent.mkdir(parents=True, exist_ok=True)
    partial = out.with_name(f".{out.stem}.{os.getpid()}.partial{out.suffix}")
    try:
        _write_to(partial, images)
        partial.replace(out)
    finally:
        partial.unlink(missing_ok=True)


def _write_to(path: Path, images: Any) -> None:
    if path.suffix == ".exr":
        from storage.codecs.exr import write_exr

        write_exr(path, images.color[0].numpy(), images.alpha[0].numpy(), images.expected_depth()[0].numpy())
        return
    import imageio.v3 as imageio

    pixels: NDArray[np.uint8] = (images.color.clamp(0, 1) * 255).round().byte().numpy()
    if path.suffix == ".png":
        imageio.imwrite(path, pixels[0])
    else:
        even = pixels[:, : pixels.shape[1] // 2 * 2, : pixels.shape[2] // 2 * 2]
        imageio.imwrite(path, even, fps=10, codec="libx264", macro_block_size=2)
