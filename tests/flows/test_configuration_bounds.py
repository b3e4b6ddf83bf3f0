"""Whatever the configuration accepts is finite, bounded and the same after a way through JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import BaseModel, ValidationError

from flows.configuration import PRESETS, load_configuration
from flows.configuration.keys import list_kinds, section_type, takes_list, takes_text
from genre_tasks.config import PipelineConfig, RangeConfig


def list_fields(model: type[BaseModel], prefix: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """(keys, field) of every value of a configuration."""
    for name, field in model.model_fields.items():
        section, _ = section_type(field.annotation)
        if section is None:
            yield (*prefix, name), field
        else:
            yield from list_fields(section, (*prefix, name))


FIELDS = dict(list_fields(PipelineConfig))
# Of numbers that may be below 0: a vehicle's origin may be at its front.
LEAST = {("simulate", "center_ahead_m"): -10}
RATES = dict.fromkeys(("means", "log_scales", "quats", "logit_opacities", "colors"), 0.1)
NUMBERS = (
    st.integers(-10, 10**6) | st.floats(allow_nan=True, allow_infinity=True) | st.sampled_from([1e308, 10**400, -0.0])
)
VALUES = NUMBERS | st.booleans() | st.none() | st.text(max_size=5) | st.lists(NUMBERS | st.text(max_size=3), max_size=4)


def nested(path: tuple[str, ...], value: object) -> dict[str, Any]:
    change: Any = value
    for key in reversed(path):
        # A section that needs all of its keys gets them, so that only this one may be wrong.
        change = {**RATES, key: change} if key in RATES else {key: change}
    return dict(change)


def list_numbers(value: object) -> Iterator[float]:
    if isinstance(value, Mapping):
        value = list(value.values())
    if isinstance(value, list | tuple):
        for item in value:
            yield from list_numbers(item)
    elif isinstance(value, int | float):
        yield value


def assert_survives_json(config: BaseModel) -> None:
    text = json.dumps(config.model_dump(mode="json"), allow_nan=False)
    text.encode()
    assert type(config).model_validate(json.loads(text)) == config
    assert type(config).model_validate_json(config.model_dump_json()) == config
    assert all(math.isfinite(number) for number in list_numbers(config.model_dump()))


@settings(max_examples=400, deadline=None)
@given(st.sampled_from(sorted(FIELDS)), VALUES)
def test_what_is_accepted_is_finite_and_survives_json(path: tuple[str, ...], value: object) -> None:
    """Report: pydantic/pydantic#7007 (infinity becomes null in JSON)."""
    try:
        config = PipelineConfig.model_validate(nested(path, value))
    except ValidationError:
        return
    assert_survives_json(config)


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_survive_json(preset: str) -> None:
    assert_survives_json(load_configuration(preset))


@pytest.mark.parametrize("path", sorted(FIELDS), ids=".".join)
def test_every_number_is_bounded_and_strict(path: tuple[str, ...]) -> None:
    """Report: pydantic/pydantic#7007; case 16 of the list of odd logs."""
    field = FIELDS[path]
    kinds = [kind for kind in list_kinds(field.annotation) if kind is not type(None)]
    wrong: list[object] = [math.inf, -math.inf, math.nan, 1e308, -1e308, 10**400]
    if kinds == [bool]:
        wrong += [1, 0, "true", "yes"]
    elif takes_list(field.annotation):
        wrong = [[value] for value in wrong] + ["3", 3, [True], [[1]], {"a": 1}]
    elif takes_text(field.annotation):
        wrong += ["", "a\nb", "a\x00", "\udce9", 3, ["a"]]
    else:
        wrong += [True, False, "3", [3], LEAST[path] - 1 if path in LEAST else -1]
    for value in wrong:
        with pytest.raises(ValidationError):
            PipelineConfig.model_validate(nested(path, value))


@pytest.mark.parametrize(
    "values",
    [
        {"ingest": {"cameras": []}},
        {"ingest": {"cameras": ["a", "a"]}},
        {"ingest": {"source_every": 4, "chunk_frames": 4}},
        {"novel_views": {"shifts_m": []}},
        {"novel_views": {"shifts_m": [3, 3.0]}},
        {"novel_views": {"shifts_m": [101]}},
        {"evaluate": {"shifts_m": [1, 1.0000001]}},
        {"evaluate": {"shifts_m": [-3]}},
        {"evaluate": {"shifts_m": [0]}},
        {"gnet": {"loss": {"rgb": 0, "ssim": 0, "perceptual": 0, "depth": 0}}},
        {"gnet": {"per_scene": {"rgb": 0, "ssim": 0}}},
        {"initial": {"opacity": 0.9999999999}},
        {"enet": {"learning_rates": {**RATES, "means": 101}}},
    ],
)
def test_lists_and_rules_on_several_keys(values: dict[str, Any]) -> None:
    """Report: none found; case 16 of the list of odd logs."""
    with pytest.raises(ValidationError):
        PipelineConfig.model_validate(values)


def test_the_range_is_bounded_too() -> None:
    for values in ({"shifts_m": []}, {"max_drop_db": math.inf}, {"every": 0}, {"max_thin": 1.5}):
        with pytest.raises(ValidationError):
            RangeConfig.model_validate(values)
    assert_survives_json(RangeConfig())


def test_a_path_may_begin_at_home(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/someone")
    config = load_configuration("small", settings=["ingest.points=~/a.ply", "evaluate.lpips=~/vgg16.pt"])
    assert (config.ingest.points, config.evaluate.lpips) == ("/home/someone/a.ply", "/home/someone/vgg16.pt")
