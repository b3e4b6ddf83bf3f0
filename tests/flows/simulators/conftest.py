"""One tiny run of two chunks for all tests of simulators, and a renderer of it."""

from __future__ import annotations

import pytest

from flows.simulators.scene_renderer import SceneRenderer
from tests.flows.small_simulation import make_run


@pytest.fixture(scope="session")
def served(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    """A store and the name of a run in it."""
    store = tmp_path_factory.mktemp("served")
    return str(store), make_run(store)


@pytest.fixture(scope="session")
def renderer(served: tuple[str, str]) -> SceneRenderer:
    """A renderer of the run; no test may use its queue up."""
    return SceneRenderer(*served)
