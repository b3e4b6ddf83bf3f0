"""Flicker along rollouts, against that of the true images, and how a rollout changes from chunk to chunk."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from benchmarks.common.bench import NotMeasuredError, Row
from benchmarks.common.claims import Claim, claim
from benchmarks.common.timing import Quartiles
from benchmarks.simulation.scenes import (
    LogScenes,
    SimulationCase,
    cut_path,
    describe_training,
    log_label,
    open_scenes,
    truth_view,
)
from flows.paper_tables.rollouts import TableRollout
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.logs.synthetic.edited_truth import EditedStreet
from genre_tasks.logs.synthetic.traffic_edits import build_street_layout
from genre_tasks.rollout.fix_rollout import RolloutFixer
from genre_tasks.rollout.flicker import FlickerMeter
from genre_tasks.rollout.handover import Handover, plan_handovers
from genre_tasks.rollout.render_rollout import RolloutImages, render_rollout

MOST_FLICKER = 1.1
MOST_STEP = 1.25
"""No target of the paper's: a step that is a quarter larger than the largest of a chunk is taken for visible."""
TRUE_POSES = 8
"""Consecutive poses of a rollout whose truth is cast, half a second for each camera."""
# None that stops: a standing camera neither flickers nor comes to the next chunk.
STEADY_ROLLOUTS = (TableRollout("swerve", 3.0), TableRollout("lane-change", -3.0), TableRollout("accelerate", 3.0))


