"""Buckets that do not exist: every cloud has words of its own for them, and a program must not end in a fault."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import obstore
import pytest
from obstore.exceptions import NotFoundError

from genre_tasks.errors import InputError, TransientIOError
from storage.objects.bucket import Bucket, ObjectVersion

MISSING = [
    "<Error><Code>NoSuchBucket</Code></Error>",
    "<Error><Code>ContainerNotFound</Code><Message>The specified container does not exist.</Message></Error>",
    "The specified bucket does not exist.",
]


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> Bucket:
    monkeypatch.setattr(Bucket, "_client", lambda self: None)
    return Bucket("az://container/store")


def answer_with(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    def refuse(*args: Any, **options: Any) -> Any:
        raise NotFoundError(text)

    for name in ("get", "put", "list", "delete"):
        monkeypatch.setattr(obstore, name, refuse)


@pytest.mark.parametrize("text", MISSING)
def test_every_clouds_words_for_it_are_known(bucket: Bucket, monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    answer_with(monkeypatch, text)
    for call in (lambda: bucket.read("a"), lambda: list(bucket.list()), lambda: bucket.delete(["a"])):
        with pytest.raises(InputError, match=r"no such bucket.*--store"):
            call()


@pytest.mark.parametrize("text", [*MISSING, "words that nobody knows"])
def test_what_is_written_is_never_just_absent(
    bucket: Bucket, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, text: str
) -> None:
    answer_with(monkeypatch, text)
    (tmp_path / "file").write_bytes(b"x")
    for call in (
        lambda: bucket.write("a", b"x"),
        lambda: bucket.create("a", b"x"),
        lambda: bucket.upload("a", tmp_path / "file"),
    ):
        with pytest.raises(InputError, match=r"no such bucket.*--store"):
            call()


def test_an_object_that_is_gone_is_no_missing_bucket(bucket: Bucket, monkeypatch: pytest.MonkeyPatch) -> None:
    answer_with(monkeypatch, "<Error><Code>BlobNotFound</Code></Error>")
    assert bucket.read("a") is None and bucket.replace("a", b"x", ObjectVersion("e")) is None
    answer_with(monkeypatch, "<Error><Code>NoSuchUpload</Code></Error>")
    with pytest.raises(TransientIOError, match="ended by the store"):
        bucket.write("a", b"x")
