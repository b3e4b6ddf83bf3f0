"""The pictures of a chunk's report: the same viewpoint after each stage, with the truth and the errors against it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple
from urllib.parse import unquote

from flows.reconstruction.report.error_maps import ErrorMap, make_error_map
from flows.reconstruction.report.photos import EmbeddedImage, embed_photo
from flows.reconstruction.run_summary import ChunkSummary

_COLUMNS = (("initial", "Initial"), ("gnet", "GNet"), ("fnet", "Fixed"), ("enet", "ENet"))
_TRUTH = ".truth"


@dataclass(frozen=True)
class Picture:
    """A picture of one stage at one viewpoint.

    Attributes:
        label: what the picture shows.
        image: the picture; ``None`` if there is none.
        why: why there is none.
        error: the difference from the truth, where there is one.
    """

    label: str
    image: EmbeddedImage | None
    why: str = ""
    error: ErrorMap | None = None


@dataclass(frozen=True)
class Viewpoint:
    """A viewpoint after each stage.

    Attributes:
        name: of the pictures in the store.
        label: where it is, for readers.
        pictures: truth, initial scene, GNet, fixed image and ENet.
    """

    name: str
    label: str
    pictures: tuple[Picture, ...]

    @property
    def layers(self) -> list[tuple[str, EmbeddedImage]]:
        """(label, image) of all that can be laid over each other: pictures first, then errors."""
        errors = [(f"Error of {p.label}", p.error.image) for p in self.pictures if p.error is not None]
        return [(p.label, p.image) for p in self.pictures if p.image is not None] + errors

    @property
    def before(self) -> str:
        """Label of the layer that the comparison begins with on the left: what the enhancement starts from."""
        labels = [label for label, _ in self.layers]
        return next((label for label in ("GNet", "Initial", "Truth", *labels) if label in labels), "")

    @property
    def after(self) -> str:
        """Label of the layer on the right: the last result that is another one than ``before``."""
        labels = [label for label, _ in self.layers]
        others = [label for label in ("ENet", "Fixed", "GNet", "Truth", *labels) if label != self.before]
        return next((label for label in others if label in labels), self.before)


class _Place(NamedTuple):
    """The parts of a picture's name; ``shift`` as ``3m``, ``side`` empty on the path."""

    shift: str
    side: str
    camera: str
    frame: str


def build_viewpoints(chunk: ChunkSummary) -> list[Viewpoint]:
    """Arranges the pictures of a chunk.

    Args:
        chunk: a chunk whose stages may have ``pictures``.

    Returns:
        The viewpoints: for each camera, front cameras first, on the path, then left, then right.
    """
    pictures_by_stage = {stage.stage: stage.pictures for stage in chunk.stages}
    columns = [(label, pictures_by_stage.get(stage, {})) for stage, label in _COLUMNS]
    names = sorted({name.removesuffix(_TRUTH) for _, column in columns for name in column}, key=_view_order)
    viewpoints = []
    for name in names:
        # Every stage of a chunk stores the same true image; the first one that has it will do.
        truth = next((column[name + _TRUTH] for _, column in columns if name + _TRUTH in column), None)
        image = None if truth is None else embed_photo(truth)
        pictures = [Picture("Truth", image, "this log has no true image here")]
        for label, column in columns:
            on_path = name.startswith("0m_")
            why = "the fixer works beside the path" if label == "Fixed" and on_path else "no picture"
            pictures.append(_make_picture(label, column.get(name), truth, why))
        viewpoints.append(Viewpoint(name, describe_viewpoint(name), tuple(pictures)))
    return viewpoints


def describe_viewpoint(name: str) -> str:
    """Says for readers where a picture was taken.

    Args:
        name: of a picture in an evaluation.

    Returns:
        Shift, camera and frame.

    >>> describe_viewpoint("3m_left_front_camera_04")
    '3 m to the left · front camera · frame 4'
    >>> describe_viewpoint("0m_front=20camera_04")
    'On the path · front camera · frame 4'
    """
    shift, side, camera, frame = _parse_name(name)
    where = "On the path" if shift == "0m" else f"{shift.removesuffix('m')} m to the {side}"
    return f"{where} · {camera.replace('_', ' ')} · frame {frame.lstrip('0') or '0'}"


def _make_picture(label: str, png: bytes | None, truth: bytes | None, why: str) -> Picture:
    if png is None:
        return Picture(label, None, why)
    return Picture(label, embed_photo(png), error=None if truth is None else make_error_map(png, truth))


def _parse_name(name: str) -> _Place:
    """The parts of a picture's name like ``3m_left_front_camera_04`` or ``0m_front_camera_05``."""
    shift, _, rest = name.partition("_")
    # On the path there is no side: a name like 0m_left_camera_05 is of the camera to the left.
    side = next((s for s in ("left", "right") if shift != "0m" and rest.startswith(f"{s}_")), "")
    camera, _, frame = rest.removeprefix(f"{side}_" if side else "").rpartition("_")
    # Spaces and other characters of a camera are written as in a URL, with = for %.
    return _Place(shift, side, unquote(camera.replace("=", "%")), frame)


def _view_order(name: str) -> tuple[object, ...]:
    shift, side, camera, frame = _parse_name(name)
    # Shorter names first: front_camera before front_left_camera.
    return "front" not in camera, len(camera), camera, shift, side, frame
