"""A scene of per-scene 3DGS, given to ``genre enhance`` as a file with images and poses and nothing else of its log."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.common.bench import Row
from benchmarks.common.claims import Claim, claim
from benchmarks.common.novel_view_truth import load_true_targets
from benchmarks.common.run_stages import reconstruct
from benchmarks.optimiser.enhancement import score_against_truth
from flows.configuration import load_configuration
from flows.enhancement.enhancement_request import EnhancementInputs, prepare_enhancement
from flows.paper_tables.builtin_methods import BUILT_IN
from flows.pipeline.log_cache import cached_log
from flows.pipeline.stage_runner import Job, read_artifact
from flows.training.optimiser_training import mean_psnr
from genre_tasks.exchange.clouds import transform_cloud
from genre_tasks.exchange.conversion import pose_scene, to_exchange_scene
from genre_tasks.exchange.one_cloud import make_resting_scene
from genre_tasks.exchange.ply import PLY
from genre_tasks.logs.types import DrivingLog, Float64
from genre_tasks.losses.targets import Target, view_targets
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.transforms import invert_se3

SHIFT_M = 3.0
LEAST_GAIN_DB = 0.3
LEAST_PERCEPTUAL_CUT = 0.10
MOST_HELDOUT_LOSS_DB = 0.3
ITERATIONS = 1000
DEPTHS = ("scene", "lidar")
"""Where the depth comes from: the scene's own, or the log's LiDAR as a PLY file."""

_OPENGL_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class EnhancementCase:
    """A street whose scene is made, and enhanced.

    Attributes:
        log: URI of a synthetic street.
        store: folder of the artifacts; files go into its folder ``enhancement``.
        preset: of the scene and of its enhancement; small, for claims.
        settings: over the preset, of both.
    """

    log: str
    store: str
    preset: str = "small"
    settings: tuple[str, ...] = ()

    def base_job(self) -> Job:
        """Builds the job that makes the scene by per-scene 3DGS."""
        # Behind the user's settings: another method would be no scene of another program.
        recipe = (*BUILT_IN["3dgs"].settings, f"gnet.per_scene.iterations={ITERATIONS}", "gnet.snapshots=0")
        config = load_configuration(self.preset, settings=(*self.settings, *recipe))
        return Job(self.log, 0, self.store, config.model_dump(mode="json"))

    def enhancement_job(self, folder: Path, depth: str) -> Job:
        """Builds the job that ``genre enhance`` would run.

        Args:
            folder: with ``scene.ply``, ``transforms.json``, images and ``points.ply``.
            depth: one of :data:`DEPTHS`.
        """
        inputs = EnhancementInputs(
            scene=folder / "scene.ply",
            cameras=folder / "transforms.json",
            lidar=folder / "points.ply" if depth == "lidar" else None,
            scale="1",
        )
        prepared = prepare_enhancement(inputs, load_configuration(self.preset))
        # The user's settings come last, and win, as those of the command do.
        settings = (*prepared.settings, "enet.snapshots=0", *self.settings)
        config = load_configuration(self.preset, settings=settings)
        return Job(prepared.log, 0, self.store, config.model_dump(mode="json"))


def measure_enhancement(case: EnhancementCase, depths: Sequence[str] = ("scene",)) -> Row:
    """Makes a scene of chunk 0 by per-scene 3DGS, exports it, enhances the file, and compares with the truth.

    Args:
        case: the street.
        depths: some of :data:`DEPTHS`.

    Returns:
        The row: for the scene as it was given and for each enhanced one, held-out PSNR, and PSNR and perceptual
        distance at 3 m.
    """
    folder, chunk = make_base_scene(case)
    scores = score_enhancement(case, folder, chunk, depths)
    return {"log": case.log, "preset": case.preset, "iterations": ITERATIONS, **scores}


def make_base_scene(case: EnhancementCase) -> tuple[Path, Chunk]:
    """Makes a scene of chunk 0 by per-scene 3DGS, and writes it with images, poses and points.

    Args:
        case: the street.

    Returns:
        The folder of the files, and the chunk.
    """
    base = case.base_job()
    refs = reconstruct(base, ("ingest", "effects", "initial", "gnet"))
    chunk: Chunk = read_artifact(base, refs["ingest"])
    scene: SceneGraph = read_artifact(base, refs["gnet"]).scene
    log = cached_log(case.log)
    folder = Path(case.store) / "enhancement" / log.name
    write_files(folder, log, chunk, scene)
    return folder, chunk


def score_enhancement(case: EnhancementCase, folder: Path, chunk: Chunk, depths: Sequence[str]) -> Row:
    """Enhances the files of a folder, and scores the scene as it was given and each enhanced one.

    Args:
        case: the street, which has the truth.
        folder: from :func:`make_base_scene`.
        chunk: of the street.
        depths: some of :data:`DEPTHS`.

    Returns:
        Scores by name of the scene.
    """
    truth = load_true_targets(case.log, case.store, chunk, SHIFT_M)
    row: Row = {}
    for depth in depths:
        job = case.enhancement_job(folder, depth)
        made = reconstruct(job, ("ingest", "effects", "initial", "gnet", "novel_views", "fnet", "enet"))
        enhanced_chunk: Chunk = read_artifact(job, made["ingest"])
        scenes = {name: read_artifact(job, made[stage]).scene for name, stage in (("given", "gnet"), (depth, "enet"))}
        heldout = view_targets(enhanced_chunk, enhanced_chunk.views_with_role("heldout"))
        scores = score_against_truth(scenes, _move_targets(truth, chunk, enhanced_chunk))
        for name, enhanced in scenes.items():
            row[name] = {"heldout_psnr": mean_psnr(enhanced, heldout), **scores[name]}
        row[f"{depth}_points"] = len(enhanced_chunk.static)
    return row


def write_files(folder: Path, log: DrivingLog, chunk: Chunk, scene: SceneGraph) -> None:
    """Writes a scene as PLY, its images and poses, and its LiDAR points; all in the log's world.

    Args:
        folder: to write into.
        log: with the images.
        chunk: of the log.
        scene: of the chunk, made without actors.
    """
    frames = []
    for frame in chunk.frames:
        for camera in log.cameras:
            data = log.image_bytes(camera.name, frame)
            assert data is not None
            image = folder / "images" / camera.name / f"{frame:04d}.png"
            image.parent.mkdir(parents=True, exist_ok=True)
            image.write_bytes(data)
            lens = camera.lens
            pose = log.world_SE3_camera(camera.name, frame) @ _OPENGL_FLIP
            frames.append(
                {
                    "file_path": image.relative_to(folder).as_posix(),
                    "transform_matrix": pose.tolist(),
                    "fl_x": lens.fx_px,
                    "fl_y": lens.fy_px,
                    "cx": lens.cx_px,
                    "cy": lens.cy_px,
                    "w": lens.width_px,
                    "h": lens.height_px,
                }
            )
    (folder / "transforms.json").write_text(json.dumps({"camera_model": "OPENCV", "frames": frames}))
    times = [float(frame) for frame in chunk.frames]
    cloud = pose_scene(to_exchange_scene(scene, chunk.frames, times, chunk.world_SE3_chunk, names={}), None)
    PLY.write(folder / "scene.ply", make_resting_scene(transform_cloud(cloud, chunk.world_SE3_chunk)))
    _write_points(folder / "points.ply", chunk.static.positions + chunk.world_SE3_chunk[:3, 3])


def _write_points(path: Path, positions: Float64) -> None:
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(positions)}\n"
    header += "".join(f"property double {axis}\n" for axis in "xyz") + "end_header\n"
    path.write_bytes(header.encode() + positions.astype("<f8").tobytes())


def _move_targets(truth: Sequence[Target], chunk: Chunk, other: Chunk) -> tuple[Target, ...]:
    """True views in the coordinates of another chunk of the same world."""
    other_SE3_chunk = invert_se3(other.world_SE3_chunk) @ chunk.world_SE3_chunk
    return tuple(replace(t, chunk_SE3_camera=other_SE3_chunk @ t.chunk_SE3_camera) for t in truth)


def enhancement_claims(rows: Sequence[Row]) -> Iterator[Claim]:
    """Claims that an enhanced scene is nearer to the truth beside the path, and hardly worse on it.

    Args:
        rows: see :func:`measure_enhancement`, with the depth of the scene.
    """
    presets = ", ".join(sorted({str(row.get("preset", "small")) for row in rows})) or "not measured"
    note = f"3DGS of {ITERATIONS} iterations as PLY with images and poses, chunk 0, preset {presets}; "
    note += ", ".join(row["log"] for row in rows)
    gains = [_change(row, "psnr") for row in rows]
    cuts = [-_change(row, "perceptual") / row["given"]["perceptual"] for row in rows]
    losses = [-_change(row, "heldout_psnr") for row in rows]
    n = len(rows)
    yield claim("exchange.enhance_psnr_3m", _mean(gains), ">=", LEAST_GAIN_DB, "dB", note, n, _range(gains))
    yield claim(
        "exchange.enhance_perceptual_3m", _mean(cuts), ">=", LEAST_PERCEPTUAL_CUT, "part", note, n, _range(cuts)
    )
    yield claim("exchange.enhance_heldout", _mean(losses), "<=", MOST_HELDOUT_LOSS_DB, "dB", note, n, _range(losses))


def _change(row: Mapping[str, Mapping[str, float]], metric: str) -> float:
    return row["scene"][metric] - row["given"][metric]


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _range(values: Sequence[float]) -> tuple[float, float] | None:
    return (float(np.quantile(values, 0.25)), float(np.quantile(values, 0.75))) if values else None


def enhancement_table(rows: Sequence[Row]) -> Iterator[str]:
    """Gives a line for each scene: as it was given, and enhanced with either depth.

    Args:
        rows: see :func:`measure_enhancement`.
    """
    yield "| log | scene | held-out PSNR | PSNR at 3 m | perceptual distance at 3 m |"
    yield "|---|---|---|---|---|"
    names = {"given": "as given", "scene": "enhanced, depth of the scene", "lidar": "enhanced, depth of LiDAR"}
    for row in rows:
        for name in (name for name in names if name in row):
            scores = row[name]
            numbers = f"{scores['heldout_psnr']:.2f} | {scores['psnr']:.2f} | {scores['perceptual']:.3f}"
            yield f"| {row['log']} | {names[name]} | {numbers} |"
