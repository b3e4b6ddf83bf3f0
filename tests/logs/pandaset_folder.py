"""Small PandaSet folders to break in tests."""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.findings import Finding
from genre_tasks.logs.pandaset.pickle_reader import read_table
from genre_tasks.logs.pandaset.pickle_writer import pickle_table
from genre_tasks.logs.pandaset.reader import PandaSetLog, open_pandaset
from tests.fakes import FakeLog

FRAMES = 4


def small_log() -> FakeLog:
    """4 frames, two cameras of 48 × 32, a few hundred LiDAR points."""
    return FakeLog(frame_count=FRAMES, width_px=48, height_px=32, lidar_rings=12, lidar_azimuths=60)


def edit_json(path: Path, change: Callable[[Any], Any]) -> None:
    """Replaces a file's JSON value by ``change(value)``, or by the value changed in place where that is ``None``."""
    value = json.loads(path.read_text())
    changed = change(value)
    path.write_text(json.dumps(value if changed is None else changed))


def write_table(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(gzip.compress(pickle_table(columns)))


def edit_table(path: Path, **changed: NDArray[Any] | None) -> None:
    """Replaces columns of a table; ``None`` drops one."""
    columns = dict(read_table(path).columns)
    for name, values in changed.items():
        if values is None:
            del columns[name]
        else:
            columns[name] = values
    write_table(path, columns)


def cuboids(*rows: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
    """A cuboid table: each row overrides the defaults below."""
    default = {"uuid": "a", "label": "Car", "yaw": 0.0, "stationary": True, "attributes.object_motion": "Parked"}
    default |= {f"position.{axis}": 0.0 for axis in "xyz"}
    default |= {"dimensions.x": 2.0, "dimensions.y": 4.0, "dimensions.z": 1.5}
    default |= {"cuboids.sibling_id": "-", "cuboids.sensor_id": -1, "attributes.pedestrian_behavior": float("nan")}
    full = [{**default, **row} for row in rows]
    kinds = {str: object, float: np.float64, int: np.int64, bool: bool}
    mixed = ("attributes.object_motion", "attributes.pedestrian_behavior")
    return {
        name: np.array([row[name] for row in full], dtype=object if name in mixed else kinds[type(default[name])])
        for name in default
    }


def opened(folder: Path) -> PandaSetLog:
    return open_pandaset(str(folder))


def findings(log: PandaSetLog) -> dict[str, Finding]:
    return {finding.word: finding for finding in log.findings()}
