"""Re-simulates a finished run: plans a path, checks it, renders it pose by pose and leaves a folder with a manifest."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from flows.configuration.loading import apply_settings
from flows.machine.facts import describe_environment
from flows.machine.resource_usage import ResourceUsage, measure_usage
from flows.simulation.edited_runs import open_run
from flows.simulation.outputs import open_outputs
from flows.simulation.parked_actors import find_tracks
from flows.simulation.poses_table import write_poses
from flows.simulation.prepared_rollout import PreparedRollout, prepare_rollout
from flows.simulation.recorded_settings import read_recorded_config
from flows.simulation.repair import choose_repair
from flows.simulation.request import SimulationRequest
from flows.simulation.rollout_folder import KIND, find_rollout, write_rollout
from flows.simulation.rollout_key import compute_rollout_key
from flows.simulation.rollout_metrics import RowMaker, measure_rollout, write_metrics
from flows.simulation.sensors import open_sensors
from genre_tasks.config import PipelineConfig
from genre_tasks.errors import InputError
from genre_tasks.progress import Progress, silent
from genre_tasks.rollout.render_rollout import render_rollout
from genre_tasks.scene_edits.edits import EditList
from storage.manifest import FileEntry, Manifest, payload_digest, to_json_value


def simulate_run(request: SimulationRequest, progress: Progress = silent) -> dict[str, Any]:
    """Simulates another drive through a finished run, and writes what its cameras see.

    A folder that holds the same simulation already is verified, and nothing is computed.

    Args:
        request: what to simulate.
        progress: called while scenes are measured and images are rendered.

    Returns:
        The record: ``out``, ``key``, ``cached``, ``files``, ``seconds``, ``warnings`` and ``metrics``.

    Raises:
        InputError: there is no such run, chunk, stage or camera, a file is unfit, or the folder cannot be written to.
        ConfigError: the path is implausible or meets an actor, the folder holds another rollout, or another version
            wrote the record, with settings that this one does not know.
        ResourceError: a film could not be written, or the disk is full.
    """
    request.check()
    run = open_run(request.store, request.run, request.stage, request.chunks)
    config = apply_settings(read_recorded_config(run.recorded.record), request.settings)
    key = compute_rollout_key(request, run, config)
    found = find_rollout(request.out, key, request.overwrite)
    if found is not None:
        return _describe(request.out, found, cached=True)
    rollout = prepare_rollout(request, run, config, progress)
    usage = ResourceUsage()
    metrics: dict[str, Any] = {}
    warnings: list[str] = []
    chunk = rollout.source.load(rollout.source.chunk_numbers[0]).chunk

    def make_manifest(files: tuple[FileEntry, ...]) -> Manifest:
        return Manifest(
            kind=KIND,
            dataset=chunk.dataset,
            log=chunk.log,
            chunk=chunk.index,
            stage=KIND,
            key=key,
            inputs=run.recorded.payload_digests(),
            configuration=_describe_configuration(request, config, run.edits + request.edits),
            files=files,
            payload_digest=payload_digest(files),
            seconds=usage.seconds,
            peak_mib=usage.peak_mib,
            created_at=datetime.now(UTC).isoformat(timespec="seconds"),
            environment=describe_environment(),
            measurements=to_json_value(metrics),
            warnings=(*_list_warnings(rollout, metrics), *warnings),
        )

    with write_rollout(request.out, make_manifest) as folder:
        with measure_usage() as measured:
            measured_metrics, found_warnings = _render(request, config, rollout, folder, progress)
        metrics.update(measured_metrics)
        warnings.extend(found_warnings)
        usage.seconds = measured.seconds
        usage.peak_mib = measured.peak_mib
    written = find_rollout(request.out, key, overwrite=False)
    if written is None:
        raise InputError("the rollout vanished while it was written", remedy="Run again.", file=request.out)
    return _describe(request.out, written, cached=False)


def _describe_configuration(request: SimulationRequest, config: PipelineConfig, edits: EditList) -> dict[str, Any]:
    """JSON values of all that a rollout was asked for."""
    return {
        "simulate": config.simulate.model_dump(mode="json"),
        "fnet": config.fnet.model_dump(mode="json"),
        "lidar_max_points": config.novel_views.lidar_max_points,
        "request": request.key_values(),
        "edits": edits.model_dump(mode="json")["edits"],
    }


def _render(
    request: SimulationRequest, config: PipelineConfig, rollout: PreparedRollout, folder: Path, progress: Progress
) -> tuple[dict[str, Any], list[str]]:
    """Renders a rollout, and returns its metrics and what limits its files."""
    path = rollout.checked.path
    row_maker = RowMaker(rollout)
    repair = choose_repair(request, config, rollout, folder)
    rows = []
    with open_outputs(open_sensors(request, rollout, folder)) as outputs:
        for images in render_rollout(rollout.source, path, rollout.rig, handovers=rollout.handovers):
            repaired = repair(images)
            for output in outputs:
                output.write(repaired)
            rows.append(row_maker.make_row(images))
            progress(images.index + 1, len(path), f"{len(rollout.rig)} cameras")
        warnings = [warning for output in outputs for warning in output.list_warnings()]
    write_poses(folder, rows)
    metrics = measure_rollout(rollout, rows)
    write_metrics(folder, metrics)
    return metrics, warnings


def _list_warnings(rollout: PreparedRollout, metrics: dict[str, Any]) -> tuple[str, ...]:
    warnings = [f"implausible: {violation}" for violation in rollout.checked.violations]
    warnings += [f"collision: {collision}" for collision in rollout.checked.collisions]
    if find_tracks(rollout.recorded) is None:
        reason = "the log is gone or another one, or its boxes cannot be read"
        warnings.append(f"{reason}: the path was not checked against parked vehicles")
    warnings += rollout.edit_warnings
    reliable = metrics.get("reliable_fraction")
    if reliable is not None and reliable < 1:
        warnings.append(f"{1 - reliable:.0%} of the poses are outside of the scenes' reliable range")
    return tuple(warnings)


def _describe(folder: Path, manifest: Manifest, cached: bool) -> dict[str, Any]:
    return {
        "out": str(folder),
        "key": manifest.key,
        "cached": cached,
        "seconds": manifest.seconds,
        "peak_mib": manifest.peak_mib,
        "files": len(manifest.files),
        "warnings": list(manifest.warnings),
        "metrics": manifest.measurements,
    }
