"""Hard cases 45–48: logs as the world delivers them, each through the whole pipeline, in the PandaSet layout."""

from __future__ import annotations

import io
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest
from PIL import Image

from flows.configuration import load_configuration
from flows.pipeline.definition import PIPELINE
from flows.pipeline.stage_runner import ArtifactRef, Job, run_stage
from genre_tasks.errors import InputError
from genre_tasks.logs.pandaset.writer import write_pandaset
from genre_tasks.logs.registry import open_log
from genre_tasks.metrics.results import Evaluation
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.reconstruction import Reconstruction
from storage.opening import open_store
from tests.faults.small_run import SETTINGS

pytestmark = pytest.mark.slow
T = TypeVar("T")
STREET = "synthetic:street?seed=903&frames=9&width=64&height=36&lidar_beams=32&lidar_azimuths=300"


def delivered(folder: Path, query: str = "&cameras=2") -> Path:
    return write_pandaset(open_log(STREET + query), folder / "903")


def whole_run(folder: Path, log: Path | str, *settings: str, chunk: int = 0) -> dict[str, ArtifactRef]:
    """Every stage of one chunk; values must be finite throughout."""
    config = load_configuration("demo", settings=[*SETTINGS, *settings])
    uri = log if isinstance(log, str) else f"pandaset:{log}"
    job = Job(uri, chunk, str(folder / "store"), config.model_dump(mode="json"))
    refs: dict[str, ArtifactRef] = {}
    for spec in PIPELINE:
        refs[spec.name] = run_stage(spec.name, job, {name: refs[name] for name in spec.inputs})
    for stage in ("gnet", "enet"):
        scene = value(folder, refs[stage], Reconstruction).scene
        assert bool(scene.gaussians.pack().isfinite().all())
    for stage in ("initial", "gnet", "fnet", "enet"):
        found = value(folder, refs[f"evaluate/{stage}"], Evaluation)
        assert found.metrics and all(math.isfinite(m.value) for m in found.metrics)
    return refs


def value(folder: Path, ref: ArtifactRef, kind: type[T]) -> T:
    store = open_store(str(folder / "store"))
    (artifact,) = store.artifacts(key=ref.key)
    read = store.read(artifact)
    assert isinstance(read, kind)
    return read


def marks(folder: Path, refs: dict[str, ArtifactRef]) -> set[str]:
    return {mark.kind for mark in value(folder, refs["ingest"], Chunk).log_issues}


def _drop_sweep(log: Path) -> None:
    (log / "lidar/03.pkl.gz").unlink()


def _drop_image(log: Path) -> None:
    (log / "camera/front_camera/04.png").unlink()


def _truncate_image(log: Path) -> None:
    file = log / "camera/front_left_camera/04.png"
    file.write_bytes(file.read_bytes()[:200])


def _truncate_sweep(log: Path) -> None:
    file = log / "lidar/02.pkl.gz"
    file.write_bytes(file.read_bytes()[:1000])


@pytest.mark.parametrize(
    ("damage", "mark"),
    [
        (_drop_sweep, "missing_sweep"),
        (_drop_image, "missing_image"),
        (_truncate_image, "unreadable_image"),
        (_truncate_sweep, "unreadable_sweep"),
    ],
)
def test_a_hole_is_marked_and_the_run_goes_on(tmp_path: Path, damage: Callable[[Path], None], mark: str) -> None:
    log = delivered(tmp_path)
    damage(log)
    assert mark in marks(tmp_path, whole_run(tmp_path, log))
    with pytest.raises(InputError, match="frame"):
        whole_run(tmp_path, log, "ingest.strict=true")


def test_a_short_last_chunk(tmp_path: Path) -> None:
    log = delivered(tmp_path)
    refs = whole_run(tmp_path, log, "ingest.chunk_frames=4", "ingest.source_every=2", chunk=1)
    assert value(tmp_path, refs["ingest"], Chunk).frames == (4, 5, 6, 7)
    with pytest.raises(InputError, match="source"):
        whole_run(tmp_path, log, "ingest.chunk_frames=4", "ingest.source_every=2", chunk=2)


def test_no_cuboids_and_one_camera(tmp_path: Path) -> None:
    log = delivered(tmp_path, "&cameras=1")
    shutil.rmtree(log / "annotations")
    refs = whole_run(tmp_path, log)
    assert value(tmp_path, refs["ingest"], Chunk).actors == ()


def test_no_lidar_at_all_asks_for_points_and_goes_on_with_them(tmp_path: Path) -> None:
    log = delivered(tmp_path)
    sweep = open_log(STREET + "&cameras=2").sweep(0)
    assert sweep is not None
    for file in (log / "lidar").glob("*.pkl.gz"):
        file.unlink()
    with pytest.raises(InputError, match=r"ingest\.points"):
        whole_run(tmp_path, log)
    points = sweep.points_world[::3]
    lines = ["ply", "format ascii 1.0", f"element vertex {len(points)}"]
    lines += [f"property double {axis}" for axis in "xyz"] + ["end_header"]
    lines += [" ".join(repr(float(c)) for c in p) for p in points]
    (tmp_path / "points.ply").write_text("\n".join(lines) + "\n")
    whole_run(tmp_path, log, f"ingest.points={tmp_path / 'points.ply'}")


def test_an_ego_vehicle_that_stands_still(tmp_path: Path) -> None:
    refs = whole_run(tmp_path, STREET + "&cameras=2&standstill=1")
    assert "standstill" in marks(tmp_path, refs)


def test_a_camera_that_sees_its_own_bonnet(tmp_path: Path) -> None:
    log = delivered(tmp_path)
    for file in (log / "camera/front_left_camera").glob("*.png"):
        pixels = np.array(Image.open(io.BytesIO(file.read_bytes())))
        pixels[-8:] = (20, 22, 30)
        Image.fromarray(pixels).save(file)
    assert set(whole_run(tmp_path, log)) == {spec.name for spec in PIPELINE}
