"""Exported folders: files of Gaussians, and ``scene.json`` with what their format may not carry."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from genre_tasks.errors import InputError
from genre_tasks.exchange.file_digests import DOCUMENT_ENTRY, digest_contents, insert_digest
from genre_tasks.exchange.moments import Frame, is_rising
from genre_tasks.exchange.registry import find_format, load_format
from genre_tasks.exchange.types import ExchangeNode, ExchangeScene, NodeMotion
from genre_tasks.json_files import read_json_object
from genre_tasks.logs.types import Float64

SCENE_FILE = "scene.json"
"""Name of the document in an exported folder."""

KIND = "genre-scene"
VERSION = 1

_MOST_BYTES = 256 << 20
_REMEDY = "Export the scene again, or give one of its files."

Finite = Annotated[float, Field(allow_inf_nan=False)]
Row = tuple[Finite, Finite, Finite, Finite]
Matrix = tuple[Row, Row, Row, Row]
Layout = Literal["nodes", "scenes", "frames"]
"""A file for each node in its own coordinates, one for each chunk, or one for each moment of a chunk."""


class MotionEntry(BaseModel):
    """A node's motion, as :class:`genre_tasks.exchange.types.NodeMotion`; poses only where it is present."""

    model_config = ConfigDict(frozen=True)

    present: tuple[bool, ...]
    scene_SE3_node: tuple[Matrix, ...]


class NodeEntry(BaseModel):
    """A node, as :class:`genre_tasks.exchange.types.ExchangeNode`; ``file`` only in the layout of nodes."""

    model_config = ConfigDict(frozen=True)

    name: str
    label: str = ""
    track_id: str = ""
    size_m: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)
    gaussians: int = 0
    sh_degree: int = 0
    motion: MotionEntry | None = None
    file: str | None = None


class PosedFile(BaseModel):
    """A file with the scene posed at one log frame."""

    model_config = ConfigDict(frozen=True)

    frame: Frame
    file: str


class ChunkEntry(BaseModel):
    """A chunk, as :class:`genre_tasks.exchange.types.ExchangeScene`, and where its files are."""

    model_config = ConfigDict(frozen=True)

    chunk: int = Field(ge=0, lt=10_000)
    source: dict[str, Any] = {}
    world_SE3_scene: Matrix
    times_s: tuple[Finite, ...]
    frames: tuple[Frame, ...]
    losses: tuple[str, ...] = ()
    nodes: tuple[NodeEntry, ...]
    file: str | None = None
    posed: tuple[PosedFile, ...] = ()


class FileDigest(BaseModel):
    """A file of the folder."""

    model_config = ConfigDict(frozen=True)

    path: str
    sha256: str
    size: int


class SceneDocument(BaseModel):
    """All of ``scene.json``. Unknown entries are passed over: a later version may add some."""

    model_config = ConfigDict(frozen=True)

    kind: Literal["genre-scene"] = "genre-scene"
    version: int = VERSION
    format: str
    layout: Layout
    axes: str = "metres, x forward, y left and z up in a node of an actor, z up in a scene"
    source: dict[str, Any] = {}
    chunks: tuple[ChunkEntry, ...]
    losses: tuple[str, ...] = ()
    files: tuple[FileDigest, ...] = ()
    document_sha256: str = Field("", pattern="^([0-9a-f]{64})?$")


def describe_chunk(number: int, scene: ExchangeScene, source: dict[str, Any]) -> ChunkEntry:
    """Describes a chunk before any file of it is written.

    Args:
        number: of the chunk.
        scene: of the chunk.
        source: where it is from, as JSON values.
    """
    return ChunkEntry(
        chunk=number,
        source=source,
        world_SE3_scene=_to_matrix(scene.world_SE3_scene),
        times_s=tuple(float(time) for time in scene.times_s),
        frames=scene.frames,
        losses=scene.losses,
        nodes=tuple(_describe_node(node) for node in scene.nodes),
    )


