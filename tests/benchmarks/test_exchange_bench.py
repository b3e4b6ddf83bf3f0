"""The cells of exchange: what their rows depend on, and claims that stand without optional packages."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.common.bench import Cell
from benchmarks.exchange import BENCH, service_report
from benchmarks.exchange.enhancement import EnhancementCase
from genre_tasks.source_code import read_source


def _cells(quick: bool = False, **options: str) -> dict[str, Cell]:
    return {cell.name: cell for cell in BENCH.cells(dict(BENCH.options) | options, quick)}


def test_every_cell_depends_on_the_options_that_it_reads() -> None:
    cells = _cells()
    for options in ({"settings": "gnet.iterations=3"}, {"preset": "demo"}):
        changed = _cells(**options)
        same = {name for name, cell in cells.items() if changed[name].parameters == cell.parameters}
        assert same == {"import speed", "answers"}
    assert set(cells["page viewer"].parameters["weights"]) == {"gnet", "fnet", "enet"}
    quick = _cells(quick=True)
    for name in ("import speed", "answers"):
        assert quick[name].parameters != cells[name].parameters


def test_enhancement_is_measured_with_the_preset_and_the_settings() -> None:
    cell = _cells(seeds="900", preset="demo", settings="gnet.iterations=3")["enhancement synthetic:street?seed=900"]
    (case, _) = cell.measure.args  # type: ignore[attr-defined]
    assert case == EnhancementCase("synthetic:street?seed=900", "genre-store", "demo", ("gnet.iterations=3",))
    base = case.base_job().config
    assert (base["gnet"]["method"], base["gnet"]["iterations"]) == ("standard_3dgs", 3)


def test_claims_on_services_need_none_of_their_packages() -> None:
    source = read_source(Path(service_report.__file__), service_report.__name__)
    assert {module.partition(".")[0] for module in source.imports} == {"__future__", "collections", "benchmarks"}
    assert not any(module.startswith("benchmarks.exchange") for module in source.imports)


@pytest.mark.parametrize("name", ["service_failed", "service_p95", "http_overhead", "driving_steps", "answer_help"])
def test_what_was_not_measured_fails(name: str) -> None:
    claims = {claim.id: claim for claim in BENCH.claims({})}
    assert claims[f"exchange.{name}"].measured is None
