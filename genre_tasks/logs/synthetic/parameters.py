"""What a user may ask of the synthetic street, parsed from the query of its URI."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields

from genre_tasks.errors import ConfigError

CAMERA_NAMES = (
    "front_camera",
    "front_left_camera",
    "front_right_camera",
    "left_camera",
    "right_camera",
    "back_camera",
)


@dataclass(frozen=True)
class StreetParameters:
    """All knobs; the default is the street that training and the demo use.

    ``seed`` draws everything; ``cameras`` takes the first N of ``CAMERA_NAMES``; ``samples`` sub-pixel rays (a square
    number); ``moving`` and ``pedestrians`` count actors; ``cuboids=0`` leaves annotations out, ``lidar=0`` the sweeps;
    ``standstill=1`` parks the ego vehicle; ``origin_m`` is added to the world's x; ``sweep_s`` is the time a LiDAR turn
    takes (0: a snapshot at the frame's time); ``noise_m`` is the standard deviation of the range; ``stride``: walking
    people's arms swing by so many times their legs' 24°, beyond 1 the legs do too (0: arms are still);
    ``pedestrians_aside_m``: people are so far to the sides of the ego lane's middle (0: on the pavements); ``gloss``:
    the strength of a sheen, sun and sky as a rough surface mirrors them, in images and truth alike.

    How the cameras record it (the truth has none of it but the lens): ``rolling_shutter_s`` from the first row to the
    last, ``exposure_s`` of motion blur, ``exposure_jitter`` and ``white_balance_jitter`` standard deviations of the
    log gain over cameras and time, ``bonnet`` the share of the front and back images that the vehicle itself covers,
    ``distortion`` the lens's k1 (below −0.08 the widest lens would fold).
    """

    seed: int = 0
    frames: int = 20
    cameras: int = 3
    width: int = 320
    height: int = 180
    samples: int = 4
    moving: int = 4
    pedestrians: int = 4
    cuboids: int = 1
    lidar: int = 1
    lidar_beams: int = 64
    lidar_azimuths: int = 900
    sweep_s: float = 0.1
    noise_m: float = 0.01
    stride: float = 0.0
    pedestrians_aside_m: float = 0.0
    standstill: int = 0
    origin_m: float = 0.0
    rolling_shutter_s: float = 0.0
    exposure_s: float = 0.0
    exposure_jitter: float = 0.0
    white_balance_jitter: float = 0.0
    bonnet: float = 0.0
    distortion: float = 0.0
    gloss: float = 0.0

    def query(self, *, all_keys: bool = False, separator: str = "&") -> str:
        """``seed=…`` and what differs from the defaults (or everything), in a fixed order."""
        parts = []
        for field in fields(self):
            value = getattr(self, field.name)
            if all_keys or field.name == "seed" or value != field.default:
                parts.append(f"{field.name}={value!r}")
        return separator.join(parts)


_RANGES: dict[str, tuple[float, float]] = {
    "seed": (0, 2**31 - 1),
    "frames": (1, 200),
    "cameras": (1, len(CAMERA_NAMES)),
    "width": (8, 1920),
    "height": (8, 1080),
    "samples": (1, 16),
    "moving": (0, 12),
    "pedestrians": (0, 20),
    "cuboids": (0, 1),
    "lidar": (0, 1),
    "lidar_beams": (1, 128),
    "lidar_azimuths": (4, 3600),
    "sweep_s": (0.0, 0.1),
    "noise_m": (0.0, 1.0),
    "stride": (0.0, 2.0),
    "pedestrians_aside_m": (0.0, 20.0),
    "standstill": (0, 1),
    "origin_m": (-1e8, 1e8),
    "rolling_shutter_s": (0.0, 0.1),
    "exposure_s": (0.0, 0.1),
    "exposure_jitter": (0.0, 1.0),
    "white_balance_jitter": (0.0, 0.5),
    "bonnet": (0.0, 0.5),
    "distortion": (-0.08, 0.5),
    "gloss": (0.0, 1.0),
}


def parse_parameters(query: Mapping[str, str]) -> StreetParameters:
    """Checks names, types and ranges; raises ``ConfigError`` that names the key and what would be right."""
    values: dict[str, int | float] = {}
    for key, text in query.items():
        if key not in _RANGES:
            near = difflib.get_close_matches(key, _RANGES, n=1)
            hint = f"Did you mean {near[0]}?" if near else f"Known: {', '.join(_RANGES)}."
            raise ConfigError(f"the synthetic street has no parameter {key!r}", remedy=hint)
        values[key] = _parse_value(key, text)
    parameters = StreetParameters(**values)  # type: ignore[arg-type]
    if math.isqrt(parameters.samples) ** 2 != parameters.samples:
        raise ConfigError(f"samples={parameters.samples} is no square number", remedy="Use 1, 4, 9 or 16.")
    return parameters


def _parse_value(key: str, text: str) -> int | float:
    kind = type(getattr(StreetParameters(), key))
    try:
        value = kind(text)
    except ValueError:
        word = "a whole number" if kind is int else "a number"
        raise ConfigError(f"{key}={text!r} is not {word}", remedy=f"Write {key}=N, for instance {key}=1.") from None
    low, high = _RANGES[key]
    if not low <= value <= high:
        raise ConfigError(f"{key}={text} is out of range", remedy=f"Choose {key} from {low:g} to {high:g}.")
    return value
