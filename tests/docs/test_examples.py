"""The examples of the documents run: the notebook, and the stages as plain functions."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

from tests.faults.small_run import LOG, SETTINGS

EXAMPLES = Path(__file__).resolve().parents[2] / "docs/examples"


def test_the_notebook_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nbformat = pytest.importorskip("nbformat")
    nbclient = pytest.importorskip("nbclient")
    monkeypatch.setenv("PYTHONPATH", str(EXAMPLES.parents[1]))
    notebook = nbformat.read(EXAMPLES / "first_look.ipynb", as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells), "commit the notebook without outputs"
    nbclient.NotebookClient(notebook, timeout=280, resources={"metadata": {"path": str(tmp_path)}}).execute()
    shown = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    pictures = [output for output in shown if "image/png" in output.get("data", {})]
    assert len(pictures) == 2
    assert any("text/html" in output.get("data", {}) for output in shown), "the table of views"


def test_the_stages_are_plain_functions() -> None:
    example = runpy.run_path(str(EXAMPLES / "plain_functions.py"))
    scores = example["reconstruct"](LOG, list(SETTINGS))
    assert list(scores) == ["initial", "gnet", "enet"]
    assert all(any(m.name == "interpolation/psnr" for m in e.metrics) for e in scores.values())
