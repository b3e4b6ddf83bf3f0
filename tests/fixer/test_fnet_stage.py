"""The stage and its weights: contract, batches, threads, faults."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from flows.configuration import load_configuration
from genre_tasks.config import FnetConfig
from genre_tasks.errors import InputError
from genre_tasks.fixer.architectures import add_lora, load_sd_turbo
from genre_tasks.fixer.network import Fnet
from genre_tasks.fixer.source_images import load_source_images
from genre_tasks.fixer.weight_files import check_fixer_files
from genre_tasks.fixer.weights import load_fnet, save_fnet
from genre_tasks.stages.fnet import estimate_need, fnet
from genre_tasks.weights import resolve_weights
from tests.fixer.conftest import save_toy_sd_turbo, toy


@pytest.fixture
def weights(tmp_path) -> Path:
    path = tmp_path / "fnet.safetensors"
    save_fnet(toy(), path)
    return path


def test_every_view_comes_back_fixed(scene, weights):
    chunk, novel = scene
    calls = []
    out = fnet(FnetConfig(weights=str(weights)), chunk, novel, progress=lambda *call: calls.append(call))
    assert out.views is novel.views
    assert out.color.shape == novel.color.shape and out.color.dtype == torch.float32
    assert out.color.min() >= 0 and out.color.max() <= 1
    assert not torch.allclose(out.color, novel.color, atol=1e-2)
    assert calls[-1] == (5, 5, "fixing views")


def test_batch_size_and_threads_do_not_change_the_images(scene, weights):
    chunk, novel = scene
    config = FnetConfig(weights=str(weights))
    whole = fnet(config, chunk, novel).color
    one = fnet(config.model_copy(update={"batch_views": 1}), chunk, novel).color
    torch.testing.assert_close(whole, one, rtol=0, atol=1e-5)
    threads = torch.get_num_threads()
    try:
        results = []
        for count in (1, 2, 4):
            torch.set_num_threads(count)
            results.append(fnet(config.model_copy(update={"batch_views": 2}), chunk, novel).color)
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(results[0], results[1]) and torch.equal(results[0], results[2])


def test_the_seed_is_the_configurations(scene, weights):
    chunk, novel = scene
    first, again, other = (fnet(FnetConfig(weights=str(weights), seed=s), chunk, novel).color for s in (0, 0, 1))
    assert torch.equal(first, again) and not torch.equal(first, other)


def test_references_are_encoded_once_each(scene, weights, monkeypatch):
    chunk, novel = scene
    encoded = []
    plain = Fnet.encode
    monkeypatch.setattr(Fnet, "encode", lambda self, image: encoded.append(len(image)) or plain(self, image))
    fnet(FnetConfig(weights=str(weights), batch_views=5), chunk, novel)
    assert sorted(encoded) == [1, 1, 5, 5]  # two references; render and LiDAR of the batch


def test_no_views_are_no_work(scene, weights):
    chunk, novel = scene
    none = replace(novel, views=(), color=novel.color[:0], alpha=novel.alpha[:0])
    assert fnet(FnetConfig(weights=str(weights)), chunk, none).color.shape == (0, 36, 52, 3)


def test_a_reference_outside_the_chunk_is_named(scene, weights):
    chunk, novel = scene
    stray = replace(novel, views=(*novel.views[:4], replace(novel.views[4], reference=("left_camera", 3))))
    with pytest.raises(InputError, match="camera left_camera, frame 3"):
        fnet(FnetConfig(weights=str(weights)), chunk, stray)


def test_saved_weights_come_back_to_half_precision(weights):
    state, original = load_fnet(weights).state_dict(), toy().state_dict()
    assert state.keys() == original.keys()
    for key, value in original.items():
        assert torch.equal(state[key], value.half().float())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.pop("skips.0.bias"), "missing skips.0.bias"),
        (lambda t: t.update(stray=torch.zeros(1)), "unknown stray"),
        (
            lambda t: t.update({"skips.0.bias": torch.zeros(3)}),
            r"skips.0.bias is float32 \[3\] where .* \[8\] is expected",
        ),
        (
            lambda t: t.update({"skips.0.bias": torch.zeros(8, dtype=torch.int8)}),
            r"skips.0.bias is int8 \[8\] where float16 or bfloat16 or float32",
        ),
        (lambda t: t.update({"skips.0.bias": torch.full((8,), float("nan"))}), "skips.0.bias holds non-finite"),
    ],
)
def test_weights_that_do_not_fit_are_named(weights, change, message):
    tensors = load_file(weights)
    change(tensors)
    save_file(tensors, weights)
    with pytest.raises(InputError, match=message) as caught:
        load_fnet(weights)
    assert caught.value.file == str(weights)


def test_a_damaged_configuration_is_named(weights):
    document = weights.with_suffix(".json")
    document.write_text(json.dumps({"model": "small", "architecture": {"stray": 1}}))
    with pytest.raises(InputError, match=r"does not describe a fixer.*stray"):
        load_fnet(weights)
    document.write_text("{")
    with pytest.raises(InputError, match="cannot be read"):
        load_fnet(weights)


def test_truncated_weights_are_named(weights):
    weights.write_bytes(weights.read_bytes()[:-100])
    with pytest.raises(InputError, match="the weights cannot be read"):
        load_fnet(weights)


def test_configuration_and_weights_must_agree(scene, weights):
    with pytest.raises(InputError, match="trained at timestep 200, configured is 150"):
        fnet(FnetConfig(weights=str(weights), timestep=150), *scene)
    with pytest.raises(InputError, match="'small', the configuration says 'sd-turbo'"):
        fnet(FnetConfig(weights=str(weights), model="sd-turbo"), *scene)
    with pytest.raises(InputError, match="no weights of sd-turbo ship"):
        fnet(FnetConfig(model="sd-turbo"), *scene)


def test_absent_weights_have_a_remedy(tmp_path):
    with pytest.raises(InputError, match="genre train nosuch"):
        resolve_weights("nosuch", "builtin")
    with pytest.raises(InputError, match="the weights of fnet do not exist"):
        resolve_weights("fnet", str(tmp_path / "none.safetensors"))
    with pytest.raises(InputError, match=r"Check `gnet.refine.weights`"):
        resolve_weights("gnet", str(tmp_path / "none.safetensors"), "gnet.refine.weights")
    assert resolve_weights("fnet", str(tmp_path)) == tmp_path


@pytest.fixture
def base(tmp_path) -> Path:
    return save_toy_sd_turbo(tmp_path / "base")


def test_sd_turbo_loads_trains_a_step_saves_and_reloads(base, scene, tmp_path):
    network = load_sd_turbo(str(base), rank=2)
    generator = torch.Generator().manual_seed(0)
    for parameter in (p for p in network.parameters() if p.requires_grad):
        parameter.data = (0.1 * torch.randn(parameter.shape, generator=generator)).half().float()
    save_fnet(network, tmp_path / "fnet.safetensors", base="base", rank=2)
    stored = load_file(tmp_path / "fnet.safetensors")
    assert all("lora" in k or k.startswith("skips") for k in stored)
    again = load_fnet(tmp_path, "sd-turbo")
    assert all(torch.equal(v, again.state_dict()[k]) for k, v in network.state_dict().items())
    chunk, novel = scene
    out = fnet(FnetConfig(model="sd-turbo", weights=str(tmp_path)), chunk, novel).color
    assert torch.isfinite(out).all() and out.min() >= 0 and out.max() <= 1


def test_a_base_that_is_not_there_is_named(tmp_path):
    with pytest.raises(InputError, match=r"SD-Turbo cannot be loaded.*by --start in training, by `base` in fnet.json"):
        load_sd_turbo(str(tmp_path / "nowhere"))


@pytest.mark.parametrize("configured", ["builtin", "builtin:fnet", "stabilityai/sd-turbo", "base", "~/base"])
def test_sd_turbo_without_adapters_has_one_remedy(base, monkeypatch, configured):
    monkeypatch.chdir(base.parent)
    monkeypatch.setenv("HOME", str(base.parent))
    remedy = r"Train adapters first: `genre train fnet --preset paper --start FOLDER`\."
    with pytest.raises(InputError, match=remedy):
        check_fixer_files(FnetConfig(model="sd-turbo", weights=configured))
    with pytest.raises(InputError, match=remedy):
        check_fixer_files(load_configuration("paper").fnet)


def test_the_configuration_is_written_before_the_weights_and_outlives_a_loss_of_power(tmp_path, monkeypatch):
    written = []
    monkeypatch.setattr("genre_tasks.fixer.weights.write_atomically", lambda path, data: written.append(path.name))
    save_fnet(toy(), tmp_path / "fnet.safetensors")
    assert written == ["fnet.json", "fnet.safetensors"]


def test_adapters_can_be_put_on_the_small_network_too():
    network = toy()
    add_lora(network, 2)
    assert sum(p.requires_grad for p in network.parameters()) > 8


def test_views_that_do_not_call_for_it_are_copied(scene, weights):
    chunk, novel = scene
    alpha = novel.alpha.clone()
    alpha[:] = 1
    alpha[1] = 0.4  # what is thin calls for fixing
    novel = replace(novel, alpha=alpha, color=novel.color.clamp(0, 1))
    sources = load_source_images(chunk)
    needs = [estimate_need(chunk, novel, i, sources) for i in range(5)]
    assert needs[1] > max(n for i, n in enumerate(needs) if i != 1)
    gate = 0.5 * (needs[1] + max(n for i, n in enumerate(needs) if i != 1))
    every = fnet(FnetConfig(weights=str(weights)), chunk, novel)
    gated = fnet(FnetConfig(weights=str(weights), gate=gate), chunk, novel)
    assert every.copied == () and every.seconds_saved == 0
    assert gated.copied == (0, 2, 3, 4) and gated.seconds_saved > 0
    torch.testing.assert_close(gated.color[1], every.color[1], rtol=0, atol=1e-5)  # alone, and in a batch of four
    assert all(torch.equal(gated.color[i], novel.color[i]) for i in gated.copied)


def test_a_gate_that_nothing_passes_costs_no_network(scene, weights, monkeypatch):
    chunk, novel = scene
    monkeypatch.setattr(Fnet, "forward", lambda *_: pytest.fail("the network was called"))
    out = fnet(FnetConfig(weights=str(weights), gate=1.0), chunk, novel)
    assert out.copied == (0, 1, 2, 3, 4) and torch.equal(out.color, novel.color.clamp(0, 1))


def test_half_precision_can_be_chosen(scene, weights):
    chunk, novel = scene
    whole, half = (fnet(FnetConfig(weights=str(weights), half=h), chunk, novel).color for h in (False, True))
    assert not torch.equal(whole, half)
    assert (whole - half).abs().mean() < 0.02  # random weights on noise; the shipped ones are held to a grey level
