"""What a scene loses on its way into a file and back: attributes, images, and the bytes that it takes."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.common.bench import NotMeasuredError, Row
from benchmarks.common.claims import Claim, claim
from benchmarks.common.context import THREADS
from flows.reconstruction.stored_values import find_last_stage, read_stage_scene, read_stage_value
from genre_tasks.errors import ConfigError
from genre_tasks.exchange.activations import colors_to_sh_dc, sh_dc_to_colors
from genre_tasks.exchange.cloud_errors import CloudErrors, compare_clouds
from genre_tasks.exchange.conversion import pose_scene, to_exchange_scene, to_scene_graph
from genre_tasks.exchange.one_cloud import make_resting_scene
from genre_tasks.exchange.registry import load_format
from genre_tasks.exchange.types import SH_REST_COUNTS, ExchangeFormat, ExchangeScene
from genre_tasks.logs.types import Float32
from genre_tasks.metrics.image_quality import psnr
from genre_tasks.render import RenderSettings, render_views
from genre_tasks.scene.chunk import Chunk, View

SPLAT_DIFFERENCE = 2.0
"""Most of a .splat file's mean difference of images, in steps of 256."""

SPLAT_PSNR_DB = 40.0
SPZ_BYTES = 12.5
"""Most bytes a Gaussian without harmonics in an SPZ file."""

NODE_FORMAT_ERROR = 1e-6
"""Most difference of any attribute in formats that hold float32 under other names."""

_NODE_FORMATS = ("glb", "usdz")
# Faint, as optimised harmonics are; drawn by chance, since a scene of a preset may have none.
_SH_SIGMA = 0.05


@dataclass(frozen=True)
class RoundTripCase:
    """A scene of a finished run.

    Attributes:
        store: folder of the store.
        run: the run's name, or the start of it.
        chunk: number of the chunk.
    """

    store: str
    run: str
    chunk: int = 0


def measure_round_trip(format_name: str, case: RoundTripCase, sh_degree: int = 0) -> Row:
    """Writes a scene, reads it, and compares it with what was written.

    Args:
        format_name: in the registry.
        case: the scene. Formats without nodes get it as it is posed at its middle frame.
        sh_degree: 0: without harmonics; else harmonics drawn from a seed.

    Returns:
        The largest error of each attribute, PSNR and mean difference of images at the middle frame, bytes and seconds.
        ``psnr_as_read_db`` is without anti-aliasing where the file does not say that there was any;
        ``psnr_in_range_db`` is of the scene with its colours cut to [0, 1] before, and ``out_of_range`` is the part of
        Gaussians whose colours that changes.

    Raises:
        NotMeasuredError: the format's package is not installed, or the format is read only.
    """
    try:
        exchange_format = load_format(format_name)
    except ConfigError as error:
        raise NotMeasuredError(str(error)) from error
    if not exchange_format.can_write:
        raise NotMeasuredError(f"{format_name} is read only")
    chunk, scene = _read_scene(case, sh_degree)
    middle = len(chunk.frames) // 2
    written = scene if exchange_format.carries_nodes else make_resting_scene(pose_scene(scene, middle))
    views = [view for view in chunk.views if view.frame == chunk.frames[middle]]
    found, size, seconds = _write_and_read(exchange_format, written)
    before = _render(written, views)
    # Rendered in one way: what a file does not say of anti-aliasing is a loss of its own.
    after = _render(_with_antialiasing(found, written), views)
    in_range = _cut_colors(written)
    found_in_range, _, _ = _write_and_read(exchange_format, in_range)
    count = sum(len(node.cloud) for node in written.nodes)
    return {
        "format": format_name,
        "log": chunk.log,
        "chunk": chunk.index,
        "sh_degree": sh_degree,
        "gaussians": count,
        "nodes": len(written.nodes),
        "errors": asdict(_compare(written, found)),
        "images": len(views),
        "psnr_db": _compare_images(before, after),
        "psnr_as_read_db": _compare_images(before, _render(found, views)),
        "psnr_in_range_db": _compare_images(
            _render(in_range, views), _render(_with_antialiasing(found_in_range, written), views)
        ),
        "out_of_range": _count_out_of_range(written) / count,
        "difference": 255 * max(float(np.abs(b - a).mean()) for b, a in zip(before, after, strict=True)),
        "bytes_per_gaussian": size / count,
        "write_s": seconds[0],
        "read_s": seconds[1],
        "losses": list(exchange_format.describe_losses(written)),
    }


def _read_scene(case: RoundTripCase, sh_degree: int) -> tuple[Chunk, ExchangeScene]:
    _, chunk = read_stage_value(case.store, case.run, case.chunk, "ingest")
    scene = read_stage_scene(case.store, case.run, case.chunk, find_last_stage(case.store, case.run, case.chunk))
    times = [min(view.timestamp_s for view in chunk.views if view.frame == frame) for frame in chunk.frames]
    names = {actor.track_id: f"actor-{k}" for k, actor in enumerate(scene.actors, start=1)}
    if sh_degree:
        random = torch.Generator().manual_seed(0)
        shape = (len(scene), SH_REST_COUNTS[sh_degree], 3)
        scene = scene.with_spherical_harmonics(_SH_SIGMA * torch.randn(shape, generator=random))
    return chunk, to_exchange_scene(scene, chunk.frames, times, chunk.world_SE3_chunk, names=names)


def _write_and_read(
    exchange_format: ExchangeFormat, scene: ExchangeScene
) -> tuple[ExchangeScene, int, tuple[float, float]]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"scene{exchange_format.suffixes[0]}"
        start = time.perf_counter()
        exchange_format.write(path, scene)
        written = time.perf_counter()
        found = exchange_format.read(path)
        read = time.perf_counter()
        return found, path.stat().st_size, (written - start, read - written)


