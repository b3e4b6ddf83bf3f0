"""Training: it learns, a resumed one ends in the same bytes, faults are said."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from genre_tasks.errors import InputError, NonFiniteError
from genre_tasks.fixer.architectures import small_architecture
from genre_tasks.fixer.training import train
from genre_tasks.fixer.training_checkpoint import count_steps
from genre_tasks.fixer.training_settings import TrainingSettings
from tests.fixer.test_fixer_pairs import some_pairs

TOY = small_architecture((8, 8, 16, 16), 4, (16, 16))
SETTINGS = TrainingSettings(
    autoencoder_steps=4, autoencoder_batch=1, steps=6, batch=1, crop=(32, 48), warmup=2, checkpoint_every=3
)


def distance(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    return (a - b).square().mean((1, 2, 3))


class StoppedError(Exception):
    pass


def test_a_stopped_training_resumes_to_the_same_bytes(tmp_path):
    whole = train(some_pairs(), SETTINGS, tmp_path / "whole", distance, architecture=TOY)

    def stop(done, total, note):
        if done == 8:
            raise StoppedError

    with pytest.raises(StoppedError):
        train(some_pairs(), SETTINGS, tmp_path / "stopped", distance, stop, architecture=TOY)
    steps = []
    resumed = train(
        some_pairs(),
        SETTINGS,
        tmp_path / "stopped",
        distance,
        progress=lambda done, total, note: steps.append((done, total)),
        architecture=TOY,
    )
    assert steps == [(8, 10), (9, 10), (10, 10)]
    pairs = zip(whole.state_dict().values(), resumed.state_dict().values(), strict=True)
    assert all(torch.equal(a, b) for a, b in pairs)


def test_the_encoder_is_frozen_after_the_first_part(tmp_path):
    trained = train(some_pairs(), SETTINGS, tmp_path, distance, architecture=TOY)
    stored = torch.load(tmp_path / "autoencoder.pt", weights_only=True)
    state = trained.state_dict()
    encoder = [k for k in state if k.startswith(("vae.encoder", "vae.quant_conv"))]
    assert encoder and all(torch.equal(state[k], stored["weights"][k]) for k in encoder)
    assert not torch.equal(state["skips.0.weight"], stored["weights"]["skips.0.weight"])
    latent = trained.encode(torch.rand(1, 3, 32, 48)).latent
    assert trained.vae.config.scaling_factor == pytest.approx(stored["scale"]) and torch.isfinite(latent).all()


def test_it_learns_to_take_a_tint_away(tmp_path):
    settings = replace(SETTINGS, autoencoder_steps=2, steps=40, learning_rate=3e-3, clean_share=0.0)
    pairs = some_pairs(1, 32, 48)
    ramp = torch.linspace(90, 220, 48).to(torch.uint8).expand(1, 3, 32, 48).contiguous()
    views = replace(pairs.views, color=ramp - 60, alpha=torch.full_like(pairs.views.alpha, 255))
    notes = []
    train(
        replace(pairs, views=views, truth=ramp),
        settings,
        tmp_path,
        distance,
        lambda done, total, note: notes.append(note),
        architecture=TOY,
    )
    losses = torch.load(tmp_path / "fixer.pt", weights_only=True)["losses"]
    assert sum(losses[-5:]) < 0.5 * sum(losses[:5])
    assert "min left" in notes[-1]


def test_other_settings_are_refused(tmp_path):
    train(some_pairs(), SETTINGS, tmp_path, distance, architecture=TOY)
    with pytest.raises(InputError, match=r"other settings: learning_rate \(file .*fixer\.pt"):
        train(some_pairs(), replace(SETTINGS, learning_rate=5e-3), tmp_path, distance, architecture=TOY)
    with pytest.raises(InputError, match=r"other settings: kl \(file .*autoencoder\.pt"):
        train(some_pairs(), replace(SETTINGS, kl=1.0), tmp_path, distance, architecture=TOY)


def test_an_autoencoder_of_another_training_is_refused(tmp_path):
    path = tmp_path / "autoencoder.pt"
    train(some_pairs(), SETTINGS, tmp_path, distance, architecture=TOY)
    slower = replace(SETTINGS, warmup=3)
    with pytest.raises(InputError, match=r"other settings: warmup \(file .*autoencoder\.pt"):
        train(some_pairs(), slower, tmp_path / "slower", distance, architecture=TOY, autoencoder=tmp_path)
    # Shapes are equal, so that its weights could be loaded.
    other = replace(TOY, vae={**TOY.vae, "norm_num_groups": 4})
    with pytest.raises(InputError, match=r"other architecture \(file .*autoencoder\.pt"):
        train(some_pairs(), SETTINGS, tmp_path / "other", distance, architecture=other, autoencoder=tmp_path)
    fewer_inputs = replace(TOY, inputs=("render",))
    train(some_pairs(), SETTINGS, tmp_path / "fewer", distance, architecture=fewer_inputs, autoencoder=tmp_path)
    # An autoencoder of an older version, which knew no such digest, counts as the same.
    stored = torch.load(path, weights_only=True)
    del stored["origin"]["architecture"]
    torch.save(stored, path)
    train(some_pairs(), SETTINGS, tmp_path, distance, architecture=TOY)


def test_a_training_on_other_pairs_or_from_other_weights_is_not_taken_for_this_one(tmp_path):
    first = train(some_pairs(), SETTINGS, tmp_path / "first", distance, architecture=TOY)
    train(some_pairs(), SETTINGS, tmp_path / "first", distance, architecture=TOY)  # finished: the same
    pairs = some_pairs()
    other = replace(pairs, truth=255 - pairs.truth)
    with pytest.raises(InputError, match=r"other pairs \(file .*autoencoder\.pt"):
        train(other, SETTINGS, tmp_path / "first", distance, architecture=TOY)
    further = replace(SETTINGS, steps=1)
    train(pairs, further, tmp_path / "further", distance, start=first)
    again = train(pairs, replace(further, seed=5), tmp_path / "again", distance, start=first)
    with pytest.raises(InputError, match=r"other pairs \(file .*fixer\.pt"):
        train(other, further, tmp_path / "further", distance, start=first)
    with pytest.raises(InputError, match=r"other starting weights \(file .*fixer\.pt"):
        train(pairs, further, tmp_path / "further", distance, start=again)


@pytest.mark.parametrize("name", ["fixer.pt", "autoencoder.pt"])
@pytest.mark.parametrize("damage", ["empty", "cut", "text", "other"])
def test_a_damaged_checkpoint_is_named_with_a_remedy(tmp_path, name, damage):
    train(some_pairs(), SETTINGS, tmp_path, distance, architecture=TOY)
    path = tmp_path / name
    data = path.read_bytes()
    if damage == "other":
        torch.save({"weights": {}}, path)
    else:
        path.write_bytes({"empty": b"", "cut": data[: len(data) // 2], "text": b"no checkpoint"}[damage])
    with pytest.raises(InputError, match=rf"checkpoint .*{name}\)\. Delete it to train again"):
        train(some_pairs(), SETTINGS, tmp_path, distance, architecture=TOY)


def test_steps_of_a_damaged_checkpoint_are_not_counted(tmp_path):
    path = tmp_path / "fixer.pt"
    path.write_bytes(b"no checkpoint")
    with pytest.raises(InputError, match=r"the checkpoint cannot be read .*fixer\.pt"):
        count_steps(path)


def test_pairs_smaller_than_a_crop_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"the pairs are 64 × 48 pixels, crops of 96 × 32"):
        train(some_pairs(), replace(SETTINGS, crop=(32, 96)), tmp_path, distance, architecture=TOY)


def test_a_loss_that_is_not_finite_stops_it(tmp_path):
    with pytest.raises(NonFiniteError, match="loss of step 0"):
        train(some_pairs(), SETTINGS, tmp_path, lambda a, b: distance(a, b) * float("nan"), architecture=TOY)


def test_a_fixer_is_trained_further(tmp_path):
    first = train(some_pairs(), SETTINGS, tmp_path / "first", distance, architecture=TOY)
    steps = []
    settings = replace(SETTINGS, steps=2, learning_rate=1e-6)
    further = train(
        some_pairs(),
        settings,
        tmp_path / "further",
        distance,
        lambda done, total, note: steps.append((done, total)),
        start=first,
    )
    assert steps == [(1, 2), (2, 2)] and not (tmp_path / "further" / "autoencoder.pt").exists()
    before, after = first.state_dict(), further.state_dict()
    assert any(not torch.equal(v, after[k]) for k, v in before.items())
    assert all((v - after[k]).abs().max() < 1e-4 for k, v in before.items())
