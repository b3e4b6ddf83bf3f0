"""Tables on terminals of any width: nothing is cut off, and nothing in a name is taken for markup."""

from __future__ import annotations

import re
from typing import Any

import pytest

from flows.cli.printing import print_fields, print_rows
from flows.cli.run_tables import print_run

LONG = "synthetic:street?seed=900&frames=7&cameras=1&width=64"
METRICS = {"interpolation/psnr": 27.125, "interpolation/ssim": 0.875, "shift_3m/psnr": 21.5, "shift_3m/kernel": 44.25}
RECORD: dict[str, Any] = {
    "log": LONG,
    "run": "021e6b380a2b",
    "report": "/a/long/path/to/a/store/runs/021e6b380a2b/report.html",
    "chunks": [
        {
            "chunk": 0,
            "warnings": ["a note"],
            "stages": [
                {"stage": "novel_views", "cached": True, "seconds": 4.25, "peak_mib": 514.0, "metrics": {}},
                {"stage": "enet", "cached": False, "seconds": 11.5, "peak_mib": 1814.0, "metrics": METRICS},
            ],
        }
    ],
    "left_out": [{"class": "InputError", "chunk": 1, "message": "one frame", "remedy": "Take more."}],
}


def joined(text: str) -> str:
    """The text without what a table adds and folding takes apart."""
    return re.sub(r"[\s│┃|]", "", text)


@pytest.mark.parametrize("columns", [20, 40, 80, 200])
def test_every_value_is_there_at_any_width(
    columns: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Report: ibis-project/ibis#4554."""
    monkeypatch.setenv("COLUMNS", str(columns))
    print_run(RECORD)
    text = capsys.readouterr().out
    # Paths alone stay in one piece, so that they can be clicked.
    assert max(len(line) for line in text.splitlines() if not line.startswith("wrote ")) <= columns
    for value in ("novel_views", "27.125", "0.875", "21.500", "44.250", "1814", "11.5", "kernel@3m", "PSNR@3m"):
        assert value in text
    assert "chunk1isleftout:oneframe.Takemore." in joined(text) and joined(LONG) in joined(text)


@pytest.mark.parametrize("columns", [20, 40, 110])
def test_names_are_no_markup(columns: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Report: none found; case 26 of the list of odd logs."""
    monkeypatch.setenv("COLUMNS", str(columns))
    odd = "/a[b]/[/x]/:smile:/[bold]"
    print_rows(odd, [{"[red]": odd, "key": "5f41"}])
    print_fields(odd, {"a": odd})
    print_run(RECORD | {"report": odd + "/report.html", "run": odd})
    # The title and the value of two tables, the run, the report, and the record beside it.
    assert joined(capsys.readouterr().out).count(odd) == 7
