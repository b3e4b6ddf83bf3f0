"""Exports scenes of a store into a folder, which appears complete or not at all."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from flows.exchange.export_request import ExportRequest
from flows.exchange.exporters import load_exporter
from flows.exchange.stored_scenes import open_stored_scenes
from genre_tasks.atomic_path import holds_files, replace_folder
from genre_tasks.errors import ConfigError, InputError, ResourceError
from genre_tasks.exchange.scene_folder import SCENE_FILE, read_document
from genre_tasks.progress import Progress, silent
from genre_tasks.temporary_names import describe_owner, temporary_folder
from storage.files import digest_file, make_folders, payload_files, sync
from storage.io_errors import as_genre_error

_FOLDER_MODE = 0o755
_LISTED_FILES = 5
_REMEDY = "Free space, or name another --out in which this user may write; nothing is half-written."


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
    with _name_target(request.out):
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


@contextmanager
def _name_target(out: Path) -> Iterator[None]:
    """Makes errors of the disk name the folder that the user asked for, and not the hidden one that is written."""
    try:
        yield
    except OSError as error:
        known = as_genre_error(error, out)
        # Only what is hidden has this in its name; a folder above, which cannot be made, is named as it is.
        if describe_owner() in str(known.file):
            known.file = str(out)
        # Of memory and file handles another folder has no more.
        if type(known) is not ResourceError:
            known.remedy = _REMEDY
        raise known from error


def _check_folder(folder: Path, overwrite: bool) -> None:
    if not holds_files(folder):
        return
    # Never replaced, not even by --overwrite: a user's files may be the only copy.
    foreign = InputError("--out holds files that are no export's", remedy="Name a new or empty folder.", file=folder)
    if not (folder / SCENE_FILE).is_file():
        raise foreign
    try:
        digests = {entry.path: entry.sha256 for entry in read_document(folder).files}
    except InputError as error:
        raise foreign from error
    if any(name not in digests and name != SCENE_FILE for name, _ in payload_files(folder)):
        raise foreign
    if not overwrite:
        raise ConfigError(
            "--out holds an export already", remedy="Name another folder, or replace it by --overwrite.", file=folder
        )
    changed = _find_changed_files(folder, digests)
    if changed:
        more = f" and {len(changed) - _LISTED_FILES} more" if len(changed) > _LISTED_FILES else ""
        listed = ", ".join(changed[:_LISTED_FILES]) + more
        problem = f"--overwrite would lose what was changed after the export: {listed}"
        raise InputError(problem, remedy="Move these files, or name another folder.", file=folder)


def _find_changed_files(folder: Path, digests: Mapping[str, str]) -> list[str]:
    """Names of the listed files whose bytes are others now; one that is missing has nothing that could be lost."""
    return [
        name
        for name, path in payload_files(folder)
        # An export has no links: somebody put it there.
        if name in digests and (path.is_symlink() or digest_file(path) != digests[name])
    ]
