"""The scene bundle of AlpaSim: a zip that tells its simulator of a run's rig, path, traffic and ground.

The images themselves come from the sensor service, which names scene and cameras as the bundle does.
"""

from __future__ import annotations

import hashlib
import json
import uuid
import zipfile
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from flows.simulation.run_scenes import RunScenes
from flows.simulators.alpasim.ground_mesh import NOWHERE, build_ground_mesh, encode_mesh
from flows.simulators.alpasim.local_frame import LocalFrame, describe_ego_box, read_local_frame
from flows.simulators.alpasim.timestamps import to_microseconds
from flows.simulators.image_request import ActorDescription, CameraDescription
from flows.simulators.run_facts import RunFacts, read_run_facts
from genre_tasks.atomic_path import atomic_path
from genre_tasks.errors import InputError
from genre_tasks.logs.types import Float64
from genre_tasks.scene_edits.run_survey import survey_run

SUFFIX = ".usdz"
MIN_POSES = 2
"""AlpaSim lays a spline through an actor's path, and none goes through a single pose."""

# The oldest date that a zip can state: equal runs give equal bytes.
_ZIP_DATE = (1980, 1, 1, 0, 0, 0)
_FILE_MODE = 0o644 << 16


@dataclass(frozen=True)
class BundleSource:
    """What a bundle is written from.

    Attributes:
        scene_id: as the sensor service names the scene.
        facts: of the run.
        frame: the simulator's coordinates.
    """

    scene_id: str
    facts: RunFacts
    frame: LocalFrame

    @property
    def range_us(self) -> tuple[int, int]:
        """The first and the last time of the path."""
        times_s = self.facts.clock.times_s
        return to_microseconds(times_s[0]), to_microseconds(times_s[-1])


def write_alpasim_bundle(store: str, run: str, out: Path, stage: str | None = None) -> dict[str, Any]:
    """Writes the scene bundle of a run. The same run gives the same bytes.

    Args:
        store: folder (or URI) of the store.
        run: the run's name, or the start of it.
        out: the new file, which appears whole or not at all; an existing one is replaced.
        stage: initial, gnet or enet; ``None``: the last one of each chunk.

    Returns:
        JSON values: ``scene_id``, ``cameras``, ``actors``, ``seconds`` of the path, ``ground_triangles`` and
        ``losses``, sentences on what the bundle does not carry.

    Raises:
        InputError: there is no such run, an artifact is gone, or the run has one frame only.
        ArtifactCorruptError: an artifact is damaged.
        OSError: the file cannot be written.
    """
    scenes = RunScenes(store, run, stage)
    source = BundleSource(str(scenes.record["run"]), read_run_facts(scenes), read_local_frame(scenes))
    if len(source.facts.clock.times_s) < MIN_POSES:
        raise InputError("the run has one frame, and a simulator drives along several", remedy="Choose another run.")
    survey = survey_run(scenes)
    tracks = [track.world_SE3_box[:, :2, 3] for track in survey.tracks.values()]
    mesh = build_ground_mesh(survey.ground, survey.path.world_SE3_ego[:, :2, 3], np.concatenate([NOWHERE, *tracks]))
    # Only now: near the log's origin float32 would be too coarse.
    local = mesh._replace(vertices=mesh.vertices - source.frame.world_SE3_local[:3, 3])
    ply = encode_mesh(local)
    digest = hashlib.sha256(json.dumps(scenes.payload_digests(), sort_keys=True).encode()).hexdigest()
    actors = [actor for actor in source.facts.actors if len(actor.times_s) >= MIN_POSES]
    files = {
        "metadata.yaml": _to_yaml(describe_metadata(source, digest)),
        "rig_trajectories.json": _to_json(describe_rig(source)),
        "sequence_tracks.json": _to_json(describe_tracks(source, actors)),
        "mesh_ground.ply": ply,
        # The physics of AlpaSim reads this one where it is not told to take the ground alone.
        "mesh.ply": ply,
    }
    out.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(out) as part:
        _write_zip(part, files)
    first_us, last_us = source.range_us
    return {
        "scene_id": source.scene_id,
        "cameras": list(source.facts.cameras),
        "actors": len(actors),
        "seconds": (last_us - first_us) / 1e6,
        "ground_triangles": len(mesh.faces),
        "losses": _describe_losses(len(source.facts.actors) - len(actors)),
    }


def describe_metadata(source: BundleSource, digest: str) -> dict[str, Any]:
    """Describes ``metadata.yaml``.

    Args:
        source: of the bundle.
        digest: of all that the scene was read from.

    Returns:
        JSON values.
    """
    start_us, end_us = source.range_us
    return {
        "scene_id": source.scene_id,
        "version_string": f"genre {version('genre')}",
        # A date would give equal runs unequal bytes.
        "training_date": "",
        "dataset_hash": digest,
        "uuid": str(uuid.uuid5(uuid.NAMESPACE_OID, f"{source.scene_id} {digest}")),
        "is_resumable": False,
        "sensors": {"camera_ids": list(source.facts.cameras), "lidar_ids": []},
        "logger": {"name": None, "run_id": None, "run_url": None},
        "time_range": {"start": start_us / 1e6, "end": end_us / 1e6},
        "training_step_outputs": {},
    }