def digest_files(folder: Path) -> tuple[FileDigest, ...]:
    """Digests all files below a folder, but for its document.

    Args:
        folder: with the files.

    Returns:
        Entries in the order of their paths.
    """
    paths = sorted(path for path in folder.rglob("*") if path.is_file() and path != folder / SCENE_FILE)
    return tuple(
        FileDigest(path=path.relative_to(folder).as_posix(), sha256=digest_contents(path), size=path.stat().st_size)
        for path in paths
    )


def write_document(folder: Path, document: SceneDocument) -> None:
    """Writes ``scene.json``, with its digest: an export over a changed one would lose what somebody wrote.

    Args:
        folder: with the files that the document names.
        document: of the folder.
    """
    values = document.model_dump(mode="json") | {DOCUMENT_ENTRY: ""}
    text = json.dumps(values, indent=1, ensure_ascii=False, allow_nan=False)
    (folder / SCENE_FILE).write_text(insert_digest(text + "\n"), encoding="utf-8")


def read_document(folder: Path) -> SceneDocument:
    """Reads ``scene.json``.

    Args:
        folder: that ``genre export`` wrote.

    Returns:
        The document.

    Raises:
        InputError: there is none, or it is not one of this version.
    """
    path = folder / SCENE_FILE
    if not path.is_file():
        raise InputError(f"the folder has no {SCENE_FILE}", remedy="Give a file, or an exported folder.", file=folder)
    if path.stat().st_size > _MOST_BYTES:
        raise InputError("the document is too large", remedy=_REMEDY, file=path)
    values = read_json_object(path, "description of the scene", _REMEDY)
    if values.get("kind") != KIND:
        raise InputError("the document describes no scene", remedy=_REMEDY, file=path)
    if values.get("version") != VERSION:
        problem = f"the document has version {values.get('version')}, and {VERSION} is read"
        raise InputError(problem, remedy="Update the project, or give one of the folder's files.", file=path)
    try:
        document = SceneDocument.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise InputError(f"{where} of the document: {first['msg']}", remedy=_REMEDY, file=path) from error
    _check_document(document, path)
    return document


def read_scene_folder(folder: Path) -> dict[int, ExchangeScene]:
    """Reads the scenes of an exported folder.

    Args:
        folder: that ``genre export`` wrote, of whole chunks or of nodes.

    Returns:
        Scene by chunk number.

    Raises:
        InputError: the document or a file is damaged, or the folder holds posed files.
        ConfigError: the format's package is not installed.
    """
    document = read_document(folder)
    if document.layout == "frames":
        raise InputError(
            "the folder holds a scene at single frames", remedy="Give one of its files, not the folder.", file=folder
        )
    # A bundle for a simulator names actors, and leaves the Gaussians to its service.
    if document.layout == "scenes" and not all(entry.file for entry in document.chunks):
        problem = f"the folder is of the format {document.format}, which holds no Gaussians of their own"
        raise InputError(problem, remedy="Export the scene as ply, glb or usdz.", file=folder)
    read = _read_chunk_file if document.layout == "scenes" else _read_nodes
    return {entry.chunk: read(folder, document.format, entry) for entry in document.chunks}


def find_changes(folder: Path) -> tuple[str, ...]:
    """Finds files of an exported folder that were changed after the export, such as by an editor of Gaussians.

    Args:
        folder: that ``genre export`` wrote.

    Returns:
        Their names.

    Raises:
        InputError: as :func:`read_document`.
    """
    entries = read_document(folder).files
    return tuple(entry.path for entry in entries if digest_contents(_inside(folder, entry.path)) != entry.sha256)


def _read_chunk_file(folder: Path, _format: str, entry: ChunkEntry) -> ExchangeScene:
    path = _inside(folder, entry.file or "")
    scene = find_format(path).read(path)
    # A file repeats what the scene had lost before it was written; GLB files of old hold none of it.
    return replace(scene, losses=tuple(dict.fromkeys((*entry.losses, *scene.losses))))


