"""Exchange with other programs: formats, enhancement of foreign scenes, pages in a browser, simulators.

genre bench exchange --json docs/results/data/exchange.json [--set log=synthetic:street?seed=1001] [--set seeds=1001]

Formats, pages and services are measured on one finished run; stages that the store lacks are computed first.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.common.bench import (
    TINY_SETTINGS,
    TINY_STREET,
    Bench,
    Cell,
    NotMeasuredError,
    Row,
    SmallestForm,
    list_not_measured,
    settings_from_options,
    split_option,
)
from benchmarks.common.cell_parameters import describe_preset
from benchmarks.common.claims import Claim
from benchmarks.common.lazy_modules import FORMAT_MODULES, STAGE_MODULES
from benchmarks.exchange.answer_time import answer_time_claims, answer_time_table, measure_answer_time
from benchmarks.exchange.enhancement import (
    EnhancementCase,
    enhancement_claims,
    enhancement_table,
    measure_enhancement,
)
from benchmarks.exchange.import_speed import import_speed_claims, import_speed_table, measure_import_speed
from benchmarks.exchange.interop import interop_claims, interop_table, measure_interop
from benchmarks.exchange.measured_run import RunCase
from benchmarks.exchange.pages import measure_page, pages_claims, pages_table, seek_end, seek_start
from benchmarks.exchange.round_trips import (
    RoundTripCase,
    measure_round_trip,
    round_trip_claims,
    round_trip_table,
)
from benchmarks.exchange.service_fuzz import REQUESTS, service_fuzz_claims, service_fuzz_table
from benchmarks.exchange.service_report import (
    http_service_claims,
    http_service_table,
    service_claims,
    service_table,
)
from flows.exchange.stored_scenes import open_stored_scenes
from flows.machine.facts import git_commit

_FORMATS = ("ply", "splat", "spz", "glb", "usdz")
_HARMONIC_FORMATS = ("ply", "spz", "glb", "usdz")
_ROUNDS = 5
_STEPS = 200
_QUICK_STEPS = 20
_QUICK_REQUESTS = 500
# Estimates for two quiet cores with the run in the store.
_RUN_S = 200.0
_FORMAT_S = 6.0
_SPEED_S = 20.0
_TOOLS_S = 120.0
_PAGE_S = 120.0
_ANSWER_S = 45.0
_SERVICE_S = 60.0
_FUZZ_S = 60.0
_ENHANCE_S = 420.0


class ExchangeBench:
    """A cell for each format, page, service and enhanced scene."""

    name = "exchange"
    options: Mapping[str, str] = {
        "log": "synthetic:street?seed=1001",
        "preset": "small",
        "seeds": "1001,1002,1003",
        "store": "genre-store",
        "settings": "",
    }
    code: tuple[str, ...] = (
        "benchmarks.exchange.answer_time",
        "benchmarks.exchange.enhancement",
        "benchmarks.exchange.import_speed",
        "benchmarks.exchange.interop",
        "benchmarks.exchange.pages",
        "benchmarks.exchange.round_trips",
        "benchmarks.exchange.service",
        "benchmarks.exchange.service_fuzz",
        "benchmarks.exchange.alpasim_client",
        "benchmarks.exchange.http_service",
        # Those below are named by registries alone, or do the work of what is measured.
        "flows.simulators.alpasim.start",
        "flows.simulators.neuroncap",
        "flows.viewer.offline_page",
        *FORMAT_MODULES,
        *STAGE_MODULES,
        # Enhancement reads a file of Gaussians in place of a log's points.
        "genre_tasks.stages.scene_file",
        "genre_tasks.stages.scene_points",
        "genre_tasks.logs.posed_images.image_log",
        "genre_tasks.logs.synthetic",
        "genre_tasks.render.wide_lens",
        "genre_tasks.ego_paths.bicycle",
    )
    smallest = SmallestForm(
        {"log": f"synthetic:street?seed={TINY_STREET}", "seeds": "", "settings": TINY_SETTINGS},
        "round trip ply degree 0",
    )

    def cells(self, options: Mapping[str, str], quick: bool) -> list[Cell]:
        """Lists the cells; ``quick``: the first seed alone, fewer steps and requests."""
        settings = settings_from_options(options)
        case = RunCase(options["log"], options["preset"], settings, options["store"])
        resolved = describe_preset(case.preset, settings)
        parameters = {"log": case.log, **resolved}
        rounds = 3 if quick else _ROUNDS
        steps = _QUICK_STEPS if quick else _STEPS
        requests = _QUICK_REQUESTS if quick else REQUESTS
        trips = [(name, 0) for name in _FORMATS] + [(name, 3) for name in _HARMONIC_FORMATS]
        cells = [
            Cell(
                f"round trip {name} degree {degree}",
                _FORMAT_S if k else _RUN_S,
                partial(_measure_trip, case, name, degree),
                parameters,
            )
            for k, (name, degree) in enumerate(trips)
        ]
        cells += [
            Cell("import speed", _SPEED_S, partial(measure_import_speed, rounds), {"rounds": rounds}),
            Cell("other tools", _TOOLS_S, partial(_measure_tools, case), parameters),
            Cell("page viewer", _PAGE_S, partial(_measure_viewer, case), parameters),
            Cell("page report", _PAGE_S, partial(_measure_report, case), parameters),
            # Whole commands depend on all of the code, which no list of modules covers.
            Cell(
                "answers",
                _ANSWER_S,
                partial(measure_answer_time, rounds),
                {"commit": git_commit(), "rounds": rounds},
            ),
            Cell("service alpasim", _SERVICE_S, partial(_measure_alpasim, case, steps), parameters | {"steps": steps}),
            Cell("service neuroncap", _SERVICE_S, partial(_measure_neuroncap, case), parameters),
            Cell("driving", _SERVICE_S, partial(_measure_driving, case), parameters),
        ]
        for protocol in ("alpasim", "neuroncap"):
            fuzzed = parameters | {"requests": requests}
            measure = partial(_measure_fuzz, case, protocol, requests)
            cells.append(Cell(f"fuzz {protocol}", _FUZZ_S, measure, fuzzed))
        for seed in split_option(options["seeds"])[: 1 if quick else None]:
            log = f"synthetic:street?seed={seed}"
            enhanced = EnhancementCase(log, options["store"], options["preset"], settings)
            measure = partial(measure_enhancement, enhanced, ("scene", "lidar"))
            cells.append(Cell(f"enhancement {log}", _ENHANCE_S, measure, {"log": log, **resolved}))
        return cells

    def claims(self, rows: Mapping[str, Row]) -> Iterator[Claim]:
        """Makes the claims, section by section."""
        yield from round_trip_claims(_select(rows, "round"))
        yield from interop_claims(_select(rows, "other tools"))
        yield from import_speed_claims(_select(rows, "import"))
        yield from enhancement_claims(_select(rows, "enhancement"))
        yield from pages_claims(_select(rows, "page"))
        yield from answer_time_claims(_select(rows, "answers"))
        yield from service_claims(_select(rows, "service alpasim"))
        yield from http_service_claims(_select(rows, "service neuroncap"), _select(rows, "driving"))
        yield from service_fuzz_claims(_select(rows, "fuzz"))

    def table(self, rows: Mapping[str, Row]) -> Iterator[str]:
        """Gives a table for each section, and what was not measured."""
        sections: list[tuple[str, Callable[..., Iterator[str]], tuple[list[Row], ...]]] = [
            ("Formats", round_trip_table, (_select(rows, "round"),)),
            ("Tools of others", interop_table, (_select(rows, "other tools"),)),
            ("Import", import_speed_table, (_select(rows, "import"),)),
            ("Enhanced scenes", enhancement_table, (_select(rows, "enhancement"),)),
            ("Pages", pages_table, (_select(rows, "page"),)),
            ("Answers", answer_time_table, (_select(rows, "answers"),)),
            ("AlpaSim", service_table, (_select(rows, "service alpasim"),)),
            (
                "NeuroNCAP and driving",
                http_service_table,
                (_select(rows, "service neuroncap"), _select(rows, "driving")),
            ),
            ("Malformed requests", service_fuzz_table, (_select(rows, "fuzz"),)),
        ]
        first = True
        for title, make_table, arguments in sections:
            if any(arguments):
                # A table first: the command's output begins with one.
                if not first:
                    yield f"\n{title}\n"
                first = False
                yield from make_table(*arguments)
        yield from list_not_measured(rows)


def _select(rows: Mapping[str, Row], kind: str) -> list[Row]:
    """The rows of cells whose names begin so, as far as they were measured."""
    return [row for name, row in rows.items() if name.startswith(kind) and "not_measured" not in row]


def _measure_trip(case: RunCase, name: str, degree: int) -> Row:
    return measure_round_trip(name, RoundTripCase(case.store, case.make()), degree)


def _measure_tools(case: RunCase) -> Row:
    """The last scene of a run in tools of others."""
    return measure_interop(open_stored_scenes(case.store, case.make()).load(0))


def _measure_viewer(case: RunCase) -> Row:
    """The offline viewer of a run, between the start and the end of its time line."""
    _require("viser", "viewer")
    from flows.cli.view import PAGE_SPLATS
    from flows.viewer.offline_page import write_offline_page
    from flows.viewer.viewed_chunks import ViewedRun

    viewed_run = ViewedRun(case.store, case.make(), PAGE_SPLATS)
    viewed = viewed_run.load(*viewed_run.select(None, None))
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "scene.html"
        write_offline_page(page, viewed, None, case.log)
        return measure_page(page, seek_start, seek_end)


def _measure_report(case: RunCase) -> Row:
    """The report of a run, between two places of its first slider."""
    from flows.reconstruction.run_records import find_run_record

    record = find_run_record(case.store, case.make())
    return measure_page(Path(record["report"]), partial(_move_divider, percent=20), partial(_move_divider, percent=80))


def _move_divider(page: Any, percent: int) -> None:
    slider = page.get_by_role("slider").first
    slider.scroll_into_view_if_needed()
    slider.fill(str(percent))


def _measure_alpasim(case: RunCase, steps: int) -> Row:
    _require("grpc", "simulators")
    from benchmarks.exchange.service import measure_service

    return measure_service(case.store, case.make(), steps)


def _measure_neuroncap(case: RunCase) -> Row:
    _require("uvicorn", "simulators")
    from benchmarks.exchange.http_service import measure_http_service

    return measure_http_service(case.store, case.make())


def _measure_driving(case: RunCase) -> Row:
    _require("gymnasium", "simulators")
    from benchmarks.exchange.http_service import measure_driving

    return measure_driving(case.store, case.make())


def _measure_fuzz(case: RunCase, protocol: str, requests: int) -> Row:
    """Malformed requests to a service of one run."""
    _require("grpc" if protocol == "alpasim" else "uvicorn", "simulators")
    from benchmarks.exchange.service_fuzz import measure_service_fuzz
    from flows.simulators.protocols import load_protocol
    from flows.simulators.scene_renderer import SceneRenderer
    from flows.simulators.service import ServiceRequest
    from flows.simulators.service_metrics import SilentMetrics

    renderer = SceneRenderer(case.store, case.make())
    request = ServiceRequest({renderer.name: renderer}, "127.0.0.1", 0, SilentMetrics())
    service = load_protocol(protocol)(request)
    try:
        if protocol == "alpasim":
            from benchmarks.exchange.alpasim_client import AlpasimClient

            return measure_service_fuzz(AlpasimClient(service.address), requests)
        from benchmarks.exchange.neuroncap_client import NeuroncapClient

        return measure_service_fuzz(NeuroncapClient(service.address, renderer), requests)
    finally:
        service.close()


def _require(module: str, extra: str) -> None:
    """Raises where an optional package is missing."""
    import importlib.util

    if importlib.util.find_spec(module) is None:
        raise NotMeasuredError(f"{module} is missing: pip install 'genre[{extra}]'")


BENCH: Bench = ExchangeBench()
