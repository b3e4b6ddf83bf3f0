"""What an artifact says of itself: ``manifest.json``, written last. No manifest, no artifact."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from genre_tasks.errors import ArtifactCorruptError, ConfigError
from storage.address import Address
from storage.keys import digest_bytes, digest_value

MANIFEST = "manifest.json"
SCHEMA_VERSION = 1
# The seal finds accidents, such as a flipped bit or an edit by hand. It is no signature.
_SEAL = "manifest_sha256"
_RECOMPUTE = "Delete the folder; the next run computes it again."


class NewerSchemaError(ArtifactCorruptError):
    """The manifest was written by a newer version of the project; it is not corrupt and must not be replaced."""


class FileEntry(BaseModel):
    """One payload file of an artifact.

    Attributes:
        path: path relative to the artifact's folder, with "/" between its parts.
        sha256: digest of the file's bytes, 64 hex digits.
        size: the file's size in bytes.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    # Unknown fields are refused: a version that does not know one would drop it silently.
    path: str
    sha256: str
    size: int = Field(ge=0)


def payload_digest(files: Iterable[FileEntry]) -> str:
    """Computes the digest of an artifact's payload: equal for equal files, whatever their manifests say.

    Args:
        files: the payload's files, in any order.

    Returns:
        64 hex digits of sha256.

    >>> payload_digest([])[:8]
    'e3b0c442'
    """
    # A path holds neither NUL nor newline, so no two lists of files give the same text.
    pairs = sorted((f.path, f.sha256) for f in files)
    return digest_bytes("".join(f"{path}\0{sha}\n" for path, sha in pairs).encode())


class Manifest(BaseModel):
    """Key, recipe, files and measurements of one artifact.

    The fields from ``seconds`` on are no payload: they differ between runs that make the same files.

    Attributes:
        schema_version: version of this format.
        kind: kind of artifact, which chooses the codec.
        dataset: part of the address, as are ``log``, ``chunk``, ``stage`` and ``key``.
        inputs: name → key of each input artifact (or digest of the log).
        configuration: the stage's section of the configuration.
        code_digest: digest of the stage's code.
        weights_digest: digest of the network's weights, if the stage has a network.
        files: all payload files.
        payload_digest: digest over ``files``.
        seconds: wall time of the stage.
        peak_mib: largest memory of the process during the stage, in MiB.
        created_at: time of the commit, ISO 8601.
        environment: versions, machine and commit.
        measurements: numbers and facts about the result that are no payload.
        warnings: sentences for the user.
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
        """Writes the manifest as readable JSON that carries a sha256 over itself.

        Returns:
            UTF-8 text. Non-finite measurements become ``null``.
        """
        body = to_json_value(self.model_dump(mode="python"))
        # Indented, because people open manifests; the seal is over the compact form and does not mind.
        return (json.dumps(body | {_SEAL: digest_value(body)}, indent=2, ensure_ascii=False) + "\n").encode()


def to_json_value(value: Any) -> Any:
    """Copies a value into types that JSON can hold.

    Args:
        value: mappings, sequences, pydantic models, numbers, strings, NumPy arrays and torch tensors, nested.

    Returns:
        Dictionaries, lists, numbers, strings and ``None``, which stands for NaN and infinity. Anything else
        becomes its text.

    >>> to_json_value({"psnr": float("inf"), "size": (320, 180), "file": Path("a")})
    {'psnr': None, 'size': [320, 180], 'file': 'a'}
    """
    if isinstance(value, Mapping):
        return {str(k): to_json_value(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [to_json_value(v) for v in value]
    if isinstance(value, BaseModel):
        return to_json_value(value.model_dump(mode="python"))
    # Duck typing, because importing torch for this check would make every look-up slow.
    if hasattr(value, "tolist"):
        return to_json_value(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, str | int):
        return value
    return str(value)


def parse_manifest(data: bytes, file: Path) -> Manifest:
    """Reads a manifest and checks every promise of it.

    Args:
        data: bytes of a ``manifest.json``.
        file: where they were read, for errors.

    Returns:
        The manifest.

    Raises:
        NewerSchemaError: its schema version is newer than this code.
        ArtifactCorruptError: it is not JSON, does not match its own digest, or lacks a field; or its payload digest
            is not that of its files, or a file's path leads out of the folder.
    """
    try:
        body = json.loads(data)
        version = int(body["schema_version"])
        seal = body.pop(_SEAL, None)
        computed_seal = digest_value(body)
    except (ValueError, TypeError, KeyError, RecursionError, OverflowError) as error:
        raise ArtifactCorruptError("The manifest is not readable", remedy=_RECOMPUTE, file=file) from error
    # A newer version may seal its manifests in another way: a missing seal is then no damage.
    if seal != computed_seal and not (seal is None and version > SCHEMA_VERSION):
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
    # Stores are exchanged: an address or a path from somebody else's manifest must not lead out of its folder.
    try:
        _ = manifest.address
    except ConfigError as error:
        raise ArtifactCorruptError(error.problem, remedy=_RECOMPUTE, file=file) from error
    for entry in manifest.files:
        path = PurePosixPath(entry.path)
        is_outside = path.is_absolute() or ".." in path.parts or not path.parts
        # A NUL would fail in every call of the system, by an error that names nothing.
        if is_outside or entry.path == MANIFEST or "\0" in entry.path:
            raise ArtifactCorruptError(f"The path {entry.path!r} is not allowed", remedy=_RECOMPUTE, file=file)
    return manifest
