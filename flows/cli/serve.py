"""``genre serve``: renders images that a simulator asks for over the network."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from typing import TYPE_CHECKING, Annotated

import typer

from flows.cli.options import SceneStageOption, StoreOption
from flows.defaults import DEFAULT_STORE
from flows.simulators.service import MAX_QUEUE

if TYPE_CHECKING:
    from flows.simulators.image_request import RenderLimits
    from flows.simulators.scene_renderer import SceneRenderer
    from flows.simulators.service import RunningService
    from flows.simulators.service_metrics import ServiceMetrics

_MAX_SIDE_PX = 8192
_MAX_PORT = 65535


def serve(
    runs: Annotated[list[str], typer.Argument(metavar="RUN", help="Names of finished runs, or the starts of them.")],
    protocol: Annotated[str, typer.Option(help="How the simulator asks: neuroncap or alpasim.")] = "neuroncap",
    host: Annotated[
        str, typer.Option(help="Address to listen at. By default only this machine reaches it.")
    ] = "127.0.0.1",
    port: Annotated[
        int | None, typer.Option(help="Port to listen at; 0 takes any free one. The protocol's own if not given.")
    ] = None,
    stage: SceneStageOption = None,
    max_width: Annotated[int, typer.Option(help="Widest image that a client may ask for, pixels.")] = 1920,
    max_height: Annotated[int, typer.Option(help="Highest image that a client may ask for, pixels.")] = 1280,
    queue: Annotated[
        int,
        typer.Option(help=f"How many requests may wait, at most {MAX_QUEUE}; further ones are refused as busy."),
    ] = 16,
    metrics_port: Annotated[
        int | None, typer.Option(help="Port with counters for Prometheus. No counters if not given.")
    ] = None,
    store: StoreOption = DEFAULT_STORE,
) -> None:
    """Render images for a simulator that asks over the network.

    The service answers until Ctrl-C or SIGTERM. It has no password: all that reach its address can ask it.

    Example:

    \b
        genre serve 4b1c --protocol neuroncap --port 8000
    """
    from flows.cli.existing_store import open_existing_store
    from flows.cli.parsing import check_number
    from flows.simulators.protocols import find_protocol, load_protocol
    from flows.simulators.service import ServiceRequest, is_loopback

    chosen_port = find_protocol(protocol).port if port is None else port
    check_number(chosen_port, "--port", 0, _MAX_PORT)
    check_number(0 if metrics_port is None else metrics_port, "--metrics-port", 0, _MAX_PORT)
    check_number(max_width, "--max-width", 1, _MAX_SIDE_PX)
    check_number(max_height, "--max-height", 1, _MAX_SIDE_PX)
    check_number(queue, "--queue", 0, MAX_QUEUE)
    open_existing_store(store)
    start_service = load_protocol(protocol)
    from flows.simulators.image_request import RenderLimits

    limits = RenderLimits(max_width_px=max_width, max_height_px=max_height, max_waiting=queue)
    renderers = _open_runs(store, runs, stage, limits)
    with ExitStack() as stack:
        metrics = _start_metrics(stack, host, metrics_port, lambda: sum(r.queue_length for r in renderers.values()))
        service = start_service(ServiceRequest(renderers, host, chosen_port, metrics))
        stack.callback(service.close)
        _announce(service, renderers, protocol, shared=not is_loopback(host))
        _wait(service)


def _wait(service: RunningService) -> None:
    """Waits for a signal, which raises in the main thread."""
    service.wait()


def _open_runs(store: str, runs: list[str], stage: str | None, limits: RenderLimits) -> dict[str, SceneRenderer]:
    from flows.simulators.scene_renderer import SceneRenderer

    renderers = [SceneRenderer(store, run, stage, limits=limits) for run in runs]
    return {renderer.name: renderer for renderer in renderers}


def _start_metrics(stack: ExitStack, host: str, port: int | None, measure_queue: Callable[[], int]) -> ServiceMetrics:
    from flows.simulators.service_metrics import PrometheusMetrics, SilentMetrics

    if port is None:
        return SilentMetrics()
    metrics = PrometheusMetrics(host, port, measure_queue)
    stack.callback(metrics.close)
    typer.echo(f"counters at http://{host}:{metrics.port}/metrics")
    return metrics


def _announce(service: RunningService, renderers: dict[str, SceneRenderer], protocol: str, shared: bool) -> None:
    if shared:
        typer.echo("warning: other machines can reach this address, and there is no password")
    for renderer in renderers.values():
        first_s, last_s = renderer.time_range_s
        counts = f"{len(renderer.cameras)} cameras, {len(renderer.actors())} actors"
        typer.echo(f"scene {renderer.name}: {counts}, {first_s:.3f} to {last_s:.3f} s")
    # The last line: whoever started this reads the address from there.
    typer.echo(f"serving {protocol} at {service.address} until Ctrl-C")
