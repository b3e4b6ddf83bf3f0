"""The library of the kernel from offsets to splats: where it is missing or fails, and its constants."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from genre_tasks.errors import ResourceError
from genre_tasks.optimiser.kernels import posing as module
from genre_tasks.optimiser.kernels.build_posing import KERNEL
from genre_tasks.optimiser.kernels.posing import load_posing
from genre_tasks.optimiser.state import Parameterization
from genre_tasks.scene import constants
from tests.optimiser import street_scenes


def test_a_failing_kernel_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    parameterization = Parameterization.from_scene(street_scenes.scene(50))
    monkeypatch.setattr(module, "load_posing", lambda: SimpleNamespace(genre_pose=lambda *arguments: 2))
    with pytest.raises(ResourceError, match="posing of Gaussians on the CPU failed"):
        parameterization.posing.pose(torch.zeros(50, 14), (0, 1), 1)


def test_constants_live_in_one_place() -> None:
    text = (KERNEL.folder / "posing.cpp").read_text()
    assert {n for n in vars(constants) if n.isupper()} == set(KERNEL.constants)
    assert all(re.search(rf"\b{name}\b", text) for name in KERNEL.constants)


def test_a_missing_library_says_what_to_run(tmp_path: Path) -> None:
    with pytest.raises(ResourceError, match=r"posing of Gaussians on the CPU is not compiled.*pip install -e \."):
        load_posing(tmp_path)
