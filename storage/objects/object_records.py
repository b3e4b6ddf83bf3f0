"""Record folders of a store in a bucket: copies on this machine that are brought up to date by pulls and pushes."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import suppress
from datetime import datetime
from pathlib import Path

from genre_tasks.atomic_path import atomic_path
from genre_tasks.errors import ConfigError
from storage.files import digest_file
from storage.objects.bucket import Bucket, ObjectInfo
from storage.records import can_start_name, split_record_name

# Hidden, so that no record has this name: what every file was at the last pull or push.
_SYNC = ".sync.json"


class ObjectRecordFolders:
    """Record folders in a bucket: see :class:`storage.records.RecordFolders`.

    Args:
        bucket: of the store.
        folder: of the copies on this machine.
    """

    def __init__(self, bucket: Bucket, folder: Path) -> None:
        self._bucket = bucket
        self._folder = folder

    def pull(self, name: str) -> Path:
        """Brings a folder with its files to this machine: see :meth:`storage.records.RecordFolders.pull`."""
        parts = split_record_name(name)
        folder = self._folder.joinpath(*parts)
        known = _read_sync(folder)
        listed = {info.name[len(name) + 1 :]: info for info in self._bucket.list(name)}
        # Somebody may have uploaded a folder with hidden files.
        found = {file: info for file, info in listed.items() if _is_record_name(file)}
        for file, info in found.items():
            self._bring(folder, file, info, known)
        # What was in the bucket once and is not any more. Files that were never pushed stay.
        for file in set(known) - set(found):
            (folder / file).unlink(missing_ok=True)
            del known[file]
        if found or known:
            _write_sync(folder, known)
        return folder

    def push(self, name: str) -> None:
        """Uploads the files that changed: see :meth:`storage.records.RecordFolders.push`."""
        folder = self._folder.joinpath(*split_record_name(name))
        known = _read_sync(folder)
        for file, path in _list_files(folder):
            digest = digest_file(path)
            if known.get(file, {}).get("sha256") == digest:
                continue
            known[file] = {"sha256": digest, "e_tag": self._bucket.upload(f"{name}/{file}", path)}
        _write_sync(folder, known)

    def remove(self, name: str) -> None:
        """Removes a folder: see :meth:`storage.records.RecordFolders.remove`."""
        folder = self._folder.joinpath(*split_record_name(name))
        self._bucket.delete([info.name for info in self._bucket.list(name)])
        shutil.rmtree(folder, ignore_errors=True)

    def find(self, parent: str, file: str, start: str = "") -> list[Path]:
        """Finds a file of many folders: see :meth:`storage.records.RecordFolders.find`."""
        split_record_name(parent)
        if not can_start_name(start):
            return []
        found: list[tuple[datetime, str, Path]] = []
        for info in self._bucket.list(parent, start):
            name, _, rest = info.name[len(parent) + 1 :].partition("/")
            if rest != file or not name.startswith(start) or not _is_record_name(name):
                continue
            folder = self._folder.joinpath(*split_record_name(f"{parent}/{name}"))
            known = _read_sync(folder)
            if self._bring(folder, file, info, known):
                _write_sync(folder, known)
            found.append((info.modified, name, folder / file))
        return [path for _, _, path in sorted(found)]

    def _bring(self, folder: Path, file: str, info: ObjectInfo, known: dict[str, dict[str, str]]) -> bool:
        """Downloads a file if it changed; whether it did."""
        target = folder / file
        if known.get(file, {}).get("e_tag") == info.e_tag and target.is_file():
            return False
        target.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(target) as part:
            digest, _ = self._bucket.download(info.name, part)
        # The order in which records were written is that of their times.
        os.utime(target, (info.modified.timestamp(), info.modified.timestamp()))
        known[file] = {"sha256": digest, "e_tag": info.e_tag}
        return True


def _is_record_name(name: str) -> bool:
    with suppress(ConfigError):
        return bool(split_record_name(name))
    return False


def _list_files(folder: Path) -> Iterator[tuple[str, Path]]:
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder)
        if path.is_file() and not any(part.startswith(".") for part in name.parts):
            yield name.as_posix(), path


def _read_sync(folder: Path) -> dict[str, dict[str, str]]:
    try:
        known: dict[str, dict[str, str]] = json.loads((folder / _SYNC).read_bytes())
        return known
    except (FileNotFoundError, ValueError):
        # Without it all files are downloaded and uploaded again, which is slow and right.
        return {}


def _write_sync(folder: Path, known: dict[str, dict[str, str]]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_path(folder / _SYNC) as part:
        part.write_text(json.dumps(known), encoding="utf-8")
