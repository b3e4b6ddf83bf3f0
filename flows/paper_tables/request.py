"""What a user asks for, checked before anything is computed."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, replace
from pathlib import Path

from flows.configuration import load_configuration
from flows.paper_tables.layouts import Layout, layout_of
from flows.paper_tables.measure import Basis, Place, places_of
from flows.paper_tables.methods import SLOTS, read_method, read_weights
from flows.pipeline.log_cache import opened_log
from genre_tasks.config import PipelineConfig
from genre_tasks.errors import ConfigError


@dataclass(frozen=True)
class Request:
    """What a user asks for: a table's ``number``, logs, and what is set; files are checked by :meth:`planned`."""

    number: int
    logs: tuple[str, ...]
    preset: str = "small"
    store: str = "genre-store"
    chunks: tuple[int, ...] | None = None
    settings: tuple[str, ...] = ()
    methods: tuple[str, ...] = ()
    weights: tuple[str, ...] = ()
    out: str = "tables"
    into: str | None = None
    remarks: tuple[str, ...] = ()
    stored: bool = False

    def planned(self) -> Planned:
        """Layout, places, and why a method cannot be measured.

        Raises ``ConfigError`` or ``InputError`` for what is wrong in the request, before anything is computed.
        """
        basis = Basis(self.preset, self.settings, self.store)
        own = [read_method(Path(f), self.preset, self.settings) for f in self.methods]
        layout, given = layout_of(self.number, own), read_weights(self.weights)
        config = load_configuration(self.preset, settings=(*layout.protocol, *self.settings))
        places = places_of(self.logs, None if self.chunks is None else list(self.chunks), config)
        datasets = sorted({opened_log(p.log).dataset for p in places})
        if len(datasets) > 1:
            raise ConfigError(
                f"the logs are of several datasets ({', '.join(datasets)}), over which no mean says anything",
                remedy="Measure them one after the other; --into keeps a section for each.",
            )
        missing = {
            row.label: f"no weights; give {SLOTS[row.method.slot].about} by --weights {row.method.slot}=PATH."
            for row in layout.rows
            if row.method.needs_weights and row.method.slot not in given
        }
        rows = tuple(replace(row, method=row.method.given(given)) for row in layout.rows)
        return Planned(basis, replace(layout, rows=rows), tuple(places), missing, "".join(datasets))

    @property
    def command(self) -> str:
        """That makes this table again, wholly also where this one is of what the store has."""
        parts = ["genre", "table", str(self.number), *self.logs, "--preset", self.preset]
        parts += ["--chunks", ",".join(map(str, self.chunks))] if self.chunks is not None else []
        repeated = {"--set": self.settings, "--method": self.methods, "--weights": self.weights}
        parts += [p for option, values in repeated.items() for value in values for p in (option, value)]
        return shlex.join([*parts, *(["--into", self.into] if self.into else [])])


@dataclass(frozen=True)
class Planned:
    """A checked request. ``missing``: a method's name → why it cannot be measured."""

    basis: Basis
    layout: Layout
    places: tuple[Place, ...]
    missing: dict[str, str]
    dataset: str

    @property
    def config(self) -> PipelineConfig:
        """The preset with protocol and user's settings, without any method's."""
        return load_configuration(self.basis.preset, settings=(*self.layout.protocol, *self.basis.settings))
