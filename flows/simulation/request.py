"""What a simulation is asked for, as plain values that a key can be computed of."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from flows.configuration.settings import keys_overlap
from genre_tasks.ego_paths.behaviour_request import Side
from genre_tasks.errors import ConfigError
from genre_tasks.scene_edits.edits import EditList
from genre_tasks.suggestions import did_you_mean

SENSORS = ("rgb", "depth", "masks", "flow", "lidar")
"""What can be simulated: films, depth, instance and class masks, optical flow, LiDAR sweeps."""

_KEYS_READ = ("simulate", "fnet", "novel_views.lidar_max_points")


@dataclass(frozen=True)
class SimulationRequest:
    """One rollout of a finished run.

    Attributes:
        store: folder (or URI) of the store.
        run: the run's name, or the start of it.
        out: the folder to write.
        stage: initial, gnet or enet; ``None``: the last one of each chunk.
        chunks: numbers of the chunks; ``None``: all.
        behaviour: one of ``BEHAVIOURS``; ``None``: as recorded, or as in ``path_file``.
        path_file: a Parquet or JSON file with the poses of the ego vehicle.
        start_offset_m: where a behaviour starts, metres to the left of the recorded path; ``None``: as configured for
            a behaviour, 0 for the recorded path.
        strength: of the behaviour; 1 is the configured one.
        delay_s: seconds of recorded driving before the behaviour starts.
        side: of a lane change or swerve; ``None``: the behaviour chooses.
        cameras: names; ``None``: all of the rig.
        edits: of the traffic.
        sensors: of ``SENSORS``.
        fix: whether FNet repairs all images; otherwise it fills what removed actors hid.
        allow_collision: whether a path through an actor is rendered all the same.
        allow_implausible: whether a path that no vehicle can drive is rendered all the same.
        mark_range: whether poses are marked that lie outside of the scenes' reliable range.
        settings: ``section.key=value`` over the run's configuration.
        exr: whether scene-linear images are written too.
        png: whether display-referred images are written too.
        overwrite: whether another rollout in ``out`` is replaced.
    """

    store: str
    run: str
    out: Path
    stage: str | None = None
    chunks: tuple[int, ...] | None = None
    behaviour: str | None = None
    path_file: Path | None = None
    start_offset_m: float | None = None
    strength: float = 1.0
    delay_s: float = 0.0
    side: Side | None = None
    cameras: tuple[str, ...] | None = None
    edits: EditList = field(default_factory=EditList)
    sensors: tuple[str, ...] = ("rgb",)
    fix: bool = False
    allow_collision: bool = False
    allow_implausible: bool = False
    mark_range: bool = True
    settings: tuple[str, ...] = ()
    exr: bool = False
    png: bool = False
    overwrite: bool = False

    def check(self) -> None:
        """Checks what needs no run to be read.

        Raises:
            ConfigError: a sensor is unknown, a number is not finite, or two values do not go together.
        """
        for sensor in self.sensors:
            if sensor not in SENSORS:
                remedy = f"{did_you_mean(sensor, SENSORS)}Known: {', '.join(SENSORS)}."
                raise ConfigError(f"no sensor is called '{sensor}'", remedy=remedy)
        for name, value in (("--strength", self.strength), ("--delay", self.delay_s)):
            if not math.isfinite(value):
                raise ConfigError(f"{name} is {value:g}", remedy="Give a finite number.")
        for setting in self.settings:
            key = setting.partition("=")[0].strip()
            if key and not any(keys_overlap(key, read) for read in _KEYS_READ):
                remedy = (
                    "Set keys of simulate and fnet, or novel_views.lidar_max_points; others are those of `genre run`."
                )
                raise ConfigError(f"{key} changes nothing of a simulation", remedy=remedy)
        if self.behaviour is not None and self.path_file is not None:
            raise ConfigError("--behaviour and --path both say how to drive", remedy="Give one of them.")
        if self.path_file is not None and self.start_offset_m is not None:
            raise ConfigError("--start-offset does not go with --path", remedy="Move the poses in the file.")
        if self.behaviour is None and (self.strength != 1.0 or self.delay_s or self.side is not None):
            remedy = "Give a --behaviour, or leave --strength, --delay and --side out."
            raise ConfigError("strength, delay and side are those of a behaviour", remedy=remedy)

    def key_values(self) -> dict[str, Any]:
        """Gives what of the request decides on the files, as JSON values.

        Returns:
            All but the places that are read and written; edits and files are digested elsewhere.
        """
        return {
            "behaviour": self.behaviour,
            "start_offset_m": self.start_offset_m,
            "strength": self.strength,
            "delay_s": self.delay_s,
            "side": self.side,
            "sensors": sorted(self.sensors),
            "fix": self.fix,
            "cameras": None if self.cameras is None else list(self.cameras),
            # Whether a faulty path is refused changes no file: the files hold what was found.
            "mark_range": self.mark_range,
            "exr": self.exr,
            "png": self.png,
        }
