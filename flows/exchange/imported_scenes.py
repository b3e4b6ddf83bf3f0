"""The imports of a store: chunks that ``genre import`` committed, together with those of the same file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from genre_tasks.errors import InputError
from genre_tasks.suggestions import did_you_mean
from storage.opening import open_store
from storage.store import Artifact

IMPORTED = "imported"
"""Dataset, in a store, of scenes that come from files."""

IMPORT_STAGE = "import"

CHUNK_COUNT = "chunk_count"
"""Which of an import's facts says how many chunks its file has; imports of earlier versions do not say it."""

FILE_INPUT = "file"
"""Which of an import's inputs is the digest of its file."""

_KEY_DIGITS = 12
_DATE_CHARACTERS = 19
# Of a file that is edited and imported every day, the last ones are meant.
_LISTED_IMPORTS = 8
_LISTED_NAMES = 20


@dataclass(frozen=True)
class StoredImport:
    """What one version of the code read from one file, under one name.

    Attributes:
        name: of the scene in the store.
        file_digest: of the file or folder that it comes from.
        keys: of all its artifacts.
        artifacts: one for each chunk, by the chunk's number in rising order.
        chunk_count: how many chunks the file has; ``None``: nobody wrote it down.
    """

    name: str
    file_digest: str
    keys: tuple[str, ...]
    artifacts: Mapping[int, Artifact]
    chunk_count: int | None

    @property
    def is_complete(self) -> bool:
        """Whether all chunks of the file are there, as far as is known."""
        return self.chunk_count is None or len(self.artifacts) >= self.chunk_count

    @property
    def made_at(self) -> str:
        """Time of the last commit, ISO 8601."""
        return max(artifact.manifest.created_at for artifact in self.artifacts.values())

    def describe_key(self) -> str:
        """Says by which key the import is found, and since when it is there."""
        date = self.made_at[:_DATE_CHARACTERS].replace("T", " ") or "an unknown date"
        return f"{self.name} of {date} has {self.keys[0][:_KEY_DIGITS]}"


def list_imports(store: str) -> list[StoredImport]:
    """Lists the imports of a store.

    Args:
        store: folder (or URI) of the store.

    Returns:
        The imports, in the order of their names.

    Raises:
        InputError: a folder of the store must not be read.
        TransientIOError: the store does not answer.
    """
    groups: dict[tuple[str, str, str], list[Artifact]] = {}
    for artifact in open_store(store).artifacts(dataset=IMPORTED, stage=IMPORT_STAGE):
        manifest = artifact.manifest
        group = (manifest.log, manifest.inputs.get(FILE_INPUT, ""), manifest.code_digest)
        groups.setdefault(group, []).append(artifact)
    return [_make_import(name, digest, artifacts) for (name, digest, _), artifacts in sorted(groups.items())]


def find_import(imports: Sequence[StoredImport], word: str, store: str) -> StoredImport | None:
    """Finds the import that a user means.

    A name counts first, then the start of a name or of a key. Of several imports of one file the last complete one is
    taken, since they hold the same.

    Args:
        imports: of the store.
        word: what the user wrote.
        store: folder (or URI) of the store, for errors.

    Returns:
        The import; ``None`` where no name and no key begins so.

    Raises:
        InputError: imports of several files are meant, or chunks are missing from the import.
    """
    named = [entry for entry in imports if entry.name == word]
    matches = named or [entry for entry in imports if word and _begins(entry, word)]
    if not matches:
        return None
    by_file: dict[tuple[str, str], StoredImport] = {}
    for entry in sorted(matches, key=lambda entry: (entry.is_complete, len(entry.artifacts), entry.made_at)):
        # A key has no name in it: one file has equal keys under all its names, and equal scenes.
        name = entry.name if entry.name.startswith(word) else ""
        by_file[name, entry.file_digest] = entry
    if len(by_file) > 1:
        options = sorted(by_file.values(), key=lambda entry: entry.made_at)[-_LISTED_IMPORTS:]
        listed = ", ".join(entry.describe_key() for entry in options)
        verb = "are called" if named else "begin with"
        remedy = "Import with another --name, or give a key" if named else "Give a whole name, or a key"
        raise InputError(f"several imported scenes {verb} '{word}'", remedy=f"{remedy}: {listed}.", file=store)
    found = next(iter(by_file.values()))
    if not found.is_complete:
        count = len(found.artifacts)
        problem = f"the import of '{found.name}' was interrupted: {count} of {found.chunk_count} chunks are there"
        raise InputError(problem, remedy="Import the file again.", file=store)
    return found


def describe_unknown(imports: Sequence[StoredImport], word: str, store: str) -> InputError:
    """Describes that neither a run nor an imported scene is called so.

    Args:
        imports: of the store, one or more.
        word: what the user wrote.
        store: folder (or URI) of the store.

    Returns:
        The error, which names the imported scenes.
    """
    names = list(dict.fromkeys(entry.name for entry in imports))
    more = f" and {len(names) - _LISTED_NAMES} more" if len(names) > _LISTED_NAMES else ""
    listed = ", ".join(names[:_LISTED_NAMES]) + more
    return InputError(
        f"0 runs and 0 imported scenes of this store begin with '{word}'",
        remedy=f"{did_you_mean(word, names)}`genre show runs` lists runs. Imported scenes: {listed}.",
        file=store,
    )


def _make_import(name: str, file_digest: str, artifacts: Sequence[Artifact]) -> StoredImport:
    ordered = sorted(artifacts, key=lambda artifact: artifact.manifest.created_at)
    # A file that was renamed, or imported before its chunks were counted, has a chunk twice: the later one counts.
    by_chunk = {artifact.manifest.chunk: artifact for artifact in ordered}
    counts = [artifact.manifest.configuration.get(CHUNK_COUNT) for artifact in ordered]
    return StoredImport(
        name=name,
        file_digest=file_digest,
        keys=tuple(artifact.manifest.key for artifact in ordered),
        artifacts=dict(sorted(by_chunk.items())),
        # Whatever somebody else's store says here.
        chunk_count=max((count for count in counts if isinstance(count, int)), default=None),
    )


def _begins(entry: StoredImport, word: str) -> bool:
    return entry.name.startswith(word) or any(key.startswith(word) for key in entry.keys)
