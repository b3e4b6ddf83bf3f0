"""``genre show KEY``: one artifact's manifest, contents, statistics and picture."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from storage.store import Artifact, Store


def print_artifact(store: Store, artifact: Artifact) -> None:
    """Prints the manifest, what the artifact holds, its files with statistics of their columns, and its ancestors.

    Args:
        store: the store that the artifact is in.
        artifact: of any kind.

    Raises:
        ArtifactCorruptError: a file is missing or damaged.
    """
    from flows.cli.printing import print_fields, print_rows
    from storage.contents import read_short_table, summarise_contents
    from storage.lineage import find_ancestors, summarise_files

    # Before anything is printed: tables of a damaged artifact would show the damage as if it were the result.
    tables = summarise_files(store, artifact)
    store.fetch(artifact)
    print_fields("manifest", artifact.manifest.model_dump(exclude={"files"}))
    contents = summarise_contents(artifact)
    if contents:
        print_fields("contents", contents)
    rows = read_short_table(artifact)
    if rows:
        print_rows(artifact.manifest.kind, rows)
    print_rows("files", [file.model_dump() for file in artifact.manifest.files])
    for table in tables:
        print_rows(table.name, _leave_out_empty(table.rows))
    print_rows("made from", [describe_artifact(ancestor) for ancestor in find_ancestors(store, artifact)])


def read_folder_artifact(folder: Path) -> Artifact:
    """Reads the manifest of a folder outside of a store, such as a rollout's.

    Args:
        folder: that holds a ``manifest.json``.

    Returns:
        The artifact.

    Raises:
        InputError: the folder has no manifest.
        ArtifactCorruptError: the manifest is damaged.
    """
    from genre_tasks.errors import InputError
    from storage.artifact_folders import load_manifest
    from storage.store import Artifact

    try:
        manifest = load_manifest(folder)
    except OSError as error:
        remedy = "Name a folder that `genre simulate` wrote, or the key of an artifact."
        raise InputError("the folder has no manifest", remedy=remedy, file=folder) from error
    return Artifact(manifest.address, folder, manifest)


def write_picture(store: Store, artifact: Artifact, path: Path) -> None:
    """Draws an artifact into a PNG file.

    Args:
        store: the store that the artifact is in.
        artifact: of any kind.
        path: the file; its folder is made if it does not exist.

    Raises:
        InputError: the artifact has nothing to draw.
        ArtifactCorruptError: a file is missing or damaged.
    """
    from flows.plots.artifact_pictures import draw_artifact
    from genre_tasks.atomic_path import atomic_path
    from genre_tasks.errors import InputError
    from storage.codecs.png import write_png

    image = draw_artifact(store, artifact)
    if image is None:
        raise InputError("this artifact has no picture", remedy="Leave out --picture.", stage=artifact.manifest.stage)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as part:
        write_png(part, image)


def describe_artifact(artifact: Artifact) -> dict[str, Any]:
    """Describes an artifact in a row of a table.

    Args:
        artifact: of any kind.

    Returns:
        Values by heading.
    """
    manifest = artifact.manifest
    return {
        "log": manifest.log,
        "chunk": manifest.chunk,
        "stage": manifest.stage,
        "key": manifest.key[:12],
        "seconds": manifest.seconds,
        "peak MiB": manifest.peak_mib,
        "MiB": sum(file.size for file in manifest.files) / 2**20,
        "made": manifest.created_at[:19],
    }


def _leave_out_empty(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows without the columns that are empty in all of them: a table of words has no histograms."""
    names = [name for name in rows[0] if any(row[name] != "" for row in rows)] if rows else []
    return [{name: row[name] for name in names} for row in rows]
