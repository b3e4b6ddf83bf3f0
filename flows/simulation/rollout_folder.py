"""The folder of a rollout: it appears complete with a manifest, or not at all, and is found again by its key."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from flows.output_errors import name_output
from genre_tasks.atomic_path import holds_files, replace_folder
from genre_tasks.errors import ArtifactCorruptError, ConfigError, InputError
from genre_tasks.temporary_names import temporary_folder
from storage.files import make_folders, payload_files, sync
from storage.manifest import MANIFEST, FileEntry, Manifest, parse_manifest
from storage.manifest_writer import find_damage, list_payload, write_manifest

KIND = "rollout"
"""Kind of artifact in the manifest."""

_FOLDER_MODE = 0o755


def find_rollout(folder: Path, key: str, overwrite: bool) -> Manifest | None:
    """Looks whether a folder holds a rollout already.

    Args:
        folder: that the user named.
        key: of the rollout that is asked for.
        overwrite: whether another rollout there may be replaced.

    Returns:
        The manifest of the sound rollout with this key; ``None`` where it has to be rendered.

    Raises:
        InputError: the folder holds files that are no rollout's.
        ConfigError: it holds another rollout, or a damaged one, which may not be replaced.
    """
    if not holds_files(folder):
        return None
    manifest = _read_manifest(folder)
    damage = _find_damage(folder, manifest)
    if manifest.key == key and damage is None:
        return manifest
    if overwrite:
        return None
    problem = "--out holds another rollout" if damage is None else f"--out holds a damaged rollout ({damage})"
    raise ConfigError(problem, remedy="Name another folder, or replace it by --overwrite.", file=folder)


@contextmanager
def write_rollout(folder: Path, make_manifest: Callable[[tuple[FileEntry, ...]], Manifest]) -> Iterator[Path]:
    """Gives a temporary folder; when the block ends, it gets a manifest and takes the place of ``folder``.

    After an error nothing of it is left, and a rollout that was there stays.

    Args:
        folder: of the rollout; :func:`find_rollout` has looked into it.
        make_manifest: gives the manifest for the files that the block has written.

    Yields:
        The folder to write to.

    Raises:
        ConfigError: the folder was empty, and is full when the block ends.
        GenreError: a file cannot be written; it names the folder, and not the temporary one.
    """
    held_files = holds_files(folder)
    with name_output(folder):
        make_folders(folder.parent)
        # In the same folder, because a rename is atomic only within one file system.
        with temporary_folder(folder.parent) as temporary:
            yield temporary
            temporary.chmod(_FOLDER_MODE)
            write_manifest(temporary, make_manifest(list_payload(temporary)))
            replace_folder(folder, temporary, held_files)
            sync(folder.parent)


def _read_manifest(folder: Path) -> Manifest:
    foreign = InputError("--out holds files that are no rollout's", remedy="Name a new or empty folder.", file=folder)
    path = folder / MANIFEST
    if not path.is_file():
        raise foreign
    try:
        manifest = parse_manifest(path.read_bytes(), path)
    except ArtifactCorruptError as error:
        raise foreign from error
    # Never replaced, not even by --overwrite: a store's artifact or a user's own files may be the only copy.
    listed = {entry.path for entry in manifest.files} | {MANIFEST}
    if manifest.kind != KIND or any(name not in listed for name, _ in payload_files(folder)):
        raise foreign
    return manifest


def _find_damage(folder: Path, manifest: Manifest) -> str | None:
    for entry in manifest.files:
        path = folder / entry.path
        problem = find_damage(path if path.exists() else None, entry)
        if problem is not None:
            return f"{entry.path}: {problem[0].lower()}{problem[1:]}"
    return None
