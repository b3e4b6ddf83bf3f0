"""The line below a table says how it was measured."""

from __future__ import annotations

from typing import Any

import pytest

from docs import result_tables


def provenance_of(monkeypatch: pytest.MonkeyPatch, rows: list[dict[str, Any]], **facts: Any) -> str:
    loaded = {"machine": "m", "commit": "a" * 40, "rows": rows} | facts
    monkeypatch.setattr(result_tables, "result", lambda name: loaded)
    return result_tables.provenance("evaluation")


COMMAND = "genre bench evaluation --json docs/results/data/evaluation.json"


def test_a_file_that_notes_no_options_names_the_command_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    expected = f"Measured on m at commit `aaaaaaaaaaaa` by `{COMMAND}`.\n"
    assert provenance_of(monkeypatch, [{"cell": "a"}]) == expected
    assert provenance_of(monkeypatch, [{"cell": "a"}], options={}) == expected


def test_options_of_all_rows_are_part_of_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    found = provenance_of(monkeypatch, [{"cell": "a"}], options={"rounds": "3", "seeds": "1001&frames=40"})
    assert f"by `{COMMAND} --set rounds=3 --set 'seeds=1001&frames=40'`." in found


def test_rows_of_other_options_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [{"cell": "a"}, {"cell": "b", "options": {}}, {"cell": "c"}]
    found = provenance_of(monkeypatch, rows, options={"rounds": "3"})
    assert f"by `{COMMAND}`, with `--set rounds=3` for 2 of 3 rows." in found
