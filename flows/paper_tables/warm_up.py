"""Imports, weights and first calls, taken before anything is timed."""

from __future__ import annotations

import tempfile

from flows.paper_tables.layouts import Layout
from flows.paper_tables.measure import Basis, Place, measure
from flows.paper_tables.methods import Method
from flows.pipeline.stage_runner import produce

TINY = "synthetic:street?seed=900&frames=8&cameras=1"


def warm_up(basis: Basis, layout: Layout) -> None:
    """Runs the preset to its end on a tiny log, in a store of its own.

    Settings of ``ingest`` are left out: cameras and points are of the user's log.
    """
    settings = tuple(s for s in basis.settings if not s.startswith("ingest"))
    with tempfile.TemporaryDirectory() as store:
        measure(Basis(basis.preset, settings, store), layout, Method("the preset", ()), Place(TINY, 0), produce)
