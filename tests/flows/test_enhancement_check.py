"""A scene from a file that ENet made worse is warned of, with numbers."""

from __future__ import annotations

import inspect

import pytest

from flows.configuration import load_configuration
from flows.reconstruction.enhancement_check import find_harm
from flows.reconstruction.run_summary import StageSummary


def summarise(stage: str, psnr: float | None) -> StageSummary:
    required = {
        name: 0
        for name, parameter in inspect.signature(StageSummary).parameters.items()
        if parameter.default is inspect.Parameter.empty
    }
    metrics = {} if psnr is None else {"interpolation/psnr": psnr}
    return StageSummary(**(required | {"stage": stage, "metrics": metrics}))


@pytest.mark.parametrize(("before", "after", "warned"), [(41.4, 20.3, True), (27.0, 26.8, False), (27.0, 28.0, False)])
def test_a_loss_is_warned_of(before: float, after: float, warned: bool) -> None:
    config = load_configuration("demo", settings=["initial.scene=scene.ply"]).model_dump(mode="json")
    stages = [summarise("gnet", before), summarise("fnet", None), summarise("enet", after)]
    warning = find_harm(config, stages)
    assert (warning is not None) == warned
    if warning is not None:
        assert "from 41.4 to 20.3 dB" in warning and "enet.iterations (now " in warning


def test_only_scenes_of_a_file_are_compared() -> None:
    stages = [summarise("gnet", 41.4), summarise("enet", 20.3)]
    plain = load_configuration("demo").model_dump(mode="json")
    assert find_harm(plain, stages) is None
    given = load_configuration("demo", settings=["initial.scene=scene.ply"]).model_dump(mode="json")
    assert find_harm(given, stages[:1]) is None
    assert find_harm(given, [summarise("gnet", 41.4), summarise("enet", None)]) is None
