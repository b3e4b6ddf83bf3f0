"""The page of what each log came to: means over orders, bounds, arrows, and dashes for what a log has not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from benchmarks.common.claims import Result, write_json
from benchmarks.optimiser import per_log_tables
from benchmarks.optimiser.per_log_tables import Column, by_log, pages, table


def _race(order: int, reached: float | None, behind: float) -> dict[str, Any]:
    variant = {
        "reached_s": reached,
        "psnr_at_equal_renders": 28.0 - behind,
        "curve": [[0, 0, 20, 9, 19], [4, 9, 27, 9, 22]],
    }
    gnet = {"seconds": 2.0 + 2 * order, "psnr": 28.0, "curve": [[0, 0, 20.0, 9, 19.0], [2.0, 9, 28.0, 9, 23.0]]}
    where = {"log": "synthetic:street?seed=1", "chunk": 0, "order": order, "method": "tuned_adam", "cap": 5.0}
    return {**where, "gnet": gnet, "variants": {"a": variant}}


def _distillation(log: str) -> dict[str, Any]:
    mark = [3.0, 9, 0.2, 24.0, 28.0]
    family = {"best": [9.0, 9, 0.21, 24.1, 28.0], "reached_s": 6.0, "enet_as_good": True, "enet_first_s": 1.5}
    return {"log": log, "chunk": 0, "order": 0, "start": mark, "enet": mark, "adam": family}


def test_a_log_has_one_line_of_the_means_over_its_orders() -> None:
    head, _, line, *rest = pages({"a": _race(0, 6.0, 1.0), "b": _race(1, None, 2.0)})
    cells = dict(zip(head.split(" | "), line.split(" | "), strict=True))
    assert cells["| log"] == "| street?seed=1 chunk 0" and cells["orders"] == "2"
    assert cells["GNet, s"] == "3.0" and cells["GNet, PSNR at 3 m"] == "23.00"
    assert cells["tuned Adam, best PSNR at 3 m"] == "22.00"
    assert cells["GNet over tuned Adam at equal renders, dB"] == "1.50"
    assert rest == [""]


def test_logs_stand_in_the_order_of_the_race_in_every_table() -> None:
    races = {name: _race(0, None, 1.0) | {"log": f"synthetic:{name}"} for name in "ba"}
    distilled = {f"distillation/{name}": _distillation(f"synthetic:{name}") for name in "ab"}
    lines = [line for line in pages(races | distilled) if "chunk" in line]
    assert [line.partition(" chunk")[0] for line in lines] == ["| b", "| a"] * 2


def test_a_mean_with_a_bound_is_a_bound_and_what_is_missing_is_a_dash() -> None:
    column = Column("x", "k", lambda r: r.get("x"), 1, at_least=lambda r: bool(r.get("cap")))
    arrow = Column("y", "k", lambda r: r.get("x"), 2, then=lambda r: r.get("y"))
    rows = [{"log": name, "chunk": 0, "x": x, "cap": x == 5, "y": 1.0} for name, x in (("a", 3), ("a", 5), ("b", 2))]
    rows.append({"log": "c", "chunk": 0})
    assert list(table([column, arrow], {"k": by_log(rows)}))[2:] == [
        "| a chunk 0 | 2 | ≥ 4.0 | 4.00 → 1.00 |",
        "| b chunk 0 | 1 | 2.0 | 2.00 → 1.00 |",
        "| c chunk 0 | 1 | – | – |",
    ]


def test_the_page_of_a_written_result(tmp_path: Path, capsys: Any) -> None:
    rows = [_distillation("synthetic:s") | {"cell": "distillation/a"}]
    rows.append({"cell": "distillation/b", "not_measured": "no time"})
    write_json(tmp_path / "a.json", Result(machine="m", commit="a" * 40, rows=rows, claims=[]).model_dump(mode="json"))
    per_log_tables.main([str(tmp_path / "a.json")])
    lines = capsys.readouterr().out.splitlines()
    assert lines[2].startswith("| s chunk 0 | 1 | 2 | 3.0 | 0.200 → 0.200 | 24.00 → 24.00 |")
    assert "| 0.210 | 24.10 | 6 | 1.0 | 0.500 | 0.250 | – |" in lines[2]
