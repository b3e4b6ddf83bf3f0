"""Modules that are looked up by name: reading imports cannot find them, so a benchmark names them as its code."""

from __future__ import annotations

from flows.pipeline.definition import PIPELINE
from genre_tasks.exchange.registry import list_format_modules
from storage.codecs import KINDS

STAGE_MODULES: tuple[str, ...] = tuple(
    dict.fromkeys(module for spec in PIPELINE for module in (spec.module, *spec.lazy_modules))
)
"""Of every stage, with the effects that a plan may set on: the code of a benchmark that runs stages."""

CODEC_MODULES: tuple[str, ...] = tuple(dict.fromkeys(KINDS.values()))
"""Of every kind of artifact: the code of a benchmark that measures what a store takes."""

FORMAT_MODULES: tuple[str, ...] = list_format_modules()
"""Of every format of scenes of other programs."""
