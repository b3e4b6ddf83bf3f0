"""What a run leaves behind holds no credentials of its environment."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.faults import small_run

pytestmark = pytest.mark.slow
SECRETS = {
    "AWS_ACCESS_KEY_ID": "AKIAPLANTEDKEY",
    "AWS_SECRET_ACCESS_KEY": "planted-secret-of-aws",
    "PREFECT_SERVER_API_AUTH_STRING": "genre:planted-password-of-prefect",
    "PREFECT_API_AUTH_STRING": "genre:planted-password-of-prefect",
    "GENRE_DATABASE_PASSWORD": "planted-password-of-postgres",
}


def _find_secrets(folder: Path) -> list[str]:
    found = []
    for path in folder.rglob("*"):
        if path.is_file():
            data = path.read_bytes()
            found += [f"{path}: {name}" for name, secret in SECRETS.items() if secret.encode() in data]
    return found


def test_a_run_writes_no_secret(tmp_path: Path) -> None:
    store = tmp_path / "store"
    done = small_run.genre(tmp_path, *small_run.arguments(store), **SECRETS)
    assert done.returncode == 0, done.stderr[-3000:]
    assert not _find_secrets(store)
    failed = small_run.genre(
        tmp_path, *small_run.arguments(tmp_path / "other", "--set", "gnet.iterations=-1"), **SECRETS
    )
    assert failed.returncode != 0
    for text in (done.stdout, done.stderr, failed.stdout, failed.stderr):
        assert not [name for name, secret in SECRETS.items() if secret in text]


def test_a_planted_secret_is_found(tmp_path: Path) -> None:
    (tmp_path / "manifest.json").write_text(SECRETS["AWS_SECRET_ACCESS_KEY"])
    assert len(_find_secrets(tmp_path)) == 1
