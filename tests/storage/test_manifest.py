"""The manifest: every single flipped bit of it is noticed, and what it promises is checked."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from genre_tasks.errors import ArtifactCorruptError
from storage.keys import canonical_json, digest_value, stage_key
from storage.manifest import FileEntry, Manifest, parse_manifest, payload_digest

FILE = Path("somewhere/manifest.json")


def example(**changed: object) -> Manifest:
    files = (FileEntry(path="b/x.exr", sha256="1" * 64, size=3), FileEntry(path="a.parquet", sha256="2" * 64, size=4))
    fields = {
        "kind": "chunk",
        "dataset": "d",
        "log": "l",
        "chunk": 0,
        "stage": "ingest",
        "key": "k",
        "files": files,
        "payload_digest": payload_digest(files),
        "seconds": 1.25,
        "measurements": {"n": [1, 2.5]},
    }
    return Manifest.model_validate(fields | changed)


def test_round_trip() -> None:
    assert parse_manifest(example().to_json(), FILE) == example()


def test_numpy_scalars_and_infinities_are_made_plain() -> None:
    manifest = example(measurements={"a": np.float32(0.5), "b": np.arange(2), "c": float("inf"), "d": Path("x")})
    assert parse_manifest(manifest.to_json(), FILE).measurements == {"a": 0.5, "b": [0, 1], "c": None, "d": "x"}


def test_every_flipped_bit_is_noticed_or_means_nothing() -> None:
    data = example().to_json()
    for at in range(len(data)):
        for bit in range(8):
            flipped = bytearray(data)
            flipped[at] ^= 1 << bit
            try:
                assert parse_manifest(bytes(flipped), FILE) == example()
            except ArtifactCorruptError as error:
                assert "manifest.json" in str(error)


def test_payload_digest_does_not_depend_on_order_and_must_fit() -> None:
    files = example().files
    assert payload_digest(files) == payload_digest(reversed(files))
    with pytest.raises(ArtifactCorruptError, match="payload digest"):
        parse_manifest(example(payload_digest="0" * 64).to_json(), FILE)


@pytest.mark.parametrize("path", ["../x", "/etc/x", "manifest.json", "a/../../x", "a\0b"])
def test_paths_that_lead_out_are_refused(path: str) -> None:
    files = (FileEntry(path=path, sha256="1" * 64, size=3),)
    with pytest.raises(ArtifactCorruptError, match="not allowed"):
        parse_manifest(example(files=files, payload_digest=payload_digest(files)).to_json(), FILE)


@pytest.mark.parametrize("change", [{"dataset": ".."}, {"log": "a/b"}, {"stage": "../s"}, {"key": ""}])
def test_addresses_that_lead_out_are_refused(change: dict[str, str]) -> None:
    with pytest.raises(ArtifactCorruptError, match=r"cannot be a folder's name.*manifest\.json"):
        parse_manifest(example(**change).to_json(), FILE)


@pytest.mark.parametrize(
    "data", [b"", b"[]", b"{}", b"null", b'{"schema_version": "x"}', b'{"schema_version": 1}', b"\xff"]
)
def test_other_files_are_refused(data: bytes) -> None:
    with pytest.raises(ArtifactCorruptError, match=r"manifest\.json"):
        parse_manifest(data, FILE)


def test_an_unknown_field_is_refused_even_when_sealed() -> None:
    body = json.loads(example().to_json()) | {"surprise": 1}
    body.pop("manifest_sha256")
    with pytest.raises(ArtifactCorruptError, match="does not fit its schema"):
        parse_manifest(json.dumps(body | {"manifest_sha256": digest_value(body)}).encode(), FILE)


def test_canonical_json() -> None:
    assert canonical_json({"b": 1, "a": [0.1, "ü"]}) == '{"a":[0.1,"ü"],"b":1}'
    with pytest.raises(ValueError, match="Out of range float"):
        canonical_json(float("nan"))


def test_stage_key_depends_on_everything_and_not_on_order() -> None:
    base = {"stage": "gnet", "code_digest": "c", "configuration": {"a": 1, "b": 2}, "inputs": {"chunk": "x"}}
    keys = {stage_key(**base)}
    assert keys == {stage_key(**base | {"configuration": {"b": 2, "a": 1}})} and len(next(iter(keys))) == 64
    for change in (
        {"stage": "enet"},
        {"code_digest": "d"},
        {"configuration": {"a": 1, "b": 3}},
        {"inputs": {"chunk": "y"}},
        {"weights_digest": "w"},
    ):
        keys.add(stage_key(**base | change))
    assert len(keys) == 6
