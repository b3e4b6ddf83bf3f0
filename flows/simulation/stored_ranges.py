"""The reliable range of a run's scenes, computed once and then read from the run's folder in the store."""

from __future__ import annotations

import json
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from flows.simulation.run_scenes import RunScenes
from genre_tasks.atomic_path import write_atomically
from genre_tasks.config import RangeConfig
from genre_tasks.effects.types import DEFAULT_PLAN
from genre_tasks.errors import GenreError
from genre_tasks.progress import Progress
from genre_tasks.reliability.reliable_range import estimate_reliable_range
from storage.code_digest import code_digest
from storage.keys import digest_value

_log = logging.getLogger(__name__)

# Coarser than `genre range`: marks need the distance to half a metre, and every shift is rendered for all cameras.
MARKS_CONFIG = RangeConfig(shifts_m=(1.0, 2.0, 3.0, 4.0), every=10)

_Metres = Annotated[float, Field(ge=0, allow_inf_nan=False)]


@dataclass(frozen=True)
class SideRange:
    """How far to the sides of the path a scene can be trusted.

    Attributes:
        left_m: metres to the left.
        right_m: metres to the right.
    """

    left_m: float
    right_m: float


class _RangeRecord(BaseModel):
    # Strict, so that a truth value or a text is no number.
    model_config = ConfigDict(strict=True)

    left_m: _Metres
    right_m: _Metres


def find_side_ranges(scenes: RunScenes, progress: Progress) -> dict[int, SideRange]:
    """Reads the reliable range of each chunk's scene, or computes it where none is stored or the file is damaged.

    Args:
        scenes: of a run, as they were reconstructed.
        progress: called while a range is computed.

    Returns:
        The ranges by the chunk's number.

    Raises:
        InputError: an image of a chunk cannot be decoded.
    """
    code = code_digest("genre_tasks.reliability.reliable_range")
    folder = scenes.folder / "ranges"
    ranges: dict[int, SideRange] = {}
    for number in scenes.chunk_numbers:
        digests = {name: d for name, d in scenes.payload_digests().items() if name.startswith(f"chunk {number} ")}
        parts = {"code": code, "configuration": MARKS_CONFIG.model_dump(mode="json"), "inputs": digests}
        file = folder / f"chunk-{number}-{digest_value(parts)[:16]}.json"
        stored = _read_range(file)
        if stored is not None:
            ranges[number] = stored
            continue
        loaded = scenes.load(number)
        found = estimate_reliable_range(MARKS_CONFIG, loaded.chunk, loaded.scene, DEFAULT_PLAN, progress)
        ranges[number] = SideRange(found.left_m, found.right_m)
        text = json.dumps({"left_m": found.left_m, "right_m": found.right_m})
        # A store that may only be read serves simulations too: they find the range again each time.
        try:
            write_atomically(file, text.encode())
            scenes.push_folder()
        except (OSError, GenreError) as error:
            _log.warning("the reliable range of chunk %d is not kept for the next simulation: %s", number, error)
    return ranges


def _read_range(file: Path) -> SideRange | None:
    try:
        record = _RangeRecord.model_validate_json(file.read_bytes())
    except FileNotFoundError:
        return None
    except (OSError, ValidationError):
        # Computing takes a minute; an error would stop all simulations of the run until somebody removes the file.
        _log.warning("the stored reliable range %s cannot be read, and is computed again", file)
        return None
    return SideRange(record.left_m, record.right_m)