def _read_nodes(folder: Path, format_name: str, entry: ChunkEntry) -> ExchangeScene:
    read = load_format(format_name).read
    found = [_read_node(folder, read, node) for node in entry.nodes]
    # Several nodes may lose the same: an editor leaves its marks in all files.
    losses = dict.fromkeys((*entry.losses, *(loss for _, lost in found for loss in lost)))
    return ExchangeScene(
        nodes=tuple(node for node, _ in found),
        times_s=np.array(entry.times_s, np.float64),
        frames=entry.frames,
        world_SE3_scene=np.array(entry.world_SE3_scene, np.float64),
        losses=tuple(losses),
    )


def _read_node(
    folder: Path, read: Callable[[Path], ExchangeScene], node: NodeEntry
) -> tuple[ExchangeNode, tuple[str, ...]]:
    """The node, and what of its file is not in it."""
    path = _inside(folder, node.file or "")
    scene = read(path)
    if len(scene.nodes) != 1 or scene.nodes[0].motion is not None:
        raise InputError("expected one part that rests", remedy=_REMEDY, file=path)
    found = ExchangeNode(
        name=node.name,
        cloud=scene.nodes[0].cloud,
        motion=None if node.motion is None else _read_motion(node.motion),
        label=node.label,
        track_id=node.track_id,
        size_m=node.size_m,
    )
    return found, scene.losses


def _read_motion(entry: MotionEntry) -> NodeMotion:
    present = np.array(entry.present, dtype=bool)
    poses = np.broadcast_to(np.eye(4), (len(present), 4, 4)).copy()
    poses[present] = np.array(entry.scene_SE3_node, np.float64).reshape(-1, 4, 4)
    return NodeMotion(poses, present)


def _describe_node(node: ExchangeNode) -> NodeEntry:
    motion = None
    if node.motion is not None:
        poses = node.motion.scene_SE3_node[node.motion.present]
        motion = MotionEntry(
            present=tuple(bool(value) for value in node.motion.present),
            scene_SE3_node=tuple(_to_matrix(pose) for pose in poses),
        )
    return NodeEntry(
        name=node.name,
        label=node.label,
        track_id=node.track_id,
        size_m=node.size_m,
        gaussians=len(node.cloud),
        sh_degree=node.cloud.sh_degree,
        motion=motion,
    )


def _check_document(document: SceneDocument, path: Path) -> None:
    """Checks what a schema cannot: numbers of moments, rising times, distinct names."""
    for chunk in document.chunks:
        count = len(chunk.times_s)
        motions = [node.motion for node in chunk.nodes if node.motion is not None]
        is_sound = all(
            len(motion.present) == count and len(motion.scene_SE3_node) == sum(motion.present) for motion in motions
        )
        if not is_sound or (chunk.frames and len(chunk.frames) != count) or not is_rising(chunk.times_s):
            raise InputError(f"the moments of chunk {chunk.chunk} do not fit", remedy=_REMEDY, file=path)
        if len({node.name for node in chunk.nodes}) != len(chunk.nodes):
            raise InputError(f"two nodes of chunk {chunk.chunk} have one name", remedy=_REMEDY, file=path)
    if len({chunk.chunk for chunk in document.chunks}) != len(document.chunks) or not document.chunks:
        raise InputError("the document has no chunk, or one twice", remedy=_REMEDY, file=path)


def _inside(folder: Path, name: str) -> Path:
    """A file of the folder; a document from somebody else must not lead out of it."""
    parts = PurePosixPath(name).parts
    path = folder / name
    leads_out = name.startswith("/") or ".." in parts
    # A folder on the way may be a link, too.
    if not parts or leads_out or not path.is_file() or path.resolve() != folder.resolve() / name:
        raise InputError(f"the folder has no file '{name}'", remedy=_REMEDY, file=folder)
    return path


def _to_matrix(pose: Float64) -> Matrix:
    rows = tuple(tuple(row) for row in np.asarray(pose, np.float64).tolist())
    return rows  # type: ignore[return-value]
