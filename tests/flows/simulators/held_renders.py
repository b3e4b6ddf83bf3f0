"""Renders that wait until a test lets them go on, so that other requests are behind them in the queue."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from typing import Any

import pytest

from flows.simulators.scene_renderer import SceneRenderer


@dataclass(frozen=True)
class HeldRenders:
    """What a test sees of the renders, and how it lets them go on.

    Attributes:
        release: lets all renders go on.
        rendered: how many images each render that has begun has.
    """

    release: threading.Event = field(default_factory=threading.Event)
    rendered: list[int] = field(default_factory=list)


def hold_renders(renderer: SceneRenderer, monkeypatch: pytest.MonkeyPatch) -> HeldRenders:
    """Holds all renders of a renderer back."""
    held = HeldRenders()
    render = renderer._render

    def wait_and_render(requests: Any) -> Any:
        held.rendered.append(len(requests))
        held.release.wait(60)
        return render(requests)

    monkeypatch.setattr(renderer, "_render", wait_and_render)
    return held
