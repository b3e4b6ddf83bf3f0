"""Options of tables and figures that would have no effect are refused before anything is read or computed."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from flows.cli.detector_table import DetectorTableParts
from flows.cli.main import app
from flows.paper_tables.detector_flow import DetectorRequest
from flows.paper_tables.request import TableRequest
from genre_tasks.errors import ConfigError

LOG = "synthetic:street?seed=1000"
TEST_LOG = "synthetic:street?seed=1001"
CHOICES = (["--camera", "front_camera"], ["--frame", "0"], ["--actor", "car"], ["--method", "method.yaml"])


class Checked(Exception):
    """Raised in place of the check of a request, which reads logs."""


@pytest.fixture
def stopped_at_the_check(monkeypatch: pytest.MonkeyPatch) -> None:
    def stop(request: TableRequest | DetectorRequest) -> None:
        raise Checked

    monkeypatch.setattr(TableRequest, "check", stop)
    monkeypatch.setattr(DetectorRequest, "check", stop)


@pytest.mark.parametrize(
    "option",
    [
        ["--cameras", "transforms.json"],
        ["--images", "images"],
        ["--lidar", "points.ply"],
        ["--up", "0,0,1"],
        ["--scale", "1"],
        ["--chunk-frames", "8"],
        ["--chunk-frames", "0"],
    ],
)
def test_table_8_refuses_the_options_of_a_scene(option: list[str], stopped_at_the_check: None, tmp_path: Path) -> None:
    words = ["table", "8", LOG, "--test", TEST_LOG, "--out", str(tmp_path)]
    assert isinstance(CliRunner().invoke(app, words).exception, Checked)
    result = CliRunner().invoke(app, [*words, *option])
    assert isinstance(result.exception, ConfigError)
    assert f"no use for {option[0]}" in result.exception.problem and result.exception.remedy == "Leave it out."


@pytest.mark.parametrize("number", ["1", "7"])
def test_other_tables_refuse_seeds(number: str, stopped_at_the_check: None, tmp_path: Path) -> None:
    words = ["table", number, LOG, "--out", str(tmp_path)]
    result = CliRunner().invoke(app, [*words, "--seeds", "3"])
    assert isinstance(result.exception, ConfigError) and result.exception.problem == "--seeds belongs to table 8"
    assert isinstance(CliRunner().invoke(app, words).exception, Checked)


def test_table_8_has_three_seeds_unless_it_is_asked_for_others() -> None:
    parts = DetectorTableParts([LOG], [TEST_LOG], "small", "store", None, None, Path("tables"))
    assert parts.request(None, None).seeds == 3 and parts.request(0, None).seeds == 0


@pytest.mark.parametrize(
    ("kind", "used"),
    [
        ("recon", {"--camera", "--frame", "--method"}),
        ("fixers", {"--camera", "--frame", "--method"}),
        ("swerve", {"--camera", "--method"}),
        ("manipulation", {"--camera", "--frame", "--actor"}),
        ("agreement", {"--frame", "--method"}),
    ],
)
def test_a_figure_refuses_what_it_does_not_use(
    kind: str, used: set[str], stopped_at_the_check: None, tmp_path: Path
) -> None:
    for option in CHOICES:
        result = CliRunner().invoke(app, ["figure", kind, LOG, "--out", str(tmp_path / "x.png"), *option])
        if option[0] in used:
            assert isinstance(result.exception, Checked)
        else:
            assert isinstance(result.exception, ConfigError)
            assert result.exception.problem == f"the figure {kind} has no use for {option[0]}"
            assert "it belongs to" in result.exception.remedy
