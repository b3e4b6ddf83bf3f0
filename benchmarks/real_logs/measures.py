"""Held-out PSNR of GNet's scene with and without effects, and the chain on one log."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from benchmarks.common.bench import Row
from benchmarks.common.cell_parameters import describe_preset
from benchmarks.common.run_stages import read_metrics, reconstruct
from benchmarks.common.task import require_log_folder
from flows.configuration import load_configuration
from flows.pipeline.stage_runner import ArtifactRef, Job, read_artifact
from genre_tasks.effects.types import EffectsPlan

NOISE = "pose_noise_deg=0.2&pose_noise_m=0.05&camera_delay_s=0.02"
"""Errors of the recorded poses of noisy streets, as parameters of their URI."""

# What no table of this benchmark shows would only cost time.
_HELDOUT_ONLY = ("evaluate.shifts_m=[1]", "evaluate.every=20", "evaluate.distributions=false", "evaluate.pictures=0")
_VARIANTS = {
    "none": ("effects.multi_view_stereo=off", "effects.pose_refinement=off"),
    "stereo": ("effects.pose_refinement=off",),
    "poses": ("effects.multi_view_stereo=off", "effects.pose_refinement=on"),
    "auto": (),
}


@dataclass(frozen=True)
class LogOfBench:
    """A chunk of a log, and how it is reconstructed.

    Attributes:
        uri: of the log.
        chunk: its number.
        preset: of the configuration.
        settings: over the preset.
        store: folder of the artifacts.
    """

    uri: str
    chunk: int
    preset: str
    settings: tuple[str, ...]
    store: str

    @property
    def name(self) -> str:
        """The log without its path, and the chunk."""
        kind, _, rest = self.uri.partition(":")
        parts = re.split(r"[?&]", rest)
        word = parts[1] if kind == "synthetic" else parts[0].rstrip("/").rsplit("/", 1)[-1]
        return f"{kind} {word} chunk {self.chunk}"

    @property
    def parameters(self) -> dict[str, Any]:
        """What is measured, as far as a cell's name does not say it."""
        return {"uri": self.uri, "chunk": self.chunk, **describe_preset(self.preset, self.settings)}

    def job(self, settings: Sequence[str], suffix: str = "") -> Job:
        """Describes a run.

        Args:
            settings: further settings.
            suffix: of the URI.

        Returns:
            The job.
        """
        configuration = load_configuration(self.preset, settings=[*self.settings, *settings])
        return Job(self.uri + suffix, self.chunk, self.store, configuration.model_dump(mode="json"))


def measure_chain(log: LogOfBench) -> Row:
    """Reconstructs and enhances a log.

    Args:
        log: a log without a truth beside its path.

    Returns:
        The row: of GNet's and ENet's scene the held-out PSNR, with fitted colours too, and the kernel distance at 3 m;
        how many cameras the chunk has, and the size of their images.

    Raises:
        NotMeasuredError: the log's folder is missing.
    """
    require_log_folder(log.uri)
    job = log.job(["evaluate.shifts_m=[3]"])
    refs = reconstruct(job)
    views = read_artifact(job, refs["ingest"]).views
    size_px = [views[0].lens.width_px, views[0].lens.height_px]
    row: Row = {"kind": "chain", "log": log.name, "cameras": len({v.camera for v in views}), "size_px": size_px}
    for stage in ("gnet", "enet"):
        metrics = read_metrics(job, refs[f"evaluate/{stage}"])
        row[stage] = {
            "psnr": metrics["interpolation/psnr"],
            "cc_psnr": metrics["interpolation/cc_psnr"],
            "ssim": metrics["interpolation/ssim"],
            "kernel_3m": metrics["shift_3m/kernel"],
        }
    return row


def measure_effects(log: LogOfBench) -> Row:
    """Reconstructs a log without multi-view stereo and pose refinement, with each, and as their gates decide.

    Args:
        log: any log.

    Returns:
        The row: held-out PSNR of each, and what the gates measured.
    """
    row: Row = {"kind": "effects", "log": log.name}
    for name, settings in _VARIANTS.items():
        job, refs = _reconstruct_path(log, settings)
        row[name] = read_metrics(job, refs["evaluate/gnet"])["interpolation/psnr"]
        if name == "auto":
            row["plan"] = _describe_plan(job, refs)
    return row


def measure_pose_noise(log: LogOfBench) -> Row:
    """Reconstructs an exact street, and the same with errors of its recorded poses.

    Args:
        log: a street.

    Returns:
        The row: held-out PSNR of the exact street, of the noisy one without and with pose refinement; whether the exact
        one is the same bytes with the effect left to its gate.
    """
    off = ("effects.pose_refinement=off",)
    row: Row = {"kind": "pose_noise", "log": log.name, "noise": NOISE}
    job, refs = _reconstruct_path(log, off)
    row["exact"] = read_metrics(job, refs["evaluate/gnet"])["interpolation/psnr"]
    gated_job, gated_refs = _reconstruct_path(log, ())
    row["exact_plan"] = _describe_plan(gated_job, gated_refs)
    row["exact_is_same"] = _scene_digest(job, refs) == _scene_digest(gated_job, gated_refs)
    job, refs = _reconstruct_path(log, off, f"&{NOISE}")
    row["noisy"] = read_metrics(job, refs["evaluate/gnet"])["interpolation/psnr"]
    job, refs = _reconstruct_path(log, (), f"&{NOISE}")
    row["refined"] = read_metrics(job, refs["evaluate/gnet"])["interpolation/psnr"]
    row["misalignment_px"] = _describe_plan(job, refs)["pose_refinement"]["value"]
    return row


def _reconstruct_path(log: LogOfBench, settings: Sequence[str], suffix: str = "") -> tuple[Job, dict[str, ArtifactRef]]:
    require_log_folder(log.uri)
    job = log.job([*_HELDOUT_ONLY, *settings], suffix)
    return job, reconstruct(job, ("ingest", "effects", "initial", "gnet", "evaluate/gnet"))


def _describe_plan(job: Job, refs: dict[str, ArtifactRef]) -> dict[str, dict[str, Any]]:
    plan: EffectsPlan = read_artifact(job, refs["effects"])
    names = ("pose_refinement", "multi_view_stereo", "exposure")
    # A value that could not be measured is NaN, which JSON does not have.
    return {
        name: {"choice": plan[name].choice, "value": plan[name].value if math.isfinite(plan[name].value) else None}
        for name in names
    }


def _scene_digest(job: Job, refs: dict[str, ArtifactRef]) -> str:
    packed = read_artifact(job, refs["gnet"]).scene.gaussians.pack()
    return hashlib.sha256(packed.contiguous().numpy().tobytes()).hexdigest()
