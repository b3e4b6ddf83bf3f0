"""Memory that waits for later renders can be given back, and the next render is the same."""

from __future__ import annotations

import subprocess
import sys

import pytest

_MEASURE = """
import numpy as np
import torch
from flows.machine.memory_reuse import trim_memory
from flows.machine.resource_usage import measure_memory_mib
from genre_tasks.logs.types import Lens
from genre_tasks.render import render_views
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.novel_views import NovelView

generator = torch.Generator().manual_seed(0)
packed = torch.randn(300_000, 14, generator=generator)
packed[:, 2] = packed[:, 2].abs() + 5
packed[:, 3:6] = -3
gaussians = Gaussians.unpack(packed)
scene = SceneGraph(gaussians, torch.zeros(len(packed), dtype=torch.int64), ())
lens = Lens(fx_px=600.0, fy_px=600.0, cx_px=640.0, cy_px=360.0, width_px=1280, height_px=720)
view = NovelView("front", 0, 0.0, np.eye(4), lens, ("front", 0))
with torch.no_grad():
    first = render_views(scene, [view] * 4).color
    before = measure_memory_mib()
    trim_memory()
    after = measure_memory_mib()
    again = render_views(scene, [view] * 4).color
print(before - after, bool(torch.equal(first, again)), float(first.max()))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads Linux's account of the process's memory")
def test_pooled_memory_goes_back() -> None:
    # A process of its own: other tests' renders have filled the pools, too.
    out = subprocess.run([sys.executable, "-c", _MEASURE], capture_output=True, text=True, check=True).stdout.split()
    assert float(out[0]) > 20
    assert out[1] == "True" and float(out[2]) > 0
