"""Training of the detector: gradients reach every weight, it learns, and it resumes to the same bytes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from genre_tasks.detection3d.checkpoint import restore_checkpoint
from genre_tasks.detection3d.detector import build_network, load_detector, save_detector
from genre_tasks.detection3d.evaluate import evaluate_detector, score_detections
from genre_tasks.detection3d.examples import build_examples
from genre_tasks.detection3d.losses import focal_loss
from genre_tasks.detection3d.settings import Detector3dConfig
from genre_tasks.detection3d.training import compute_loss, draw_batch, train_detector
from genre_tasks.errors import ConfigError, InputError, NonFiniteError
from tests.detection3d.labelled import TINY, labelled_box, labelled_image

IMAGES = (
    labelled_image(labelled_box(1.0, 12.0, 0.4), labelled_box(-5.0, 18.0, -2.5), frame=0),
    labelled_image(
        labelled_box(3.5, 14.0, 1.5),
        labelled_box(-1.5, 9.0, 3.0, label="Pedestrian", size_m=(0.7, 0.6, 1.6)),
        frame=1,
    ),
)
CHANGED = TINY.model_copy(update={"flip": 0.5, "zoom": 0.2, "shift": 0.1, "colour_jitter": 0.2})


def same_weights(one: torch.nn.Module, other: torch.nn.Module) -> bool:
    return all(torch.equal(a, b) for a, b in zip(one.state_dict().values(), other.state_dict().values(), strict=True))


def test_gradients_reach_every_parameter() -> None:
    network = build_network(TINY)
    compute_loss(network, draw_batch(build_examples(IMAGES, TINY), TINY, 0), TINY).backward()
    silent = [name for name, p in network.named_parameters() if p.grad is None or not bool(p.grad.abs().sum() > 0)]
    assert not silent


def test_it_learns_two_images_by_heart() -> None:
    config = TINY.model_copy(update={"steps": 250, "learning_rate": 5e-3, "warm_up": 10})
    detector = train_detector(IMAGES, config)
    assert len(detector.losses) == 250
    assert np.mean(detector.losses[-10:]) < np.mean(detector.losses[:10]) - 5
    for image in IMAGES:
        found = detector.detect(image.image, image.lens)
        for box in image.boxes:
            kind = config.class_of(box.label)
            errors = np.linalg.norm(found.camera_SE3_box[:, :3, 3] - box.camera_SE3_box[:3, 3], axis=1)
            n = int(np.argmin(np.where(found.classes == kind, errors, np.inf)))
            assert errors[n] < 0.4 and found.classes[n] == kind
            assert np.abs(found.sizes_m[n] - box.size_m).max() < 0.2
            assert found.camera_SE3_box[n, :3, 0] @ box.camera_SE3_box[:3, 0] > 0.95
    scores = evaluate_detector(detector, IMAGES)
    assert scores.truth_count == 4 and scores.images == 2
    assert scores.at_threshold(1.0) > 0.9
    # The metric falls where boxes are elsewhere.
    elsewhere = [detector.detect(image.image, image.lens) for image in IMAGES[::-1]]
    assert score_detections(elsewhere, IMAGES, config).mean_average_precision < 0.5


def test_a_resumed_training_gives_the_same_bytes(tmp_path: Path) -> None:
    config = CHANGED.model_copy(update={"steps": 6, "checkpoint_every": 2})
    uninterrupted = train_detector(IMAGES, config)

    class StoppedError(Exception):
        pass

    def stop(done: int, total: int, note: str = "") -> None:
        # In the middle between two checkpoints: a step is done again.
        if done == 5:
            raise StoppedError

    path = tmp_path / "folder" / "detector.safetensors"
    with pytest.raises(StoppedError):
        train_detector(IMAGES, config, path, stop)
    seen: list[int] = []
    resumed = train_detector(IMAGES, config, path, lambda done, total, note="": seen.append(done))
    assert seen == [5, 6]
    assert same_weights(uninterrupted.network, resumed.network)
    assert uninterrupted.losses == resumed.losses
    # A complete training is read, and not run again.
    seen.clear()
    assert same_weights(train_detector(IMAGES, config, path, lambda *a: seen.append(1)).network, resumed.network)
    assert not seen


def test_the_seed_decides_and_nothing_else() -> None:
    torch.manual_seed(1)
    first = train_detector(IMAGES, CHANGED)
    torch.manual_seed(2)
    with_examples = train_detector(build_examples(IMAGES, CHANGED), CHANGED)
    assert same_weights(first.network, with_examples.network)
    other = train_detector(IMAGES, CHANGED.model_copy(update={"seed": 1}))
    assert not same_weights(first.network, other.network)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_the_number_of_steps_does_not_depend_on_the_images(count: int) -> None:
    images = [IMAGES[n % 2] for n in range(count)]
    seen: list[tuple[int, int]] = []
    detector = train_detector(images, TINY, progress=lambda done, total, note="": seen.append((done, total)))
    assert seen == [(n + 1, TINY.steps) for n in range(TINY.steps)]
    assert len(detector.losses) == TINY.steps


def test_all_images_are_drawn_before_one_is_drawn_again() -> None:
    images = [labelled_image(labelled_box(0.0, 10.0 + n)) for n in range(6)]
    examples = build_examples(images, TINY)
    depths = [float(z) for step in range(3) for z in draw_batch(examples, TINY, step).objects.depths_m]
    assert sorted(depths) == [10.0, 11.0, 12.0, 13.0, 14.0, 15.0]


def test_checkpoints_of_other_trainings_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "detector.safetensors"
    train_detector(IMAGES, TINY, path)
    with pytest.raises(InputError, match="other learning_rate, seed") as caught:
        train_detector(IMAGES, TINY.model_copy(update={"learning_rate": 1e-3, "seed": 4}), path)
    assert caught.value.file == str(path)
    with pytest.raises(InputError, match="other images"):
        train_detector(IMAGES[:1], TINY, path)
    path.write_bytes(b"no checkpoint")
    with pytest.raises(InputError, match="cannot be read"):
        train_detector(IMAGES, TINY, path)
    restore_checkpoint(None, tmp_path / "missing", TINY, "")  # type: ignore[arg-type]


def test_divergence_is_an_error() -> None:
    config = TINY.model_copy(update={"steps": 50, "learning_rate": 100.0, "clip": 1e30, "weight_decay": 1.0})
    with pytest.raises(NonFiniteError, match="of step"):
        train_detector(IMAGES, config)


def test_a_detector_survives_its_files(tmp_path: Path) -> None:
    detector = train_detector(IMAGES, TINY)
    path = tmp_path / "detector.safetensors"
    save_detector(detector, path)
    loaded = load_detector(path)
    assert loaded.config == TINY and same_weights(loaded.network, detector.network)
    image = IMAGES[0]
    one = detector.detect(image.image, image.lens)
    assert np.array_equal(one.camera_SE3_box, loaded.detect(image.image, image.lens).camera_SE3_box)
    path.with_suffix(".json").write_text('{"width": 17}')
    with pytest.raises(ConfigError, match="not valid"):
        load_detector(path)
    path.with_suffix(".json").write_text('{"width": 32}')
    with pytest.raises(InputError, match="do not fit"):
        load_detector(path)
    path.unlink()
    with pytest.raises(InputError, match="missing"):
        load_detector(path)


def test_a_lens_of_another_size_is_refused() -> None:
    detector = train_detector(IMAGES, TINY.model_copy(update={"steps": 1}))
    with pytest.raises(InputError, match="its lens is of"):
        detector.detect(IMAGES[0].image[:10], IMAGES[0].lens)
    with pytest.raises(InputError, match="no images to evaluate on"):
        evaluate_detector(detector, [])


def test_the_focal_loss_is_smallest_at_the_targets() -> None:
    heat = torch.zeros(1, 1, 4, 4)
    heat[0, 0, 1, 1] = 1
    right = torch.where(heat == 1, 9.0, -9.0)
    assert focal_loss(right, heat) < 1e-6 < focal_loss(-right, heat)
    # Without any object it is finite, and still teaches that nothing is there.
    assert 0 < focal_loss(torch.zeros(1, 1, 4, 4), torch.zeros(1, 1, 4, 4)) < 10


def test_a_label_belongs_to_one_class() -> None:
    car = Detector3dConfig().classes[0]
    with pytest.raises(ValueError, match="share a name or a label"):
        Detector3dConfig(classes=(car, car.model_copy(update={"name": "truck"})))
    assert Detector3dConfig.model_validate_json(Detector3dConfig().model_dump_json()) == Detector3dConfig()
