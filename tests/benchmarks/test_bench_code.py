"""The code that a benchmark's cached rows depend on: what is looked up by name is part of it."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.common.bench import Bench
from benchmarks.common.lazy_modules import CODEC_MODULES, FORMAT_MODULES, STAGE_MODULES
from flows.cli.bench import _BENCHES, load_bench
from flows.pipeline.definition import PIPELINE
from genre_tasks.code_closure import import_closure
from genre_tasks.exchange.registry import _FORMATS

ROOT = Path(__file__).resolve().parents[2]
WITHOUT_STAGES = ("log_faults", "raster")


def _modules(name: str) -> set[str]:
    bench: Bench = load_bench(name)
    return set(import_closure(bench.code[0], bench.code[1:], ROOT).modules)


def test_the_shared_lists_are_those_of_the_registries() -> None:
    assert {spec.module for spec in PIPELINE} | {"genre_tasks.effects.exposure"} <= set(STAGE_MODULES)
    assert set(FORMAT_MODULES) == {entry.target.partition(":")[0] for entry in _FORMATS.values()}


@pytest.mark.parametrize("name", sorted(set(_BENCHES) - set(WITHOUT_STAGES)))
def test_the_code_of_a_benchmark_has_all_stages_and_effects(name: str) -> None:
    assert set(STAGE_MODULES) <= _modules(name)


@pytest.mark.parametrize(
    ("name", "modules"),
    [
        ("evaluation", {"genre_tasks.logs.pandaset.reader", "flows.cli.run"}),
        ("exchange", {*FORMAT_MODULES, "flows.simulators.neuroncap", "flows.viewer.offline_page"}),
        ("log_faults", {"genre_tasks.logs.kitti.reader"}),
        ("optimiser", {"flows.training.optimiser_training"}),
        ("perception", {"flows.paper_tables.detector_study"}),
        ("scale", {*CODEC_MODULES, *FORMAT_MODULES}),
        ("simulation", {"flows.paper_tables.simulation_scores", "genre_tasks.ego_paths.recorded_driving"}),
        ("start_up", {*CODEC_MODULES}),
    ],
)
def test_the_code_of_a_benchmark_has_what_does_the_work(name: str, modules: set[str]) -> None:
    assert modules <= _modules(name)
