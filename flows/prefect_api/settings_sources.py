"""Where a setting of Prefect comes from: files, the environment or a profile, read without importing Prefect."""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from genre_tasks.errors import ConfigError
from genre_tasks.user_paths import expand_user_path

API_URL = "PREFECT_API_URL"
"""The setting with the address of the user's own Prefect server."""

_ENV_FILE = Path(".env")
_ENV_ASSIGNMENT = re.compile(r"^\s*(?:export\s+)?(\w+)\s*=", re.MULTILINE)
# Prefect reads these in the working folder: (file, the table that holds its settings).
_TOML_FILES = ((Path("prefect.toml"), ()), (Path("pyproject.toml"), ("tool", "prefect")))


def check_settings_files() -> None:
    """Checks the files of settings in the working folder that Prefect reads whenever it is imported.

    Raises:
        ConfigError: one of them cannot be read, which Prefect would answer with a traceback.
    """
    for path, _ in _TOML_FILES:
        _read_toml(path)
    _read_env_file()


def find_source(variable: str) -> str | None:
    """Finds where Prefect has a setting from, without importing Prefect, which takes a second.

    Args:
        variable: the setting as a variable of the environment, such as ``PREFECT_API_URL``.

    Returns:
        One sentence for an error's remedy, which says how to undo it; ``None`` for a setting that nobody made.

    Raises:
        ConfigError: a file that Prefect reads cannot be read.

    >>> os.environ["PREFECT_EXAMPLE"] = "1"
    >>> find_source("PREFECT_EXAMPLE")
    'It comes from the environment: unset PREFECT_EXAMPLE.'
    >>> del os.environ["PREFECT_EXAMPLE"]
    """
    # In Prefect's own order, first hit wins. An empty variable counts as none there.
    for name, value in os.environ.items():
        if value and name.upper() == variable:
            return f"It comes from the environment: unset {name}."
    for path, setting in _settings_in_files(variable):
        return f"It comes from {path.absolute()}: remove {setting} there."
    profiles = _profiles_file()
    if variable in _read_active_profile(profiles):
        return f"It comes from a Prefect profile ({profiles}): prefect config unset {variable}."
    return None


def find_prefect_home() -> Path:
    """Finds the folder of Prefect's database and profiles.

    Returns:
        ``PREFECT_HOME``, or ``~/.prefect`` where that is unset or empty.

    Raises:
        InputError: it begins with the home folder of a user who is not there.
    """
    return expand_user_path(os.environ.get("PREFECT_HOME") or "~/.prefect")


def _profiles_file() -> Path:
    stated = os.environ.get("PREFECT_PROFILES_PATH")
    return expand_user_path(stated) if stated else find_prefect_home() / "profiles.toml"


def _read_active_profile(profiles: Path) -> Mapping[str, Any]:
    known = _read_toml(profiles)
    active = os.environ.get("PREFECT_PROFILE") or known.get("active", "")
    settings = known.get("profiles", {})
    is_readable = isinstance(settings, Mapping) and isinstance(active, str)
    profile = settings.get(active, {}) if is_readable else {}
    return profile if isinstance(profile, Mapping) else {}


def _settings_in_files(variable: str) -> Iterator[tuple[Path, str]]:
    """(file, name of the setting in it) of every file of the working folder that sets a variable."""
    for name in _ENV_ASSIGNMENT.findall(_read_env_file()):
        # Prefect takes the names of variables in any case.
        if name.upper() == variable:
            yield _ENV_FILE, name
    # PREFECT_API_URL is api.url in a file of tables.
    keys = variable.removeprefix("PREFECT_").lower().split("_", 1)
    for path, table in _TOML_FILES:
        value: Any = _read_toml(path)
        for key in (*table, *keys):
            value = value.get(key) if isinstance(value, Mapping) else None
        if value is not None:
            yield path, ".".join(keys)


def _read_env_file() -> str:
    try:
        return _ENV_FILE.read_text(encoding="utf-8")
    except (FileNotFoundError, IsADirectoryError):
        return ""
    except (OSError, UnicodeDecodeError) as error:
        raise _unreadable(_ENV_FILE, error) from error


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
        return {}
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> ConfigError:
    problem = f"Prefect reads settings from this file, and it cannot be read ({error})"
    remedy = "Mend or remove the file, or run the command in another folder if it is of this one."
    return ConfigError(problem, remedy=remedy, file=path.absolute())
