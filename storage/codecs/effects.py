"""Plan of effects ↔ ``effects.parquet``, a row an effect; what those that are on need to be
applied: ``gains.parquet``, ``shutters.parquet``, ``blurs.parquet``, ``own/CAMERA.png``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from genre_tasks.effects.types import Decision, EffectsPlan, Fitted
from genre_tasks.logs.types import MotionBlur, RollingShutter
from storage.codecs.png import read_png, write_png
from storage.codecs.tables import column, read_table, schema, write_table

_CHANNELS = ("red", "green", "blue")
EFFECTS = schema(
    "effects/1",
    [
        column("name", pa.string(), "the effect"),
        column("property", pa.string(), "what of the log decides"),
        column("value", pa.float64(), "in the unit; NaN where the log does not tell or nothing was measured"),
        column("unit", pa.string(), "of value and threshold"),
        column("threshold", pa.float64(), "called for above it; NaN where nothing was measured"),
        column("setting", pa.string(), "auto, on or off: what was configured"),
        column("choice", pa.string(), "on, off, or mark: told, not modelled"),
        column("reason", pa.string(), "why"),
        column("cost", pa.string(), "what enabling costs"),
    ],
)

GAINS = schema(
    "gains/1",
    [
        column("camera", pa.string(), "name"),
        column("frame", pa.int64(), "frame of the log"),
        *(column(c, pa.float64(), "natural logarithm of the image's gain in linear light") for c in _CHANNELS),
    ],
)

_MOTION = ("velocity_x", "velocity_y", "velocity_z", "turn_x", "turn_y", "turn_z")
SHUTTERS = schema(
    "shutters/1",
    [
        column("camera", pa.string(), "name"),
        column("frame", pa.int64(), "frame of the log"),
        column("readout_s", pa.float64(), "seconds from the first row to the last"),
        column("frame_s", pa.float64(), "seconds to the next frame; 0: not stated"),
        *(column(n, pa.float64(), "of the camera in its own axes, m/s or rad/s") for n in _MOTION),
    ],
)

BLURS = schema(
    "blurs/1",
    [
        column("camera", pa.string(), "name"),
        column("frame", pa.int64(), "frame of the log"),
        column("exposure_s", pa.float64(), "seconds for which the shutter is open"),
        column("frame_s", pa.float64(), "seconds to the next frame; 0: not stated"),
        *(column(n, pa.float64(), "of the camera in its own axes, m/s or rad/s") for n in _MOTION),
    ],
)


def write(folder: Path, value: EffectsPlan) -> None:
    """Write the table, the gains and a picture of the vehicle itself a camera: white where it is."""
    rows = {name: [getattr(d, name) for d in value.decisions] for name in EFFECTS.names}
    write_table(folder / "effects.parquet", EFFECTS, rows)
    images, gains = list(value.fitted.gains), np.array(list(value.fitted.gains.values())).reshape(-1, 3)
    which = {"camera": [camera for camera, _ in images], "frame": [frame for _, frame in images]}
    write_table(folder / "gains.parquet", GAINS, which | {c: gains[:, k] for k, c in enumerate(_CHANNELS)})
    write_table(folder / "shutters.parquet", SHUTTERS, _motions(value.fitted.shutters, "readout_s"))
    write_table(folder / "blurs.parquet", BLURS, _motions(value.fitted.blurs, "exposure_s"))
    if value.fitted.own:
        (folder / "own").mkdir()
    for camera, own in value.fitted.own.items():
        write_png(folder / "own" / f"{camera}.png", np.repeat(np.uint8(255) * own[..., None], 3, 2))


def read(folder: Path, measurements: Mapping[str, Any] | None = None) -> EffectsPlan:
    """The plan, in its order."""
    table, _ = read_table(folder / "effects.parquet", EFFECTS)
    rows = read_table(folder / "gains.parquet", GAINS)[0].to_pylist()
    gains = {(row["camera"], row["frame"]): (row["red"], row["green"], row["blue"]) for row in rows}
    own = {path.stem: read_png(path)[..., 0] > 0 for path in sorted((folder / "own").glob("*.png"))}
    shutters = {
        (row["camera"], row["frame"]): RollingShutter(row["readout_s"], *_motion(row), row["frame_s"])
        for row in read_table(folder / "shutters.parquet", SHUTTERS)[0].to_pylist()
    }
    blurs = {
        (row["camera"], row["frame"]): MotionBlur(row["exposure_s"], *_motion(row), row["frame_s"])
        for row in read_table(folder / "blurs.parquet", BLURS)[0].to_pylist()
    }
    return EffectsPlan(tuple(Decision(**row) for row in table.to_pylist()), Fitted(gains, own, shutters, blurs))


def _motions(
    moving: Mapping[tuple[str, int], RollingShutter] | Mapping[tuple[str, int], MotionBlur], time: str
) -> dict[str, Any]:
    """Columns; ``time`` names what it is that takes the time."""
    rates = np.array([[*m.velocity_m_s, *m.turn_rad_s] for m in moving.values()]).reshape(-1, 6)
    rows = {"camera": [camera for camera, _ in moving], "frame": [frame for _, frame in moving]}
    rows |= {name: [getattr(m, name) for m in moving.values()] for name in (time, "frame_s")}
    return rows | {n: rates[:, k] for k, n in enumerate(_MOTION)}


def _motion(row: Mapping[str, Any]) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    vx, vy, vz, wx, wy, wz = (row[n] for n in _MOTION)
    return (vx, vy, vz), (wx, wy, wz)


def measurements(value: EffectsPlan) -> dict[str, Any]:
    """Nothing: all of it follows from the log."""
    return {}
