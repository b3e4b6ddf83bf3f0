"""The record of the services that run detached: who they are, so that a reused process id is not mistaken."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from urllib.parse import urlsplit

from flows.operations.file_lock import lock_file
from genre_tasks.atomic_path import atomic_path
from genre_tasks.errors import ConfigError, ResourceError
from genre_tasks.json_files import read_json_object
from genre_tasks.process_start import read_start_ticks

# Services that no option changes, and that know nothing of the others.
_INDEPENDENT = {"store-server", "postgres"}
OPTIONS_FILE = "options.json"
"""Lies in the state folder and says what its services were started with."""


@dataclass(frozen=True)
class ServiceRecord:
    """A started service.

    Args:
        name: the service's name.
        pid: its process, which leads a session.
        start_ticks: the process's start, in clock ticks since the machine's; tells it from a later one of this id.
        since: when it was started, ISO 8601 in UTC.
        url: where it listens, without credentials; may be empty.
        log: the path of its log.
    """

    name: str
    pid: int
    start_ticks: int
    since: str
    url: str
    log: str

    @property
    def alive(self) -> bool:
        """Whether this very process still runs."""
        return read_start_ticks(self.pid) == self.start_ticks

    @property
    def port(self) -> int:
        """The TCP port that it listens at; 0 where it listens nowhere."""
        return urlsplit(self.url).port or 0


def read_records(folder: Path) -> dict[str, ServiceRecord]:
    """Returns the records of a state folder by name, empty where there are none.

    Raises:
        ConfigError: the file is not one of records.
    """
    file = folder / "services.json"
    if not file.exists():
        return {}
    try:
        return {name: ServiceRecord(**fields) for name, fields in json.loads(file.read_text()).items()}
    except (ValueError, TypeError, AttributeError) as error:
        raise ConfigError("not a record of services", remedy="Remove it after ending them.", file=file) from error


def write_records(folder: Path, records: Mapping[str, ServiceRecord]) -> None:
    """Replaces the records of a state folder in one step.

    Raises:
        ResourceError: they cannot be written, as on a full disk; those of before stay.
    """
    file = folder / "services.json"
    text = json.dumps({name: asdict(record) for name, record in records.items()}, indent=1)
    try:
        with atomic_path(file) as part:
            part.touch(mode=0o600)
            part.write_text(text)
    except OSError as error:
        raise ResourceError(
            f"the record of services cannot be written ({error.strerror})",
            remedy="Free space there, or name another folder with --folder.",
            file=file,
        ) from error


def keep_options(folder: Path, options: Mapping[str, str]) -> None:
    """Records what services are started with, unless some run that were started otherwise.

    Args:
        folder: the state folder.
        options: what each decides, and the command's option that decided it.

    Raises:
        ConfigError: services run that were started with others.
    """
    file = folder / OPTIONS_FILE
    running = {name for name, record in read_records(folder).items() if record.alive}
    # A start that failed for want of PostgreSQL may be tried again with another database: the object store serves both.
    if file.exists() and running - _INDEPENDENT:
        remedy = "End them by `genre ops down`, or name another state folder with --folder."
        known = read_json_object(file, "options of the services", remedy, kind=ConfigError)
        for name, option in options.items():
            if known.get(name, option) != option:
                problem = f"services run that were started with {known[name]}, and not with {option}"
                raise ConfigError(problem, remedy=remedy, file=folder)
    with atomic_path(file) as part:
        part.write_text(json.dumps(options))


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keeps a second command out of the state folder until the first has ended.

    Raises:
        ConfigError: the folder cannot be written, or has no locks.
    """
    path = folder / "lock"
    try:
        # Enterable, so that PostgreSQL's user reaches its data; the files with secrets have mode 600.
        folder.mkdir(mode=0o711, parents=True, exist_ok=True)
        stream = path.open("w")
    except OSError as error:
        remedy = "Name another with --folder."
        raise ConfigError(f"the state folder cannot be written: {error}", remedy=remedy, file=folder) from error
    with stream:
        lock_file(stream, path)
        yield
