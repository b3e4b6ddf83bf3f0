"""The pictures of a chunk's report: the same viewpoint after each stage, beside the truth."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from typing import NamedTuple

from flows.reconstruction.run_summary import ChunkSummary

_COLUMNS = (("gnet", "GNet"), ("fnet", "Fixed"), ("enet", "ENet"))
_TRUTH = ".truth"


@dataclass(frozen=True)
class Picture:
    """A picture of one stage at one viewpoint.

    Attributes:
        label: what the picture shows.
        url: the picture as a ``data:`` URL; empty if there is none.
        why: why there is none.
    """

    label: str
    url: str
    why: str = ""


class _Viewpoint(NamedTuple):
    """The parts of a picture's name; ``shift`` as ``3m``, ``side`` empty on the path."""

    shift: str
    side: str
    camera: str
    frame: str


def build_picture_rows(chunk: ChunkSummary) -> list[tuple[str, list[Picture]]]:
    """Arranges the pictures of a chunk: a row for each viewpoint, with truth, GNet, fixed image and ENet.

    Args:
        chunk: a chunk whose stages may have ``pictures``.

    Returns:
        (viewpoint for readers, pictures): for each camera, front cameras first, on the path, then left, then right.
    """
    pictures_by_stage = {stage.stage: stage.pictures for stage in chunk.stages}
    columns = [(label, pictures_by_stage.get(stage, {})) for stage, label in _COLUMNS]
    names = sorted({name.removesuffix(_TRUTH) for _, column in columns for name in column}, key=_view_order)
    rows = []
    for name in names:
        # Every stage of a chunk stores the same true image; the first one that has it will do.
        truth = next((column[name + _TRUTH] for _, column in columns if name + _TRUTH in column), None)
        pictures = [Picture("Truth", _data_url(truth), "this log has no true image here")]
        for label, column in columns:
            on_path = name.startswith("0m_")
            why = "the fixer works beside the path" if label == "Fixed" and on_path else "no picture"
            pictures.append(Picture(label, _data_url(column.get(name)), why))
        rows.append((_view_label(name), pictures))
    return rows


def _parse_name(name: str) -> _Viewpoint:
    """The parts of a picture's name like ``3m_left_front_camera_04`` or ``0m_front_camera_05``."""
    shift, _, rest = name.partition("_")
    # On the path there is no side: a name like 0m_left_camera_05 is of the camera to the left.
    side = next((s for s in ("left", "right") if shift != "0m" and rest.startswith(f"{s}_")), "")
    camera, _, frame = rest.removeprefix(f"{side}_" if side else "").rpartition("_")
    return _Viewpoint(shift, side, camera, frame)


def _view_order(name: str) -> tuple[object, ...]:
    shift, side, camera, frame = _parse_name(name)
    # Shorter names first: front_camera before front_left_camera.
    return "front" not in camera, len(camera), camera, shift, side, frame


def _view_label(name: str) -> str:
    shift, side, camera, frame = _parse_name(name)
    where = "On the path" if shift == "0m" else f"{shift.removesuffix('m')} m to the {side}"
    return f"{where} · {camera.replace('_', ' ')} · frame {frame.lstrip('0') or '0'}"


def _data_url(png: bytes | None) -> str:
    # Inside the page, so that the report stays one file.
    return "" if png is None else "data:image/png;base64," + base64.b64encode(png).decode()
