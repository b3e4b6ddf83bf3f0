"""A real S3 server for tests: one for all tests of a process, with a prefix for each test."""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from pathlib import Path

import pytest

from flows.operations import ObjectServer


@pytest.fixture(scope="session")
def object_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ObjectServer]:
    server = ObjectServer(tmp_path_factory.mktemp("objects")).start()
    yield server
    # At once: a gentle stop takes long, and nobody needs the data.
    server.kill()


@pytest.fixture
def bucket_uri(object_server: ObjectServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A URI below which nothing is yet, with the environment that reaches it and a cache of its own."""
    for name, value in object_server.env().items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("GENRE_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("GENRE_STORE_RETRY_SECONDS", "10")
    return f"s3://{object_server.bucket}/{uuid.uuid4().hex}"
