"""Commits scenes from files to a store, where other commands find them by their key."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from flows.exchange.stored_scenes import IMPORT_STAGE, IMPORTED
from flows.machine.facts import describe_environment
from genre_tasks.errors import ConfigError
from genre_tasks.exchange.conversion import limit_sh_degree, to_scene_graph
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
from storage.local import open_store
from storage.store import Provenance

_CODE = "genre_tasks.exchange.scene_file"
_NAME = re.compile(r"[\w.+=-]{1,100}")


def import_scene(store: str, path: Path, name: str | None = None, progress: Progress = silent) -> dict[str, Any]:
    """Reads a file or an exported folder and commits its scenes as reconstructions.

    The same file under the same name is committed once.

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
    scenes = read_scene_files(path)
    source = {"file": path.name, "digest": _digest_source(path), "module": _find_module(path)}
    changed = find_changes(path) if path.is_dir() else ()
    chunks = []
    for k, (number, scene) in enumerate(sorted(scenes.items())):
        progress(k, len(scenes), f"chunk {number}")
        warnings = (*(f"{file} was changed after the export." for file in changed), *find_scene_warnings(scene))
        chunks.append(_commit_scene(store, called, number, scene, source, warnings))
    progress(len(scenes), len(scenes), "done")
    return {"name": called, "file": str(path), "chunks": chunks}


def _commit_scene(
    store: str, name: str, number: int, scene: ExchangeScene, source: Mapping[str, str], warnings: tuple[str, ...]
) -> dict[str, Any]:
    limited = _with_distinct_tracks(limit_sh_degree(scene))
    # What a scene graph does not hold, and an export of the imported scene states again.
    facts = {
        "file": source["file"],
        "names": {node.track_id or node.name: node.name for node in limited.nodes if node.motion is not None},
        "times_s": limited.times_s.tolist(),
        "frames": list(limited.frames or range(len(limited.times_s))),
        "world_SE3_scene": limited.world_SE3_scene.tolist(),
        "losses": list(limited.losses),
    }
    code = code_digest(_CODE, (source["module"],))
    key = stage_key(IMPORT_STAGE, code, facts, {"file": source["digest"]})
    address = Address(IMPORTED, name, number, IMPORT_STAGE, key)
    provenance = Provenance(
        inputs={"file": source["digest"]},
        configuration=facts,
        code_digest=code,
        environment=describe_environment(),
        warnings=warnings,
    )
    artifact = open_store(store).commit(address, "reconstruction", Reconstruction(to_scene_graph(limited)), provenance)
    return {
        "chunk": number,
        "key": artifact.manifest.key,
        "gaussians": sum(len(node.cloud) for node in limited.nodes),
        "moments": len(limited.times_s),
        "nodes": [asdict(survey_node(node)) for node in limited.nodes],
        "losses": list(limited.losses),
        "warnings": list(warnings),
    }


def _with_distinct_tracks(scene: ExchangeScene) -> ExchangeScene:
    """Actors of a scene graph are told apart by their track ids, which a file may repeat or leave out."""
    taken: set[str] = set()
    nodes: list[ExchangeNode] = []
    for node in scene.nodes:
        track = node.track_id or node.name
        if node.motion is not None:
            track = track if track not in taken else node.name
            taken.add(track)
        nodes.append(replace(node, track_id=track) if node.motion is not None else node)
    return replace(scene, nodes=tuple(nodes))


def _choose_name(path: Path) -> str:
    stem = path.name if path.is_dir() else path.name.partition(".")[0]
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
