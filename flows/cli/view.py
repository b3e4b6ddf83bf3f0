"""``genre view``: a finished run's scene in a browser, live or as one file."""

from __future__ import annotations

import ipaddress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flows.cli.options import RunArgument, RunChunkOption, SceneStageOption, StoreOption
from flows.cli.parsing import parse_path
from flows.defaults import DEFAULT_STORE

if TYPE_CHECKING:
    from flows.simulation.stored_ranges import SideRange
    from flows.viewer.viewed_chunks import ViewedChunk, ViewedRun

PAGE_SPLATS = 100_000
"""Gaussians of a page unless the user says otherwise: some megabytes, which an ordinary laptop shows smoothly."""

_DEFAULT_HOST = "127.0.0.1"
_DEFAULT_PORT = 8080
_LEAST_SPLATS = 100
_MOST_SPLATS = 5_000_000


HtmlOption = Annotated[
    Path | None,
    typer.Option(
        parser=parse_path,
        metavar="PATH",
        help="Write one HTML file x.html that plays the scene without a server or the network, over an existing one, "
        "instead of starting a viewer. As scene.html in the run's folder it is linked from the run's report.",
    ),
]
MaxSplatsOption = Annotated[
    int | None,
    typer.Option(
        help="Show no more Gaussians than this: those that fill most of the images along the path. "
        f"{PAGE_SPLATS} with --html if not given, else all."
    ),
]
HostOption = Annotated[
    str,
    typer.Option(
        help="The address that the viewer listens at. Any other than that of this machine lets everyone in the "
        "network look at the scene."
    ),
]
PortOption = Annotated[int, typer.Option(help="The port, or 0 for a free one. A taken one leads to the next.")]
OpenOption = Annotated[bool, typer.Option("--open", help="Open the viewer in this machine's browser.")]
ViewNoRangeOption = Annotated[
    bool, typer.Option("--no-range", help="Do not draw the reliable range. It takes a minute once for each scene.")
]


def view(
    run: RunArgument,
    html: HtmlOption = None,
    stage: SceneStageOption = None,
    chunk: RunChunkOption = None,
    max_splats: MaxSplatsOption = None,
    host: HostOption = _DEFAULT_HOST,
    port: PortOption = _DEFAULT_PORT,
    open_browser: OpenOption = False,
    no_range: ViewNoRangeOption = False,
    store: StoreOption = DEFAULT_STORE,
) -> None:
    """Look at a finished run's scene in a browser.

    The viewer has a slider for the time, and shows any chunk after any stage. Its camera drives along the recorded path
    or beside it. Actors can be switched off. Recorded images stand at their cameras, and the reliable range is drawn on
    the ground. It runs until Ctrl-C. With --html the scene becomes one file that plays by itself.

    Example:

    \b
        genre view 4b1c
        genre view 4b1c --html scene.html
    """
    from flows.cli.existing_store import open_existing_store
    from flows.cli.output_paths import check_output_file
    from flows.cli.parsing import check_number

    # Checked first, because reading a scene takes seconds.
    if html is not None:
        check_output_file(html, "--html", (".html", ".htm"))
        _refuse_viewer_options(host, port, open_browser)
    if max_splats is not None:
        check_number(max_splats, "--max-splats", _LEAST_SPLATS, _MOST_SPLATS)
    check_number(port, "--port", 0, 65535)
    _check_host(host)
    _check_viser()
    open_existing_store(store)
    from flows.cli.terminal import TerminalReporter
    from flows.viewer.viewed_chunks import ViewedRun

    limit = PAGE_SPLATS if html is not None and max_splats is None else max_splats
    viewed_run = ViewedRun(store, run, limit)
    number, chosen = viewed_run.select(chunk, stage)
    with TerminalReporter(f"chunk {number}  reading") as reporter:
        viewed = viewed_run.load(number, chosen, reporter.progress)
    for loss in viewed.scene.losses:
        typer.echo(loss)
    if html is not None:
        _write_page(html, viewed_run, viewed, store, with_range=not no_range)
        return
    from flows.viewer.live_viewer import LiveViewer

    with LiveViewer(viewed_run, viewed, host, port, with_range=not no_range) as viewer:
        typer.echo(f"{viewer.address} shows chunk {number} after {chosen}; Ctrl-C ends it")
        if open_browser:
            typer.launch(viewer.address)
        viewer.run_forever()


def _write_page(path: Path, run: ViewedRun, viewed: ViewedChunk, store: str, with_range: bool) -> None:
    from flows.cli.terminal import TerminalReporter
    from flows.viewer.offline_page import write_offline_page

    sides: SideRange | None = None
    if with_range:
        with TerminalReporter(f"chunk {viewed.number}  reliable range") as reporter:
            sides = run.find_range(viewed.number, viewed.stage, reporter.progress)
    title = f"{run.log}, chunk {viewed.number}, after {viewed.stage}"
    size = write_offline_page(path, viewed, sides, title)
    count = f"{len(viewed.scene):,} Gaussians, {len(viewed.actor_names)} actors"
    seconds = f"{viewed.times_s[-1]:.1f} s of driving"
    typer.echo(f"wrote {path}: {count}, {seconds}, {size / 1e6:.1f} MB")
    _link_from_report(path, run, store)


def _link_from_report(path: Path, run: ViewedRun, store: str) -> None:
    """Writes the run's report again where the page lies beside it."""
    from flows.reconstruction.report.writing import SCENE_FILE
    from flows.reconstruction.rewritten_report import rewrite_report

    if path.resolve() == (run.folder / SCENE_FILE).resolve() and (run.folder / "report.html").is_file():
        typer.echo(f"wrote {rewrite_report(store, run.name)}, which links to it")


def _refuse_viewer_options(host: str, port: int, open_browser: bool) -> None:
    from genre_tasks.errors import ConfigError

    of_the_viewer = {"--host": host != _DEFAULT_HOST, "--port": port != _DEFAULT_PORT, "--open": open_browser}
    if given := [option for option, is_given in of_the_viewer.items() if is_given]:
        raise ConfigError(
            f"a page by --html has no use for {', '.join(given)}",
            remedy="Leave that out, or leave out --html to start the viewer.",
        )


def _check_host(host: str) -> None:
    from genre_tasks.errors import ConfigError

    if host == "localhost":
        return
    try:
        ipaddress.ip_address(host)
    except ValueError as error:
        remedy = "Give one of this machine, such as 127.0.0.1, or 0.0.0.0 for all of them."
        raise ConfigError(f"--host '{host}' is no address", remedy=remedy) from error


def _check_viser() -> None:
    from importlib.util import find_spec

    from genre_tasks.errors import ConfigError

    if find_spec("viser") is None:
        raise ConfigError("the viewer needs the package viser", remedy="Install it: pip install 'genre[viewer]'.")
