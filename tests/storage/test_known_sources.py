"""What is known of source files from earlier processes: the same digests, whatever state the cache is in."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from genre_tasks.cache_folder import FOLDER_VARIABLE
from genre_tasks.errors import InputError
from genre_tasks.source_code import KNOWN_SOURCES, read_source
from storage import known_sources
from storage.code_digest import _digest_closure, code_digest

MODULE = "genre_tasks.stages.effects"


def _forget() -> None:
    """Brings this process into the state of a new one."""
    KNOWN_SOURCES.clear()
    for function in (read_source, _digest_closure, known_sources._find_file, known_sources._load):
        function.cache_clear()


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The file of an empty cache."""
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path / "cache"))
    _forget()
    yield tmp_path / "cache" / "sources.json"
    monkeypatch.undo()
    _forget()


def test_a_second_process_parses_nothing(cache, monkeypatch):
    digest = code_digest(MODULE)
    _forget()

    monkeypatch.setattr("genre_tasks.source_code._parse", _fail)
    assert code_digest(MODULE) == digest


def _fail(*arguments):
    raise AssertionError(f"parsed {arguments[1]}")


def test_changed_code_has_another_digest(cache, tmp_path):
    package = tmp_path / "genre_tasks"
    package.mkdir()
    (package / "__init__.py").write_text("", encoding="utf-8")
    (package / "stage.py").write_text("X = 1\n", encoding="utf-8")
    digest = code_digest("genre_tasks.stage", root=tmp_path)
    _forget()

    (package / "stage.py").write_text("X = 2\n", encoding="utf-8")
    assert code_digest("genre_tasks.stage", root=tmp_path) != digest


@pytest.mark.parametrize(
    "text", ["", "{", "[]", '{"parser": 1}', '{"parser": "PARSER", "sources": {"KEY": ["d", [1], []]}}']
)
def test_damage_costs_time_only(cache, text):
    digest = code_digest(MODULE)
    values = json.loads(cache.read_text(encoding="utf-8"))
    text = text.replace("PARSER", values["parser"]).replace("KEY", next(iter(values["sources"])))
    cache.write_text(text, encoding="utf-8")
    _forget()

    assert code_digest(MODULE) == digest
    assert json.loads(cache.read_text(encoding="utf-8")) == values


def test_another_parser_is_not_believed(cache):
    digest = code_digest(MODULE)
    values = json.loads(cache.read_text(encoding="utf-8"))
    wrong = {key: ["0" * 64, *entry[1:]] for key, entry in values["sources"].items()}
    cache.write_text(json.dumps({"parser": "0" * 64, "sources": wrong}), encoding="utf-8")
    _forget()

    assert code_digest(MODULE) == digest


def test_a_folder_that_cannot_be_written(cache):
    cache.parent.write_text("a file", encoding="utf-8")
    assert code_digest(MODULE)


def test_a_cache_below_no_home_folder_is_refused(cache, monkeypatch):
    monkeypatch.setenv(FOLDER_VARIABLE, "~nobody-of-this-name/cache")
    with pytest.raises(InputError, match=r"no home folder of this user .*nobody-of-this-name"):
        code_digest(MODULE)
