"""Writes the report of a run: one HTML file with its pictures in it, readable without torch and without Prefect."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path

from flows.defaults import DEFAULT_STORE
from flows.reconstruction.report.chunk_section import STAGE_LABELS, ChunkPage, build_chunk_page
from flows.reconstruction.report.error_maps import MAX_ERROR
from flows.reconstruction.report.metric_table import SCORED_STAGES
from flows.reconstruction.run_summary import RunSummary
from genre_tasks.atomic_path import atomic_path

SCENE_FILE = "scene.html"
"""The scene for a browser; the report links to it where it lies in the same folder."""


def write_report(path: Path, run: RunSummary) -> Path:
    """Writes the report of a run as one HTML file that appears whole or not at all.

    Args:
        path: the file to write; its folder is made if it does not exist.
        run: what the report shows.

    Returns:
        ``path``.

    Raises:
        OSError: the file cannot be written.

    Example::

        write_report(Path("report.html"), summarise_run(run))
    """
    pages = [build_chunk_page(chunk) for chunk in run.chunks]
    html = render_page(
        "report.html.jinja",
        run=run,
        chunks=pages,
        columns=[STAGE_LABELS[stage] for stage in SCORED_STAGES],
        scene_file=SCENE_FILE if (path.parent / SCENE_FILE).is_file() else "",
        overview=build_overview(pages),
        environment=describe_environment(run.environment),
        store_option=describe_store_option(run.store),
        scale=_error_scale(pages),
        max_error=f"{MAX_ERROR:g}",
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as part:
        part.write_text(html, encoding="utf-8")
    return path


def render_page(template: str, **values: object) -> str:
    """Fills a template of this folder; everything is in the one page, so that it can be mailed.

    Args:
        template: the file's name.
        values: what it shows.

    Returns:
        The page.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        # The templates are in this folder, also in an installed package.
        loader=FileSystemLoader(Path(__file__).parent),
        # Names of logs and messages may hold any character.
        autoescape=True,
        # A field that was renamed here and not in the template fails, instead of showing nothing.
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(**values)


def describe_store_option(store: str) -> str:
    """Writes the option by which the report's commands find a store.

    Args:
        store: folder (or URI) of the store.

    Returns:
        The option after a space, quoted for a shell; empty for the store that commands take without it.

    >>> describe_store_option("genre-store"), describe_store_option("my store")
    ('', " --store 'my store'")
    """
    return "" if store == DEFAULT_STORE else f" --store {shlex.quote(store)}"


def build_overview(pages: Sequence[ChunkPage]) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Arranges the headline numbers of all chunks in one table.

    Args:
        pages: of the chunks.

    Returns:
        The headings, and for each chunk its number and a value for each heading; empty where it was not measured.
    """
    headings = list(dict.fromkeys(label for page in pages for label, _, _ in page.headline))
    rows = []
    for page in pages:
        values = {label: value for label, value, _ in page.headline}
        rows.append((page.number, [values.get(heading, "") for heading in headings]))
    return headings, rows


def describe_environment(environment: Mapping[str, str]) -> str:
    """Writes versions and machine on one line.

    Args:
        environment: as manifests have it.

    Returns:
        Versions and machine, separated by commas; empty where nothing is known.

    >>> describe_environment({"genre": "0.2.0", "platform": "Linux", "threads": "2"})
    'genre 0.2.0, Linux, threads 2'
    """
    # A platform says what it is by itself.
    return ", ".join(value if name == "platform" else f"{name} {value}" for name, value in environment.items())


def _error_scale(pages: list[ChunkPage]) -> str:
    """The colours of the maps as stops of a gradient; empty where no picture has a truth."""
    if not any(page.has_errors for page in pages):
        return ""
    from flows.reconstruction.report.error_maps import describe_scale

    return describe_scale()
