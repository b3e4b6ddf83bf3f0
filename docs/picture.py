"""Draws the README's picture from the store that ``genre bench pipeline`` filled.

python docs/picture.py --store genre-store --out docs/images/beside.jpg

Left: a recorded image. Middle: per-scene 3D Gaussian Splatting, rendered beside the path. Right: GenRe with ``fine``.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.common.run_stages import reconstruct
from benchmarks.pipeline import BENCH, GNET_STAGES, configurations
from flows.pipeline.stage_runner import Job, read_artifact
from genre_tasks.effects.apply_plan import apply_plan
from genre_tasks.render import render_views
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.image_decoding import decode_pixels
from genre_tasks.scene.novel_poses import place_novel_views

SCALE = 1.5
"""Pixels of the picture for each pixel of a render."""
GAP_PX = 6
TITLE_PX = 22


def render_beside(chunk: Chunk, scene: SceneGraph, camera: str, frame: int, shift_m: float) -> NDArray[np.uint8]:
    """Renders one camera of the shifted rig, as an sRGB image [H, W, 3]."""
    views = [v for v in place_novel_views(chunk, (shift_m,), frames=[frame]) if v.camera == camera]
    color = render_views(scene, views).color[0].detach().clamp(0, 1)
    pixels: NDArray[np.uint8] = (color * 255).round().byte().numpy()
    return pixels


def compose(images: list[NDArray[np.uint8]], titles: list[str]) -> Image.Image:
    """Puts images side by side, each under its title."""
    height = round(images[0].shape[0] * SCALE)
    width = round(images[0].shape[1] * SCALE)
    canvas = Image.new("RGB", (len(images) * (width + GAP_PX) - GAP_PX, height + TITLE_PX), "white")
    draw = ImageDraw.Draw(canvas)
    for k, (image, title) in enumerate(zip(images, titles, strict=True)):
        left = k * (width + GAP_PX)
        draw.text((left + 2, 4), title, fill="black", font_size=14)
        canvas.paste(Image.fromarray(image).resize((width, height), Image.Resampling.LANCZOS), (left, TITLE_PX))
    return canvas


def main() -> None:
    """Renders both scenes from the store and writes the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--store", default="genre-store")
    parser.add_argument("--out", type=Path, default=Path("docs/images/beside.jpg"))
    parser.add_argument("--log", default="pandaset:../shared/data/pandaset/002")
    parser.add_argument("--chunk", type=int, default=1)
    parser.add_argument("--camera", default="front_left_camera")
    parser.add_argument("--frame", type=int, default=24)
    parser.add_argument("--shift", type=float, default=3.0, help="metres to the left")
    options = parser.parse_args()
    runs = configurations(BENCH.options["per_scene_iterations"])
    jobs = {name: Job(options.log, options.chunk, options.store, runs[name]) for name in ("street_gs", "fine")}
    plain = reconstruct(jobs["street_gs"], GNET_STAGES[:-1])
    enhanced = reconstruct(jobs["fine"])
    # Both scenes are fitted to the refined poses.
    plan = read_artifact(jobs["fine"], enhanced["effects"])
    chunk = apply_plan(read_artifact(jobs["fine"], enhanced["ingest"]), plan)
    view = next(v for v in chunk.views if (v.camera, v.frame) == (options.camera, options.frame))
    place = (options.camera, options.frame, options.shift)
    images = [
        decode_pixels(view.image, chunk.width_px, chunk.height_px),
        render_beside(chunk, read_artifact(jobs["street_gs"], plain["gnet"]).scene, *place),
        render_beside(chunk, read_artifact(jobs["fine"], enhanced["enet"]).scene, *place),
    ]
    titles = ["recorded", f"per-scene fit, {options.shift:g} m to the left", f"GenRe, {options.shift:g} m to the left"]
    options.out.parent.mkdir(parents=True, exist_ok=True)
    compose(images, titles).save(options.out, quality=88)
    sys.stdout.write(f"wrote {options.out}\n")


if __name__ == "__main__":
    main()
