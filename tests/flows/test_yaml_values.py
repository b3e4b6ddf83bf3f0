"""YAML as people write it: values as they are written, and one line with file and line for a mistake."""

from __future__ import annotations

import codecs
import math
from pathlib import Path
from typing import Any

import pytest
import yaml

from flows.yaml_values import MAX_BYTES, YamlError, parse_yaml, read_yaml_mapping
from genre_tasks.errors import ConfigError
from tests.ordinary_user import as_ordinary_user

ROOT = Path(__file__).resolve().parents[2]


def read(path: Path) -> dict[str, Any]:
    return read_yaml_mapping(path, "configuration file", "sections", "Check --config.").values


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("010", 10),
        ("1:30", "1:30"),
        ("0x10", "0x10"),
        ("0o7", "0o7"),
        ("1_000", "1_000"),
        ("+3", 3),
        (".5", 0.5),
        ("1e5", 100_000),
        ("1.5e-3", 0.0015),
        ("NaN", "NaN"),
        (".inf", math.inf),
        ("-.INF", -math.inf),
        ("2026-01-02", "2026-01-02"),
        ("=", "="),
        ("'8'", "8"),
        ("|\n  a\n  b", "a\nb"),
        ("", None),
        ("~", None),
        ("true", True),
    ],
)
def test_values_are_what_is_written(text: str, value: object) -> None:
    """Report: yaml/pyyaml#107 (a leading zero), rbgirshick/yacs#46 (1e-3 is text)."""
    found = parse_yaml(text)
    assert found == value and type(found) is type(value)


@pytest.mark.parametrize("word", ["yes", "no", "on", "off", "Yes", "OFF", "y", "n"])
def test_words_of_yaml_1_1_are_words(word: str) -> None:
    """Report: none found for a reconstruction; case 15 of the list of odd logs."""
    assert parse_yaml(f"{{a: {word}}}") == {"a": word}
    assert parse_yaml(f"{word}: 1") == {word: 1}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a: 1\nb: 2\na: 3", "line 3: the key 'a' is there twice, the first time in line 1"),
        ("a:\n  b: {c: 1, c: 2}", "line 2: the key 'c' is there twice"),
        ("a: &x [1]\nb: *x", "line 1: anchors and aliases"),
        ("a: *x", "line 1: anchors and aliases"),
        ("a: 1\nb: !!binary aGk=", "line 2: tags"),
        ("a: !!python/name:os.system", "line 1: tags"),
        ("base: {a: 1}\n<<: {b: 2}", "line 2: merge keys"),
        ("? [a, b]\n: 1", "line 1: a key is a list or a mapping"),
        ("a: 1\n---\nb: 2", "line 2: a second document"),
        ("a:\n\t- b", "line 2: found character"),
        ("a: [1,\n  2\nb: 3", "that begins in line 1"),
        ("a: b\x07", "line 1: the character U+0007"),
        ("a: 1\nb: " + "9" * 5000, "line 2: a number has 5000 digits"),
    ],
)
def test_what_could_surprise_is_refused_with_its_line(text: str, words: str) -> None:
    """Report: rbgirshick/yacs#17, yaml/pyyaml#165 (duplicate keys)."""
    with pytest.raises(YamlError) as caught:
        parse_yaml(text)
    assert words in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize("text", ["[" * 3000, "{" * 3000, "- " * 3000, "{a: " * 3000, "[" * 3000 + "]" * 3000])
def test_deep_nesting_is_an_error_and_not_the_end_of_the_stack(text: str) -> None:
    """Report: yaml/pyyaml#895."""
    with pytest.raises(YamlError, match="nested more than"):
        parse_yaml(text)


def test_a_list_of_aliases_of_aliases_does_not_grow() -> None:
    """Report: none found for a configuration of 3DGS; case 15 of the list of odd logs."""
    lines = ["a0: &a0 [x, x]", *(f"a{k}: &a{k} [*a{k - 1}, *a{k - 1}]" for k in range(1, 40))]
    with pytest.raises(YamlError, match="anchors"):
        parse_yaml("\n".join(lines))


@pytest.mark.parametrize("name", [p.name for p in (ROOT / "configs").glob("*.yaml")])
def test_our_own_files_read_the_same(name: str) -> None:
    text = (ROOT / "configs" / name).read_text()
    assert parse_yaml(text) == yaml.safe_load(text)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (codecs.BOM_UTF16_LE + "a: 1".encode("utf-16-le"), "UTF-16"),
        ("a: 1".encode("utf-16-be"), "UTF-16"),
        (b"a: 1\nb: caf\xe9\n", "line 2 has the byte 0xE9"),
        (b"\x89PNG\r\n\x1a\n\x00\x00", "no text in UTF-8"),
        (b"- a\n- b\n", "expected sections at the top level"),
        (b"8", "expected sections at the top level"),
        (b"a: 1\n" * (MAX_BYTES // 5 + 1), "more than 200000 bytes"),
        (b"a: [1", "line 1"),
    ],
)
def test_a_file_that_is_none_is_named(tmp_path: Path, data: bytes, words: str) -> None:
    """Report: pre-commit/pre-commit#1550 (a file in UTF-16)."""
    path = tmp_path / "c.yaml"
    path.write_bytes(data)
    with pytest.raises(ConfigError) as caught:
        read(path)
    assert words in str(caught.value) and "c.yaml" in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_a_folder_a_device_and_a_missing_file_are_named(tmp_path: Path) -> None:
    """Report: none found; case 15 of the list of odd logs."""
    for path in (tmp_path, tmp_path / "none.yaml", tmp_path / ("x" * 300), Path("/dev/zero")):
        with pytest.raises(ConfigError) as caught:
            read(path)
        assert str(path) in str(caught.value)


def test_an_unreadable_file_is_named(tmp_path: Path) -> None:
    """Report: none found; case 15 of the list of odd logs."""
    (tmp_path / "c.yaml").write_text("a: 1")
    assert read(tmp_path / "c.yaml") == {"a": 1}
    with as_ordinary_user(tmp_path) as folder:
        assert read(folder / "c.yaml") == {"a": 1}
        (folder / "c.yaml").chmod(0)
        with pytest.raises(ConfigError, match="Permission denied"):
            read(folder / "c.yaml")


@pytest.mark.parametrize("data", [b"", b"# nothing\n", b"\n\n", b"---\n"])
def test_an_empty_file_changes_nothing(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "c.yaml").write_bytes(data)
    assert read(tmp_path / "c.yaml") == {}


def test_a_bom_and_windows_line_ends_are_no_mistake(tmp_path: Path) -> None:
    """Report: appveyor/ci#1573 (UTF-8 with a byte-order mark)."""
    path = tmp_path / "c.yaml"
    path.write_bytes(codecs.BOM_UTF8 + b"gnet:\r\n  iterations: 8\r\n")
    assert read(path) == {"gnet": {"iterations": 8}}
