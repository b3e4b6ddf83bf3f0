"""What a user may ask of the synthetic street, parsed from the query of its URI."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import Field, dataclass, field, fields
from typing import Any, TypeVar, cast

from genre_tasks.errors import ConfigError
from genre_tasks.logs.pandaset.layout import RIG_ORDER
from genre_tasks.suggestions import did_you_mean

# The rig is PandaSet's.
CAMERA_NAMES = RIG_ORDER

Number = TypeVar("Number", int, float)


# Default and range stand with the parameter, so that neither can be forgotten.
def _number(default: Number, low: float, high: float) -> Number:
    """A field with its default and the range that a user may choose from."""
    number: Number = field(default=default, metadata={"range": (low, high)})
    return number


@dataclass(frozen=True)
class StreetParameters:
    """All parameters of a street, by their keys in the URI; the default is the street that training and the demo use.

    The last ones say how the cameras record the street. The truth shows none of that but the lens.

    Attributes:
        seed: draws everything.
        frames: of the log, at 10 Hz.
        cameras: takes the first N of ``CAMERA_NAMES``.
        width: of an image, pixels.
        height: of an image, pixels.
        samples: rays per pixel, a square number.
        moving: cars that drive.
        pedestrians: people, every fourth of whom stands.
        cuboids: 0 leaves annotations out.
        lidar: 0 leaves the sweeps out.
        lidar_beams: beams of the LiDAR.
        lidar_azimuths: directions in which each beam measures in one turn.
        sweep_s: time that a LiDAR turn takes; 0: a snapshot at the frame's time.
        noise_m: standard deviation of the LiDAR's range, metres.
        stride: walking people's arms swing by so many times their legs' 24°, beyond 1 the legs do too; 0: still arms.
        pedestrians_aside_m: people's distance to the sides of the ego lane's centre; 0: on the pavements.
        standstill: 1 parks the ego vehicle.
        origin_m: added to the world's x.
        rolling_shutter_s: seconds from the first row of an image to the last.
        exposure_s: seconds for which the shutter is open, which blurs motion.
        exposure_jitter: standard deviation of the log gain over cameras and time.
        white_balance_jitter: the same for what differs between red, green and blue.
        bonnet: share of the front and back images that the vehicle itself covers.
        distortion: the lens's k1; below −0.08 the widest lens would fold.
        pose_noise_deg: standard deviation of the angle by which recorded camera poses err.
        pose_noise_m: the same for their position, metres.
        camera_delay_s: images are taken so many seconds later than the log says.
        gloss: strength of a sheen, sun and sky as a rough surface mirrors them, in images and truth alike.
    """

    seed: int = _number(0, 0, 2**31 - 1)
    frames: int = _number(20, 1, 200)
    cameras: int = _number(3, 1, len(CAMERA_NAMES))
    width: int = _number(320, 8, 1920)
    height: int = _number(180, 8, 1080)
    samples: int = _number(4, 1, 16)
    moving: int = _number(4, 0, 12)
    pedestrians: int = _number(4, 0, 20)
    cuboids: int = _number(1, 0, 1)
    lidar: int = _number(1, 0, 1)
    lidar_beams: int = _number(64, 1, 128)
    lidar_azimuths: int = _number(900, 4, 3600)
    sweep_s: float = _number(0.1, 0.0, 0.1)
    noise_m: float = _number(0.01, 0.0, 1.0)
    stride: float = _number(0.0, 0.0, 2.0)
    pedestrians_aside_m: float = _number(0.0, 0.0, 20.0)
    standstill: int = _number(0, 0, 1)
    origin_m: float = _number(0.0, -1e8, 1e8)
    rolling_shutter_s: float = _number(0.0, 0.0, 0.1)
    exposure_s: float = _number(0.0, 0.0, 0.1)
    exposure_jitter: float = _number(0.0, 0.0, 1.0)
    white_balance_jitter: float = _number(0.0, 0.0, 0.5)
    bonnet: float = _number(0.0, 0.0, 0.5)
    distortion: float = _number(0.0, -0.08, 0.5)
    gloss: float = _number(0.0, 0.0, 1.0)
    pose_noise_deg: float = _number(0.0, 0.0, 5.0)
    pose_noise_m: float = _number(0.0, 0.0, 1.0)
    camera_delay_s: float = _number(0.0, -0.1, 0.1)

    def query(self, *, all_keys: bool = False, separator: str = "&") -> str:
        """Formats the parameters as a query, which names the street.

        Args:
            all_keys: write every parameter, not only the seed and what differs from the defaults.
            separator: between two parameters.

        Returns:
            ``key=value`` in a fixed order.

        >>> StreetParameters(seed=7, frames=10).query()
        'seed=7&frames=10'
        """
        parts = []
        for parameter in fields(self):
            value = getattr(self, parameter.name)
            # The name of a log must not change when a parameter with a default is added.
            if all_keys or parameter.name == "seed" or value != parameter.default:
                parts.append(f"{parameter.name}={value!r}")
        return separator.join(parts)


_KNOWN: dict[str, Field[Any]] = {parameter.name: parameter for parameter in fields(StreetParameters)}


def parse_parameters(query: Mapping[str, str]) -> StreetParameters:
    """Checks the names, types and ranges of a query.

    Args:
        query: key → text, as in a URI.

    Returns:
        The parameters, with defaults for what the query does not name.

    Raises:
        ConfigError: an unknown key, or a value that does not fit (names the key and what would be right).

    >>> parse_parameters({"seed": "7"}).seed
    7
    >>> parse_parameters({"sede": "7"})
    Traceback (most recent call last):
    ...
    genre_tasks.errors.ConfigError: the synthetic street has no parameter 'sede'. Did you mean 'seed'?
    """
    values: dict[str, int | float] = {}
    for key, text in query.items():
        if key not in _KNOWN:
            remedy = did_you_mean(key, _KNOWN) or f"Known: {', '.join(_KNOWN)}."
            raise ConfigError(f"the synthetic street has no parameter {key!r}", remedy=remedy.strip())
        values[key] = _parse_value(_KNOWN[key], text)
    parameters = StreetParameters(**values)  # type: ignore[arg-type]
    # Samples lie on a square grid within the pixel.
    if math.isqrt(parameters.samples) ** 2 != parameters.samples:
        raise ConfigError(f"samples={parameters.samples} is no square number", remedy="Use 1, 4, 9 or 16.")
    return parameters


def _parse_value(parameter: Field[Any], text: str) -> int | float:
    key = parameter.name
    kind = type(cast("int | float", parameter.default))
    try:
        value: int | float = kind(text)
    except ValueError:
        word = "a whole number" if kind is int else "a number"
        raise ConfigError(f"{key}={text!r} is not {word}", remedy=f"Write {key}=N, for instance {key}=1.") from None
    low, high = parameter.metadata["range"]
    # A NaN is in no range.
    if not low <= value <= high:
        raise ConfigError(f"{key}={text} is out of range", remedy=f"Choose {key} from {low:g} to {high:g}.")
    return value