def measure_flicker(case: SimulationCase, poses: int = TRUE_POSES, fixers: bool = True) -> Row:
    """Measures the flicker of three rollouts.

    Args:
        case: the log.
        poses: consecutive ones, in the middle of a rollout.
        fixers: whether FNet fixes the rollouts, with and without the image before.

    Returns:
        ``rollouts``: for each its flicker by version: ``render``, ``fixed``, ``fixed_temporal`` and, where the log has
        a truth, ``truth``.
    """
    scenes = open_scenes(case)
    street = None
    if not case.is_real:
        street = EditedStreet(scenes.street, build_street_layout(scenes.street))
    found = []
    for rollout in STEADY_ROLLOUTS:
        planned = scenes.plan(rollout)
        first = max(0, (len(planned.path) - poses) // 2)
        path = cut_path(planned.path, first, poses)
        values = _measure_versions(scenes, path, street, fixers)
        found.append({"rollout": str(planned), "strength": planned.strength, "poses": len(path), "flicker": values})
    return {"log": case.log, "chunks": list(case.chunks), "rollouts": found}


def _measure_versions(
    scenes: LogScenes, path: EgoPath, street: EditedStreet | None, with_fixers: bool
) -> dict[str, float]:
    config = scenes.config
    fixers: dict[str, RolloutFixer] = {}
    if with_fixers:
        for name, temporal in (("fixed", False), ("fixed_temporal", True)):
            section = config.fnet.model_copy(update={"temporal": temporal})
            fixers[name] = RolloutFixer(section, scenes.source, config.novel_views.lidar_max_points)
    handovers = plan_handovers(scenes.source, path, scenes.rig, config.simulate.handover_frames)
    meter = FlickerMeter()
    for images in render_rollout(scenes.source, path, scenes.rig, handovers=handovers):
        versions = {"render": images.color} | {name: fixer.fix(images).color for name, fixer in fixers.items()}
        if street is not None:
            versions["truth"] = cast_truth(street, images)
        meter.add(images, versions)
    return meter.flicker


def cast_truth(street: EditedStreet, images: RolloutImages) -> Tensor:
    """Ray-casts what the cameras of a pose would have seen.

    Args:
        street: with the traffic of the rollout.
        images: of the pose.

    Returns:
        [C, H, W, 3] sRGB in [0, 1].
    """
    chunk = images.chunk_scene.chunk
    cast = [street.image(truth_view(chunk, v.frame, v.chunk_SE3_camera, v.lens)) for v in images.views]
    return torch.from_numpy(np.stack(cast).astype(np.float32) / np.float32(255))


def flicker_claims(rows: Sequence[Row]) -> Iterator[Claim]:
    """Claims that rollouts of ENet's scene flicker hardly more than the truth.

    Args:
        rows: see :func:`measure_flicker`.
    """
    streets = [row for row in rows if all("truth" in r["flicker"] for r in row["rollouts"])]
    ratios = [r["flicker"]["render"] / r["flicker"]["truth"] for row in streets for r in row["rollouts"]]
    quartiles = Quartiles.from_values(ratios) if ratios else None
    logs = ", ".join(log_label(row) for row in streets) or "no street"
    yield claim(
        "simulation.flicker",
        None if quartiles is None else quartiles.median,
        "<=",
        MOST_FLICKER,
        "ratio",
        f"warped difference of consecutive images over that of the true ones; {len(ratios)} rollouts; {logs}",
        len(ratios),
        None if quartiles is None else quartiles.spread,
    )


def flicker_table(rows: Sequence[Row]) -> Iterator[str]:
    """Gives a line for each rollout.

    Args:
        rows: see :func:`measure_flicker`.
    """
    yield "| log | rollout | truth | ENet's scene | over truth | FNet on every image | FNet with the image before |"
    yield "|---|---|---|---|---|---|---|"
    for row in rows:
        for rollout in row["rollouts"]:
            values = rollout["flicker"]
            ratio = f"{values['render'] / values['truth']:.3f}" if values.get("truth") else "–"
            shown = [f"{values[k]:.4f}" if k in values else "–" for k in ("truth", "render", "fixed", "fixed_temporal")]
            columns = (log_label(row), rollout["rollout"], shown[0], shown[1], ratio, *shown[2:])
            yield f"| {' | '.join(columns)} |"


@dataclass(frozen=True)
class _Step:
    """How much consecutive images differ.

    Attributes:
        is_handover: whether a fade or a border between chunks is within it.
        difference: warped difference, mean over cameras.
    """

    is_handover: bool
    difference: float


def measure_handover(case: SimulationCase) -> Row:
    """Measures the seam between chunks on three rollouts, and the steps between consecutive images across it.

    Args:
        case: the log.

    Returns:
        ``rollouts``: for each the seam's PSNR at the border and where the fade was put, and the largest steps with the
        fade, with a cut, and within chunks.

    Raises:
        NotMeasuredError: there is no second chunk, or no log.
    """
    if len(case.chunks) < 2:
        raise NotMeasuredError("a single chunk has no border")
    scenes = open_scenes(case)
    found = []
    for rollout in STEADY_ROLLOUTS:
        planned = scenes.plan(rollout)
        handovers = plan_handovers(scenes.source, planned.path, scenes.rig, scenes.config.simulate.handover_frames)
        faded = _measure_steps(scenes, planned.path, handovers)
        cut = _measure_steps(scenes, planned.path, None)
        found.append(
            {
                "rollout": str(planned),
                "border_psnr": [dict(h.candidates).get(h.border_frame) for h in handovers],
                "seam_psnr": [h.psnr_db if math.isfinite(h.psnr_db) else None for h in handovers],
                "largest_at_fade": max((s.difference for s in faded if s.is_handover), default=None),
                "largest_at_cut": max((s.difference for s in cut if s.is_handover), default=None),
                "largest_within": max((s.difference for s in faded if not s.is_handover), default=None),
                "median_within": statistics.median(s.difference for s in faded if not s.is_handover),
            }
        )
    return {"log": case.log, "chunks": list(case.chunks), "rollouts": found}


def _measure_steps(scenes: LogScenes, path: EgoPath, handovers: Sequence[Handover] | None) -> list[_Step]:
    steps = []
    last: RolloutImages | None = None
    for images in render_rollout(scenes.source, path, scenes.rig, handovers=handovers):
        if last is not None:
            meter = FlickerMeter()
            meter.add(last, {"render": last.color})
            meter.add(images, {"render": images.color})
            fades = last.blended_chunk is not None or images.blended_chunk is not None
            steps.append(_Step(fades or last.chunk != images.chunk, meter.flicker["render"]))
        last = images
    return steps


def handover_claims(rows: Sequence[Row]) -> Iterator[Claim]:
    """Claims that no step across a border is much larger than the largest one within a chunk.

    Args:
        rows: see :func:`measure_handover`.
    """
    rollouts = [r for row in rows for r in row["rollouts"]]
    logs = ", ".join(log_label(row) for row in rows) or "no log"
    ratios = [r["largest_at_fade"] / r["largest_within"] for r in rollouts if r["largest_at_fade"] is not None]
    note = f"warped difference of consecutive images: largest across a hand-over over largest within chunks; {logs}"
    note += describe_training(rows)
    worst = max(ratios, default=None)
    yield claim("simulation.handover_step", worst, "<=", MOST_STEP, "ratio, worst rollout", note, len(ratios))


def handover_table(rows: Sequence[Row]) -> Iterator[str]:
    """Gives a line for each rollout.

    Args:
        rows: see :func:`measure_handover`.
    """
    yield (
        "| log | rollout | same view from both chunks at the border, dB | where the fade is, dB "
        "| largest step with the fade | with a cut | within chunks | median within |"
    )
    yield "|---|---|---|---|---|---|---|---|"
    for row in rows:
        for r in row["rollouts"]:
            seams = [", ".join("–" if x is None else f"{x:.2f}" for x in r[k]) for k in ("border_psnr", "seam_psnr")]
            names = ("largest_at_fade", "largest_at_cut", "largest_within", "median_within")
            steps = ["–" if r[k] is None else f"{r[k]:.4f}" for k in names]
            yield f"| {' | '.join((log_label(row), r['rollout'], *seams, *steps))} |"
