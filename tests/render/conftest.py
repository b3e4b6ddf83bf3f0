"""The scenes and the backward pass that all gradient tests use, as fixtures."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from torch import Tensor

from genre_tasks.render import Render
from tests.scenes import Scene, cloud
from tests.scenes import gradients as backward


@pytest.fixture(scope="session")
def scene() -> Callable[..., Scene]:
    return cloud


@pytest.fixture(scope="session")
def gradients() -> Callable[..., tuple[Render, dict[str, Tensor]]]:
    return backward