def _render(scene: ExchangeScene, views: Sequence[View]) -> list[Float32]:
    graph = to_scene_graph(scene)
    moving = any(node.motion is not None for node in scene.nodes)
    # A file may not know the log's frames; then moments count from 0, and the middle one is shown.
    frame = float(len(scene.times_s) // 2) if moving and not scene.frames else None
    posed = [view if frame is None else replace(view, frame=int(frame)) for view in views]
    color = render_views(graph, posed, RenderSettings(threads=THREADS)).color
    return [np.clip(image, 0, 1) for image in color.numpy()]


def _with_antialiasing(scene: ExchangeScene, as_in: ExchangeScene) -> ExchangeScene:
    antialiased = as_in.nodes[0].cloud.antialiased
    nodes = [replace(node, cloud=replace(node.cloud, antialiased=antialiased)) for node in scene.nodes]
    return replace(scene, nodes=tuple(nodes))


def _cut_colors(scene: ExchangeScene) -> ExchangeScene:
    colors = [np.clip(sh_dc_to_colors(node.cloud.sh_dc), 0, 1) for node in scene.nodes]
    nodes = [
        replace(node, cloud=replace(node.cloud, sh_dc=colors_to_sh_dc(cut)))
        for node, cut in zip(scene.nodes, colors, strict=True)
    ]
    return replace(scene, nodes=tuple(nodes))


def _count_out_of_range(scene: ExchangeScene) -> int:
    colors = [sh_dc_to_colors(node.cloud.sh_dc) for node in scene.nodes]
    return sum(int(((c < 0) | (c > 1)).any(1).sum()) for c in colors)


def _compare_images(before: Sequence[Float32], after: Sequence[Float32]) -> float:
    """PSNR of the worst pair."""
    return min(psnr(b, a) for b, a in zip(before, after, strict=True))


def _compare(before: ExchangeScene, after: ExchangeScene) -> CloudErrors:
    found = {node.name: node.cloud for node in after.nodes}
    errors = [compare_clouds(node.cloud, found[node.name]) for node in before.nodes]
    names = list(asdict(errors[0]))
    return CloudErrors(**{name: max(getattr(error, name) for error in errors) for name in names})


def round_trip_claims(rows: Sequence[Row]) -> Iterator[Claim]:
    """Claims what each format keeps; formats without a row are not measured.

    Args:
        rows: see :func:`measure_round_trip`.
    """
    plain = {row["format"]: row for row in rows if not row["sh_degree"]}
    note = "a reconstructed street without harmonics"
    ply = [row for row in rows if row["format"] == "ply"]
    worst = max((_largest_error(row) for row in ply), default=None)
    yield claim("exchange.ply_error", worst, "<=", 0.0, "largest error", "a reconstructed street", len(ply))
    difference = _take(plain, "splat", "difference")
    yield claim("exchange.splat_difference", difference, "<=", SPLAT_DIFFERENCE, "of 256", note)
    quality = _take(plain, "splat", "psnr_db")
    outside = f"; {plain['splat']['out_of_range']:.0%} of its colours are out of range" if "splat" in plain else ""
    yield claim("exchange.splat_psnr", quality, ">=", SPLAT_PSNR_DB, "dB", f"{note}{outside}")
    quality = _take(plain, "splat", "psnr_in_range_db")
    yield claim("exchange.splat_psnr_in_range", quality, ">=", SPLAT_PSNR_DB, "dB", f"{note}, colours cut to 0 to 1")
    yield claim("exchange.spz_difference", _take(plain, "spz", "difference"), "<=", SPLAT_DIFFERENCE, "of 256", note)
    yield claim("exchange.spz_psnr", _take(plain, "spz", "psnr_db"), ">=", SPLAT_PSNR_DB, "dB", note)
    size = _take(plain, "spz", "bytes_per_gaussian")
    yield claim("exchange.spz_bytes", size, "<=", SPZ_BYTES, "bytes a Gaussian", note)
    for name in _NODE_FORMATS:
        of_format = [row for row in rows if row["format"] == name]
        worst = max((_largest_error(row) for row in of_format), default=None)
        note = "a reconstructed street with its actors"
        yield claim(f"exchange.{name}_error", worst, "<=", NODE_FORMAT_ERROR, "largest error", note, len(of_format))


def _largest_error(row: Row) -> float:
    return max(float(value) for value in row["errors"].values())


def _take(rows: dict[str, Row], name: str, column: str) -> float | None:
    return float(rows[name][column]) if name in rows else None


def round_trip_table(rows: Sequence[Row]) -> Iterator[str]:
    """Gives a line for each format and degree.

    Args:
        rows: see :func:`measure_round_trip`.
    """
    yield (
        "| format | degree of harmonics | bytes a Gaussian | positions, m | log scales | rotations, rad | opacities "
        "| colours | harmonics | mean difference of 256 | images, dB | with colours in range | as read |"
    )
    yield "|---|---|---|---|---|---|---|---|---|---|---|---|---|"
    for row in rows:
        errors = " | ".join(f"{value:.1g}" for value in row["errors"].values())
        yield (
            f"| {row['format']} | {row['sh_degree']} | {row['bytes_per_gaussian']:.1f} | {errors} "
            f"| {row['difference']:.2f} | {row['psnr_db']:.1f} | {row['psnr_in_range_db']:.1f} "
            f"| {row['psnr_as_read_db']:.1f} |"
        )
