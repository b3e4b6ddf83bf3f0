"""Commits scenes from files to a store, where other commands find them by their key."""

from __future__ import annotations

import hashlib
import itertools
import re
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from flows.exchange.imported_scenes import CHUNK_COUNT, FILE_INPUT, IMPORT_STAGE, IMPORTED
from flows.machine.facts import describe_environment
from flows.machine.resource_usage import ResourceUsage, measure_usage
from genre_tasks.errors import ConfigError
from genre_tasks.exchange.conversion import BACKGROUND_NAME, DISTANT_NAME, limit_sh_degree, to_scene_graph
from genre_tasks.exchange.registry import find_format, load_format
from genre_tasks.exchange.scene_file import read_scene_files
from genre_tasks.exchange.scene_folder import SCENE_FILE, find_changes, read_document
from genre_tasks.exchange.scene_survey import find_scene_warnings, survey_node
from genre_tasks.exchange.types import ExchangeNode, ExchangeScene
from genre_tasks.progress import Progress, silent
from genre_tasks.scene.reconstruction import Reconstruction
from storage.address import Address
from storage.code_digest import code_digest
from storage.files import digest_file, payload_files
from storage.keys import stage_key
from storage.opening import open_store
from storage.store import Provenance

_CODE = "genre_tasks.exchange.scene_file"
_NAME = re.compile(r"[\w.+=-]{1,100}")


def import_scene(store: str, path: Path, name: str | None = None, progress: Progress = silent) -> dict[str, Any]:
    """Reads a file or an exported folder and commits its scenes as reconstructions.

    The same file under the same name is committed once. An import that was interrupted goes on where it ended.

    Args:
        store: folder (or URI) of the store; it is made where it is missing.
        path: a file of a known format, or a folder that ``genre export`` wrote.
        name: what the scene is called in the store; ``None``: after the file.
        progress: called before each chunk.

    Returns:
        JSON values: ``name``, and for each chunk its key, nodes, losses and warnings.

    Raises:
        InputError: the file is damaged or of no known format.
        ConfigError: the name cannot be used, or the format's package is not installed.
    """
    path = path.parent if path.name == SCENE_FILE else path
    called = _choose_name(path) if name is None else _check_name(name)
    with measure_usage() as usage:
        scenes = read_scene_files(path)
    changed = find_changes(path) if path.is_dir() else ()
    source = _Source(
        store=store,
        name=called,
        file=path.absolute().name,
        digest=_digest_source(path),
        module=_find_module(path),
        chunk_count=len(scenes),
        warnings=tuple(f"{file} was changed after the export." for file in changed),
        usage=usage,
    )
    chunks = []
    for k, (number, scene) in enumerate(sorted(scenes.items())):
        progress(k, len(scenes), f"chunk {number}")
        chunks.append(_commit_scene(source, number, scene))
    progress(len(scenes), len(scenes), "done")
    return {"name": called, "file": str(path), "chunks": chunks}


@dataclass(frozen=True)
class _Source:
    """What all chunks of an import share.

    Attributes:
        store: folder (or URI) of the store.
        name: of the scene in the store.
        file: name of the file or folder.
        digest: of its bytes.
        module: that reads it, as its format is named in a registry alone.
        chunk_count: how many chunks it has.
        warnings: on the file as it is.
        usage: what reading it took.
    """

    store: str
    name: str
    file: str
    digest: str
    module: str
    chunk_count: int
    warnings: tuple[str, ...]
    usage: ResourceUsage


def _commit_scene(source: _Source, number: int, scene: ExchangeScene) -> dict[str, Any]:
    limited = _make_distinct(limit_sh_degree(scene))
    warnings = (*source.warnings, *find_scene_warnings(limited))
    # What a scene graph does not hold, and an export of the imported scene states again.
    facts = {
        "file": source.file,
        CHUNK_COUNT: source.chunk_count,
        "names": {node.track_id: node.name for node in limited.nodes if node.motion is not None},
        "times_s": limited.times_s.tolist(),
        "frames": list(limited.frames or range(len(limited.times_s))),
        "world_SE3_scene": limited.world_SE3_scene.tolist(),
        "losses": list(limited.losses),
    }
    code = code_digest(_CODE, (source.module,))
    inputs = {FILE_INPUT: source.digest}
    key = stage_key(IMPORT_STAGE, code, facts, inputs)
    address = Address(IMPORTED, source.name, number, IMPORT_STAGE, key)
    provenance = Provenance(
        inputs=inputs,
        configuration=facts,
        code_digest=code,
        seconds=source.usage.seconds,
        peak_mib=source.usage.peak_mib,
        environment=describe_environment(),
        warnings=warnings,
    )
    value = Reconstruction(to_scene_graph(limited))
    artifact = open_store(source.store).commit(address, "reconstruction", value, provenance)
    return {
        "chunk": number,
        "key": artifact.manifest.key,
        "gaussians": sum(len(node.cloud) for node in limited.nodes),
        "moments": len(limited.times_s),
        "nodes": [asdict(survey_node(node)) for node in limited.nodes],
        "losses": list(limited.losses),
        "warnings": list(warnings),
    }


def _make_distinct(scene: ExchangeScene) -> ExchangeScene:
    """Gives actors track ids and names of their own, and moments rising frames: a scene graph tells them apart by it.

    Files may repeat track ids or leave them out, and a moving part may be called as the background is.
    """
    tracks: set[str] = set()
    names = {BACKGROUND_NAME, DISTANT_NAME, *(node.name for node in scene.nodes)}
    nodes: list[ExchangeNode] = []
    for node in scene.nodes:
        if node.motion is None:
            nodes.append(node)
            continue
        name = node.name
        while node.name in (BACKGROUND_NAME, DISTANT_NAME) and name in names:
            name += "-moving"
        track = node.track_id if node.track_id and node.track_id not in tracks else name
        while track in tracks:
            track += "-"
        names.add(name)
        tracks.add(track)
        nodes.append(replace(node, name=name, track_id=track))
    is_rising = all(before < after for before, after in itertools.pairwise(scene.frames))
    return replace(scene, nodes=tuple(nodes), frames=scene.frames if is_rising else ())


def _choose_name(path: Path) -> str:
    called = path.absolute().name
    stem = called if path.is_dir() else called.partition(".")[0]
    slug = re.sub(r"[^\w+=-]+", "-", stem).strip("-.")
    return slug[:100] or "scene"


def _check_name(name: str) -> str:
    if not _NAME.fullmatch(name) or name.startswith("."):
        raise ConfigError(f"--name {name!r} cannot be used", remedy="Use letters, digits, and any of - _ = + . inside.")
    return name


def _digest_source(path: Path) -> str:
    if not path.is_dir():
        return digest_file(path)
    digest = hashlib.sha256()
    for name, file in payload_files(path):
        digest.update(f"{name}\0{digest_file(file)}\n".encode())
    return digest.hexdigest()


def _find_module(path: Path) -> str:
    """The module that reads the file, which is named in a registry alone."""
    found = load_format(read_document(path).format) if path.is_dir() else find_format(path)
    return type(found).__module__
