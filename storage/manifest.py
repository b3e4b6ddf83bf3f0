"""What an artifact says of itself: ``manifest.json``, written last. No manifest, no artifact."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from genre_tasks.errors import ArtifactCorruptError
from storage.address import Address
from storage.keys import digest_bytes, digest_value

MANIFEST = "manifest.json"
SCHEMA_VERSION = 1
_SEAL = "manifest_sha256"
_RECOMPUTE = "Delete the folder; the next run computes it again."


class NewerSchemaError(ArtifactCorruptError):
    """The manifest was written by a newer version of the project; it is not corrupt and must not be replaced."""


class FileEntry(BaseModel):
    """One payload file: POSIX path relative to the artifact's folder, sha256 (hex), size in bytes."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    path: str
    sha256: str
    size: int = Field(ge=0)


def payload_digest(files: Iterable[FileEntry]) -> str:
    """sha256 (hex) over the sorted (path, sha256): equal for equal payloads, whatever their manifests say."""
    pairs = sorted((f.path, f.sha256) for f in files)
    return digest_bytes("".join(f"{path}\0{sha}\n" for path, sha in pairs).encode())


class Manifest(BaseModel):
    """Key, recipe, files and measurements of one artifact.

    ``inputs`` maps a name to the key of the input artifact (or a log's digest). ``seconds``, ``peak_mib``,
    ``created_at``, ``environment``, ``measurements`` and ``warnings`` are no payload: they differ between runs.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    schema_version: int = SCHEMA_VERSION
    kind: str
    dataset: str
    log: str
    chunk: int = Field(ge=0)
    stage: str
    key: str
    inputs: dict[str, str] = {}
    configuration: dict[str, Any] = {}
    code_digest: str = ""
    weights_digest: str | None = None
    files: tuple[FileEntry, ...]
    payload_digest: str
    seconds: float = 0.0
    peak_mib: float = 0.0
    created_at: str = ""
    environment: dict[str, str] = {}
    measurements: dict[str, Any] = {}
    warnings: tuple[str, ...] = ()

    @property
    def address(self) -> Address:
        """Where this artifact belongs."""
        return Address(self.dataset, self.log, self.chunk, self.stage, self.key)

    def to_json(self) -> bytes:
        """Readable JSON, sealed with a sha256 over itself. Non-finite measurements become ``null``."""
        body = plain(self.model_dump(mode="python"))
        return (json.dumps(body | {_SEAL: digest_value(body)}, indent=2, ensure_ascii=False) + "\n").encode()


def plain(value: Any) -> Any:
    """A JSON-able copy: NumPy and torch scalars as numbers, tuples as lists, NaN and infinity as ``None``."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, BaseModel):
        return plain(value.model_dump(mode="python"))
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, str | int):
        return value
    return str(value)


def parse_manifest(data: bytes, file: Path) -> Manifest:
    """The manifest in ``data``, every promise of it checked.

    Raises ``ArtifactCorruptError`` naming ``file``: not JSON, a broken seal, a field missing or of the wrong type, a
    payload digest that is not of the files listed, a path that leads out of the folder; ``NewerSchemaError`` for a
    schema version this code does not know.
    """
    try:
        body = json.loads(data)
        version, seal = int(body["schema_version"]), body.pop(_SEAL, None)
        own = digest_value(body)
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise ArtifactCorruptError("The manifest is not readable", remedy=_RECOMPUTE, file=file) from error
    if seal != own and not (seal is None and version > SCHEMA_VERSION):
        raise ArtifactCorruptError("The manifest does not match its own digest", remedy=_RECOMPUTE, file=file)
    if version > SCHEMA_VERSION:
        raise NewerSchemaError(
            f"The manifest has schema version {version}, this version knows up to {SCHEMA_VERSION}",
            remedy="Update the project, or choose another place with --store.",
            file=file,
        )
    try:
        manifest = Manifest.model_validate(body)
    except ValidationError as error:
        raise ArtifactCorruptError("The manifest does not fit its schema", remedy=_RECOMPUTE, file=file) from error
    if manifest.payload_digest != payload_digest(manifest.files):
        raise ArtifactCorruptError("The payload digest is not of the files listed", remedy=_RECOMPUTE, file=file)
    for entry in manifest.files:
        path = PurePosixPath(entry.path)
        if path.is_absolute() or ".." in path.parts or not path.parts or entry.path == MANIFEST:
            raise ArtifactCorruptError(f"The path {entry.path!r} is not allowed", remedy=_RECOMPUTE, file=file)
    return manifest