def describe_rig(source: BundleSource) -> dict[str, Any]:
    """Describes ``rig_trajectories.json``: cameras on the rig, its path, and when each camera took images.

    Args:
        source: of the bundle.

    Returns:
        JSON values; images of a time outside of the path are left out.
    """
    clock = source.facts.clock
    first_us, last_us = source.range_us
    calibrations = {}
    frames = {}
    for camera in source.facts.cameras.values():
        unique = f"{camera.name}@{source.scene_id}"
        calibrations[unique] = _describe_camera(camera, source)
        windows = [_frame_window(time_s, camera.readout_s) for time_s in clock.camera_times_s[camera.name]]
        frames[unique] = [list(window) for window in windows if first_us <= window[0] and window[1] <= last_us]
    return {
        "world_to_nre": {"matrix": np.eye(4).tolist()},
        "T_world_base": source.frame.world_SE3_local.tolist(),
        "camera_calibrations": calibrations,
        "rig_trajectories": [
            {
                "sequence_id": source.scene_id,
                "T_rig_world_timestamps_us": [to_microseconds(time_s) for time_s in clock.times_s],
                "T_rig_worlds": source.frame.place_rig(source.facts.world_SE3_ego).tolist(),
                "cameras_frame_timestamps_us": frames,
                "rig_bbox": describe_ego_box(),
            }
        ],
    }


def describe_tracks(source: BundleSource, actors: list[ActorDescription]) -> dict[str, Any]:
    """Describes ``sequence_tracks.json``: the moving actors, all of which a simulator may steer.

    Args:
        source: of the bundle.
        actors: of the run, with at least ``MIN_POSES`` poses each.

    Returns:
        JSON values. Poses are of the box's centre in the local frame: x, y, z and a quaternion x, y, z, w.
    """
    return {
        source.scene_id: {
            "tracks_data": {
                "tracks_id": [actor.track_id for actor in actors],
                "tracks_label_class": [actor.label for actor in actors],
                "tracks_flags": [["CONTROLLABLE"] for _ in actors],
                "tracks_timestamps_us": [[to_microseconds(t) for t in actor.times_s] for actor in actors],
                "tracks_poses": [_to_rows(source.frame.to_local(actor.world_SE3_box)) for actor in actors],
            },
            "cuboidtracks_data": {"cuboids_dims": [list(actor.size_m) for actor in actors]},
        }
    }


def _describe_camera(camera: CameraDescription, source: BundleSource) -> dict[str, Any]:
    lens = camera.lens
    k1, k2, p1, p2, k3 = lens.coefficients
    return {
        "sequence_id": source.scene_id,
        "logical_sensor_name": camera.name,
        "T_sensor_rig": source.frame.to_rig(camera.rig_SE3_camera).tolist(),
        "camera_model": {
            "type": "opencv-pinhole",
            "parameters": {
                "resolution": [lens.width_px, lens.height_px],
                "shutter_type": "ROLLING_TOP_TO_BOTTOM" if camera.readout_s else "GLOBAL",
                "principal_point": [lens.cx_px, lens.cy_px],
                "focal_length": [lens.fx_px, lens.fy_px],
                "radial_coeffs": [k1, k2, k3, 0.0, 0.0, 0.0],
                "tangential_coeffs": [p1, p2],
                "thin_prism_coeffs": [0.0, 0.0, 0.0, 0.0],
            },
        },
    }


def _frame_window(time_s: float, readout_s: float) -> tuple[int, int]:
    # The time is that of the middle row. Of no window start and end may be equal.
    start_us = to_microseconds(time_s - readout_s / 2)
    return start_us, max(to_microseconds(time_s + readout_s / 2), start_us + 1)


def _to_rows(poses: Float64) -> list[list[float]]:
    quats = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    rows: list[list[float]] = np.concatenate([poses[:, :3, 3], quats], 1).tolist()
    return rows


def _describe_losses(short_tracks: int) -> list[str]:
    losses = [
        "The bundle has no lane map: planners and traffic models that need one do not run on it.",
        "Where the rear axle is on the vehicle, and how large the vehicle is, is assumed: most logs do not say it.",
    ]
    if short_tracks:
        losses.append(f"{short_tracks} actors exist at one frame only, and are left out.")
    return losses


def _to_json(values: dict[str, Any]) -> bytes:
    return json.dumps(values, indent=1, allow_nan=False).encode()


def _to_yaml(values: dict[str, Any]) -> bytes:
    import yaml

    return yaml.safe_dump(values, sort_keys=False).encode()


def _write_zip(path: Path, files: dict[str, bytes]) -> None:
    # Stored and not compressed, as packages of this suffix are.
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for name, content in files.items():
            entry = zipfile.ZipInfo(name, _ZIP_DATE)
            entry.external_attr = _FILE_MODE
            archive.writestr(entry, content)
