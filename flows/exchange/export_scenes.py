"""Exports scenes of a store into a folder, which appears complete or not at all."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from flows.exchange.export_request import ExportRequest
from flows.exchange.exporters import load_exporter
from flows.exchange.stored_scenes import open_stored_scenes
from flows.output_errors import name_output
from genre_tasks.atomic_path import holds_files, replace_folder
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.exchange.file_digests import is_edited
from genre_tasks.exchange.scene_folder import SCENE_FILE, read_document
from genre_tasks.progress import Progress, silent
from genre_tasks.temporary_names import temporary_folder
from storage.files import digest_file, make_folders, payload_files, sync

_FOLDER_MODE = 0o755
_LISTED_FILES = 5


def export_scenes(request: ExportRequest, progress: Progress = silent) -> dict[str, Any]:
    """Writes the scenes of a run, or imported ones, into files of other people's tools.

    The same request on the same store gives the same bytes.

    Args:
        request: what to write, and where.
        progress: called before each file.

    Returns:
        JSON values: ``out``, ``format``, where the scenes are from, numbers of what was written, and ``losses``.

    Raises:
        ConfigError: the format is unknown, or ``out`` holds an export that may not be replaced.
        InputError: there is no such scene, chunk or frame, ``out`` holds other files or changed ones, or this user may
            not write there.
        ResourceError: the disk is full, or the machine has no memory or file handles left.
        TransientIOError: the disk does not answer properly.
    """
    exporter = load_exporter(request.format)
    exporter.check(request)
    _check_folder(request.out, request.overwrite)
    held_files = holds_files(request.out)
    scenes = open_stored_scenes(request.store, request.scene, request.stage, request.chunks)
    with name_output(request.out):
        make_folders(request.out.parent)
        # In the same folder, because a rename is atomic only within one file system.
        with temporary_folder(request.out.parent) as folder:
            written = exporter.export(scenes, request, folder, progress)
            folder.chmod(_FOLDER_MODE)
            for _, path in payload_files(folder):
                sync(path)
            if held_files:
                # Writing takes minutes, in which somebody may have edited a file of the old export.
                _check_folder(request.out, request.overwrite)
            replace_folder(request.out, folder, held_files)
            sync(request.out.parent)
    return {"out": str(request.out), "format": request.format, "source": scenes.describe(), **written}


def _check_folder(folder: Path, overwrite: bool) -> None:
    if not holds_files(folder):
        return
    # Never replaced, not even by --overwrite: a user's files may be the only copy.
    foreign = InputError("--out holds files that are no export's", remedy="Name a new or empty folder.", file=folder)
    if not (folder / SCENE_FILE).is_file():
        raise foreign
    try:
        document = read_document(folder)
    except InputError as error:
        raise foreign from error
    digests = {entry.path: entry.sha256 for entry in document.files}
    if any(name not in digests and name != SCENE_FILE for name, _ in payload_files(folder)):
        raise foreign
    if not overwrite:
        raise ConfigError(
            "--out holds an export already", remedy="Name another folder, or replace it by --overwrite.", file=folder
        )
    scene_file = folder / SCENE_FILE
    changed = _find_changed_files(folder, digests)
    # Names and classes of actors are edited in it, which an import takes.
    if scene_file.is_symlink() or is_edited(scene_file, document.document_sha256):
        changed.insert(0, SCENE_FILE)
    if changed:
        more = f" and {len(changed) - _LISTED_FILES} more" if len(changed) > _LISTED_FILES else ""
        listed = ", ".join(changed[:_LISTED_FILES]) + more
        problem = f"--overwrite would lose what was changed after the export: {listed}"
        # Without its document the folder would be no export.
        movable = "the folder" if SCENE_FILE in changed else "these files"
        raise InputError(problem, remedy=f"Move {movable} away, or name another folder.", file=folder)


def _find_changed_files(folder: Path, digests: Mapping[str, str]) -> list[str]:
    """Names of the listed files whose bytes are others now; one that is missing has nothing that could be lost."""
    return [
        name
        for name, path in payload_files(folder)
        # An export has no links: somebody put it there.
        if name in digests and (path.is_symlink() or digest_file(path) != digests[name])
    ]
