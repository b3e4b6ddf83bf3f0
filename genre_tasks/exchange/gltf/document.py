"""The JSON of a glTF file, as far as Gaussians and their motion need it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic.alias_generators import to_camel

from genre_tasks.errors import InputError

SPLATTING = "KHR_gaussian_splatting"
"""The extension of primitives that are Gaussians, and the prefix of their attributes."""

VISIBILITY = "KHR_node_visibility"
"""The extension of nodes that are hidden with all that is below them."""

EXTRAS_KEY = "genre"
"""Under this name ``extras`` hold what glTF has no place for."""

MOST_JSON_BYTES = 16 << 20
"""No longer JSON is parsed: values take many times their text in memory, and nodes and names need little."""

# Required by files that are read all the same: what they add is either read here or does not concern Gaussians.
_READABLE_EXTENSIONS = {SPLATTING, "KHR_mesh_quantization", VISIBILITY, "KHR_materials_unlit"}
_REMEDY = "Export the file again, or check it with a glTF validator."

_Item = TypeVar("_Item")

Index = Annotated[int, Field(ge=0)]
Number = Annotated[float, Field(allow_inf_nan=False)]
Vector3 = Annotated[list[Number], Field(min_length=3, max_length=3)]
Vector4 = Annotated[list[Number], Field(min_length=4, max_length=4)]
Matrix4 = Annotated[list[Number], Field(min_length=16, max_length=16)]


class _Part(BaseModel):
    # Strict: text that looks like a number is no number in glTF.
    model_config = ConfigDict(alias_generator=to_camel, strict=True, frozen=True, extra="ignore")


class Asset(_Part):
    """What the file says of itself."""

    version: str
    extras: Any = None


class Buffer(_Part):
    """Bytes: those of the file's binary part, where no ``uri`` is named."""

    byte_length: Index
    uri: str | None = None


class BufferView(_Part):
    """A range of a buffer."""

    buffer: Index
    byte_length: Index
    byte_offset: Index = 0
    byte_stride: Annotated[int, Field(ge=4, le=252)] | None = None


class SparseIndices(_Part):
    """Which elements of an accessor are replaced."""

    buffer_view: Index
    component_type: int
    byte_offset: Index = 0


class SparseValues(_Part):
    """What these elements are replaced with."""

    buffer_view: Index
    byte_offset: Index = 0


class Sparse(_Part):
    """Elements of an accessor that differ from its view, or from zero."""

    count: Annotated[int, Field(ge=1)]
    indices: SparseIndices
    values: SparseValues


class Accessor(_Part):
    """An array of numbers or vectors in a view; all zero without one."""

    component_type: int
    count: Annotated[int, Field(ge=1)]
    type: str
    buffer_view: Index | None = None
    byte_offset: Index = 0
    normalized: bool = False
    sparse: Sparse | None = None


class Primitive(_Part):
    """Part of a mesh; Gaussians are points with the extension ``SPLATTING``."""

    attributes: dict[str, Index]
    mode: int = 4
    extensions: dict[str, Any] = {}


class Mesh(_Part):
    """Primitives that are placed by the nodes which name the mesh."""

    primitives: list[Primitive]


class Node(_Part):
    """A place in the scene."""

    name: str = ""
    children: list[Index] = []
    mesh: Index | None = None
    matrix: Matrix4 | None = None
    translation: Vector3 = [0.0, 0.0, 0.0]
    rotation: Vector4 = [0.0, 0.0, 0.0, 1.0]
    scale: Vector3 = [1.0, 1.0, 1.0]
    extensions: dict[str, Any] = {}
    extras: Any = None

    @property
    def is_hidden(self) -> bool:
        """Whether the node is not shown, and nothing below it."""
        visibility = self.extensions.get(VISIBILITY)
        return isinstance(visibility, dict) and visibility.get("visible") is False


class Scene(_Part):
    """The nodes that stand on their own."""

    nodes: list[Index] = []


class Target(_Part):
    """What a channel moves."""

    path: str
    node: Index | None = None


class Channel(_Part):
    """A sampler and what it moves."""

    sampler: Index
    target: Target


class Sampler(_Part):
    """Values at times, and how those between are found."""

    input: Index
    output: Index
    interpolation: Literal["LINEAR", "STEP", "CUBICSPLINE"] = "LINEAR"


class Animation(_Part):
    """Channels that are played together."""

    channels: list[Channel]
    samplers: list[Sampler]


class Document(_Part):
    """A file's JSON."""

    asset: Asset
    accessors: list[Accessor] = []
    animations: list[Animation] = []
    buffers: list[Buffer] = []
    buffer_views: list[BufferView] = []
    extensions_required: list[str] = []
    meshes: list[Mesh] = []
    nodes: list[Node] = []
    scenes: list[Scene] = []
    scene: Index | None = None


def parse_document(path: Path, text: bytes) -> Document:
    """Reads a file's JSON.

    Args:
        path: of the file, for errors.
        text: of at most ``MOST_JSON_BYTES``.

    Returns:
        The document. Indices into its lists are not checked yet.

    Raises:
        InputError: it is no JSON, lacks something, has a value of another kind than glTF says, or requires an
            extension that is not read.
    """
    try:
        # The parser's recursion has a limit, and so have whole numbers: both end as errors, and not as a crash.
        parsed = json.loads(text, parse_constant=_refuse_constant)
        document = Document.model_validate(parsed)
    except RecursionError as error:
        raise InputError("the file's JSON is nested too deeply", remedy=_REMEDY, file=path) from error
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])[:200]
        raise InputError(f"the file's JSON is no glTF: {place}: {first['msg']}", remedy=_REMEDY, file=path) from error
    except ValueError as error:
        raise InputError("the file's JSON cannot be parsed", remedy=_REMEDY, file=path) from error
    if not document.asset.version.startswith("2."):
        raise InputError("the file is not glTF 2", remedy="Convert it to glTF 2.0.", file=path)
    unknown = sorted(set(document.extensions_required) - _READABLE_EXTENSIONS)
    if unknown:
        problem = f"the file requires the extension {unknown[0][:80]}"
        raise InputError(problem, remedy="Export it without compression or other extensions.", file=path)
    return document


def _refuse_constant(name: str) -> None:
    raise ValueError(f"expected a number, got {name}")


def pick(path: Path, items: Sequence[_Item], index: int, what: str) -> _Item:
    """Takes an element that the file refers to by its index.

    Args:
        path: of the file, for the error.
        items: a list of the document.
        index: not negative.
        what: an element's name, for the error.

    Raises:
        InputError: there is no such element.
    """
    if index >= len(items):
        raise InputError(f"the file refers to {what} {index} of {len(items)}", remedy=_REMEDY, file=path)
    return items[index]
