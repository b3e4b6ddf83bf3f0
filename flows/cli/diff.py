"""``genre diff A B``: what differs between two runs or two artifacts."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flows.cli.options import StoreOption
from flows.cli.parsing import parse_path
from flows.defaults import DEFAULT_STORE

if TYPE_CHECKING:
    from flows.comparison.comparison import Comparison
    from storage.store import Store


def diff(
    a: Annotated[str, typer.Argument(help="The name of a run or the key of an artifact, or its first characters.")],
    b: Annotated[str, typer.Argument(help="The same of what it is compared with.")],
    store: StoreOption = DEFAULT_STORE,
    other_store: Annotated[str | None, typer.Option(help="The store of B, if it is another one.")] = None,
    chunk: Annotated[int | None, typer.Option(help="The chunk of two runs. All chunks if not given.")] = None,
    html: Annotated[
        Path | None,
        typer.Option(
            parser=parse_path, metavar="PATH", help="Write tables and pictures to this HTML file, over an existing one."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            parser=parse_path,
            metavar="PATH",
            help="A folder for pictures: A, B and their difference side by side, as PNG.",
        ),
    ] = None,
) -> None:
    """Compare two runs or two artifacts.

    For runs it prints the settings that differ, and which stages have the same payload. Metrics stand side by side with
    their differences and intervals. It also says how the Gaussians of the last scenes differ. For artifacts
    of one kind it prints settings, files, statistics of columns, and what the kind has. Runs of different logs share
    settings and mean metrics only.

    Where the number of Gaussians of a node is the same in both, they are compared in their order.

    Example:

    \b
        genre diff 4b1c 77e0 --html diff.html
        genre diff 9f02ab 31c4de --out differences
    """
    from flows.cli.existing_store import open_existing_store
    from flows.cli.output_paths import check_output_file, check_output_folder
    from flows.cli.printing import make_console, print_rows

    if html is not None:
        check_output_file(html, "--html", (".html",))
    if out is not None:
        check_output_folder(out, "--out")
    first = open_existing_store(store)
    comparison = _compare((first, first if other_store is None else open_existing_store(other_store)), (a, b), chunk)
    console = make_console()
    console.print(f"A: {comparison.a}\nB: {comparison.b}")
    for note in comparison.notes:
        console.print(note)
    for table in comparison.tables:
        print_rows(table.name, table.rows)
    _write_files(comparison, html, out)


def _compare(stores: tuple[Store, Store], names: tuple[str, str], chunk: int | None) -> Comparison:
    from flows.comparison.artifact_comparison import compare_artifacts
    from flows.comparison.run_comparison import compare_runs, open_side
    from flows.reconstruction.named_results import NamedRun, find_named
    from genre_tasks.errors import InputError

    a, b = (find_named(store, name) for store, name in zip(stores, names, strict=True))
    if isinstance(a, NamedRun) and isinstance(b, NamedRun):
        return compare_runs(open_side(stores[0], a.record), open_side(stores[1], b.record), chunk)
    if isinstance(a, NamedRun) or isinstance(b, NamedRun):
        raise InputError(
            f"{names[0]} and {names[1]} are a run and an artifact", remedy="Compare two runs, or two artifacts."
        )
    if chunk is not None:
        raise InputError("an artifact is of one chunk", remedy="Leave out --chunk.")
    return compare_artifacts(stores, a, b)


def _write_files(comparison: Comparison, html: Path | None, out: Path | None) -> None:
    written = []
    if out is not None or html is not None:
        from flows.cli.printing import format_value
        from flows.comparison.output_files import write_page, write_strips

        if out is not None:
            written += write_strips(out, comparison)
        if html is not None:
            written.append(str(write_page(html, comparison, format_value)))
    if out is not None and not comparison.pairs:
        typer.echo("There are no pictures of the same viewpoints to compare.")
    if written:
        typer.echo(f"wrote {', '.join(written)}")
