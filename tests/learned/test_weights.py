"""Weights on disk: round trip, and clear errors for what does not fit."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from genre_tasks.errors import ConfigError, InputError
from genre_tasks.learned.learned_optimiser import LearnedOptimiser
from genre_tasks.learned.network import NetworkConfig
from genre_tasks.learned.weights import load_optimiser, save_optimiser
from genre_tasks.optimiser.tuned_adam import GNET_LEARNING_RATES

CONFIG = NetworkConfig(hidden=16, channels=(8, 12))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    torch.manual_seed(0)
    save_optimiser(LearnedOptimiser(CONFIG), tmp_path / "w.safetensors")
    return tmp_path / "w.safetensors"


def test_round_trip(path: Path) -> None:
    torch.manual_seed(0)
    made, loaded = LearnedOptimiser(CONFIG), load_optimiser(path)
    assert loaded.config == CONFIG and not loaded.training
    for (name, a), (other, b) in zip(made.named_parameters(), loaded.named_parameters(), strict=True):
        assert name == other and torch.equal(a, b) and not b.requires_grad
    assert sorted(p.name for p in path.parent.iterdir()) == ["w.json", "w.safetensors"]


def test_loading_leaves_the_global_random_state_alone(path: Path) -> None:
    torch.manual_seed(3)
    expected = torch.rand(3)
    torch.manual_seed(3)
    load_optimiser(path).with_learning_rates(GNET_LEARNING_RATES)
    assert torch.equal(torch.rand(3), expected)


def _changed(path: Path, change: str) -> None:
    tensors = load_file(path)
    if change == "dtype":
        tensors["mix.weight"] = tensors["mix.weight"].half()
    elif change == "shape":
        tensors["mix.weight"] = tensors["mix.weight"][:1].contiguous()
    elif change == "missing":
        del tensors["mix.weight"]
    else:
        tensors["mux.weight"] = torch.zeros(1)
    save_file(tensors, path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("dtype", r"mix.weight is float16 \[16, 24\] where float32 \[16, 24\] is expected"),
        ("shape", r"mix.weight is float32 \[1, 24\]"),
        ("missing", "missing mix.weight"),
        ("extra", "unknown mux.weight"),
    ],
)
def test_tensors_that_do_not_fit_are_named(path: Path, change: str, message: str) -> None:
    _changed(path, change)
    with pytest.raises(InputError, match=message) as raised:
        load_optimiser(path)
    assert raised.value.file == str(path)


def test_weights_of_another_configuration_are_refused(path: Path) -> None:
    described = path.with_suffix(".json")
    described.write_text(json.dumps({**json.loads(described.read_text()), "hidden": 32}))
    with pytest.raises(InputError, match="do not fit"):
        load_optimiser(path)


@pytest.mark.parametrize("text", ["", "{", '{"hiden": 3}', '{"hidden": -1}', '{"rates": [0.1]}'])
def test_a_broken_configuration_is_a_config_error(path: Path, text: str) -> None:
    path.with_suffix(".json").write_text(text)
    with pytest.raises(ConfigError):
        load_optimiser(path)


def test_missing_and_truncated_files(path: Path) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match="cannot be read"):
        load_optimiser(path)
    path.unlink()
    with pytest.raises(InputError, match="missing"):
        load_optimiser(path)
