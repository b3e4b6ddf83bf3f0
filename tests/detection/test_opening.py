"""Detectors opened by file or by name: ONNX, TFLite, torchvision and Detectron2, and what is refused."""

from __future__ import annotations

import sys
import zipfile
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from genre_tasks.detection.detector import open_detector
from genre_tasks.detection.networks import LiteRtNetwork, OnnxNetwork, _read_attached_metadata, read_input_shape
from genre_tasks.errors import ConfigError, InputError

REAL = Path("../shared/data")
FILES = ("FastestDet.onnx", "yolox_nano.onnx", "yolov8n-seg_int8.tflite")
IMAGE = np.zeros((60, 120, 3), np.uint8)


class FakeSession:
    """An onnxruntime session of one input."""

    def __init__(self, shape: list[object], kind: str = "tensor(float)", count: int = 1) -> None:
        self.inputs = [SimpleNamespace(name="image", shape=shape, type=kind)] * count
        self.given: list[np.ndarray] = []

    def get_inputs(self) -> list[SimpleNamespace]:
        return self.inputs

    def get_modelmeta(self) -> SimpleNamespace:
        return SimpleNamespace(custom_metadata_map={"names": "{0: 'car'}"})

    def run(self, _: None, given: dict[str, np.ndarray]) -> list[np.ndarray]:
        self.given.append(given["image"])
        return [np.zeros((1, 16, 16, 5), np.float64)]


class FakeInterpreter:
    """A LiteRT interpreter of 8-bit numbers, rows and columns before channels."""

    def __init__(self) -> None:
        self.given: np.ndarray = np.zeros(0)

    def get_input_details(self) -> list[dict[str, object]]:
        return [{"index": 0, "shape": np.array([1, 32, 64, 3]), "dtype": np.int8, "quantization": (1 / 255, -128)}]

    def get_output_details(self) -> list[dict[str, object]]:
        return [{"index": 1, "quantization": (0.5, 3)}, {"index": 2, "quantization": (0.0, 0)}]

    def set_tensor(self, index: int, values: np.ndarray) -> None:
        self.given = values

    def invoke(self) -> None:
        pass

    def get_tensor(self, index: int) -> np.ndarray:
        return np.array([[[1, 3, 7]]], np.uint8) if index == 1 else np.zeros((1, 8, 16, 4), np.float32)


@pytest.mark.parametrize(
    "shape,expected",
    [
        ([1, 3, 416, 416], (False, (416, 416))),
        (["batch", 3, 384, 640], (False, (384, 640))),
        ([None, None, None, None], (False, (640, 640))),
        ([1, 384, 640, 3], (True, (384, 640))),
        (["n", "h", "w", 3], (True, (640, 640))),
        ([1, 3, 640, 3], (False, (640, 3))),
        ([-1, 3, -1, -1], (False, (640, 640))),
    ],
)
def test_the_input_is_read_in_either_order(shape: list[object], expected: tuple[bool, tuple[int, int]]) -> None:
    assert read_input_shape(shape, Path("x")) == expected  # type: ignore[arg-type]


@pytest.mark.parametrize("shape", [[1, 4, 64, 64], [2, 3, 64, 64], [1, 3, 64], [1, 64, 64, 1], []])
def test_what_is_no_image_is_refused(shape: list[object]) -> None:
    with pytest.raises(InputError, match=r"not one image.*Supported are networks"):
        read_input_shape(shape, Path("x.onnx"))  # type: ignore[arg-type]


def test_an_onnx_session_gets_the_order_and_type_that_it_wants() -> None:
    session = FakeSession([1, 64, 64, 3], "tensor(float16)")
    network = OnnxNetwork(session, Path("x.onnx"))
    (output,) = network.run(np.arange(3 * 64 * 64, dtype=np.float32).reshape(1, 3, 64, 64) / 4096)
    assert session.given[0].shape == (1, 64, 64, 3) and session.given[0].dtype == np.float16
    assert session.given[0][0, 0, 0].tolist() == [0, 1, 2]
    assert output.shape == (1, 5, 16, 16) and output.dtype == np.float32  # channels first, as all maps
    assert network.metadata == {"names": "{0: 'car'}"}
    for wrong in (FakeSession([1, 3, 64, 64], "tensor(uint8)"), FakeSession([1, 3, 64, 64], count=2)):
        with pytest.raises(InputError, match=r"the network takes .*x\.onnx"):
            OnnxNetwork(wrong, Path("x.onnx"))


def test_tflite_numbers_of_8_bits_are_scaled() -> None:
    interpreter = FakeInterpreter()
    network = LiteRtNetwork(interpreter, Path("x.tflite"), {})
    rows, prototypes = network.run(np.full((1, 3, 32, 64), 1.0, np.float32))
    assert network.input_size == (32, 64) and interpreter.given.shape == (1, 32, 64, 3)
    assert interpreter.given.dtype == np.int8 and (interpreter.given == 127).all()
    assert rows.tolist() == [[[-1, 0, 2]]] and prototypes.shape == (1, 4, 8, 16)


def test_an_archive_after_a_tflite_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "x.tflite"
    path.write_bytes(b"network")
    assert _read_attached_metadata(path) == {}
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("metadata.json", '{"names": ["car"]}')
        archive.writestr("large", bytes(2_000_000))
    assert _read_attached_metadata(path) == {"metadata.json": '{"names": ["car"]}'}


def test_what_is_no_detector_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("none.onnx", "none.tflite"):
        with pytest.raises(InputError, match=rf"no such detector.*{name}"):
            open_detector(str(tmp_path / name))
    (tmp_path / "x.pt").touch()
    with pytest.raises(InputError, match=r"this is no detector.*x\.pt.*torchvision:NAME"):
        open_detector(str(tmp_path / "x.pt"))
    with pytest.raises(ConfigError, match="between 0 and 1"):
        open_detector("x.onnx", min_score=1.5)
    for name, package in (("text.onnx", "onnxruntime"), ("text.tflite", "ai_edge_litert.interpreter")):
        (tmp_path / name).write_text("no network")
        with pytest.raises(InputError, match=rf"the detector cannot be read.*{name}.*Supported are"):
            open_detector(str(tmp_path / name))
        monkeypatch.setitem(sys.modules, package, None)
        with pytest.raises(ConfigError, match=r"genre\[perception\]"):
            open_detector(str(tmp_path / name))


def test_libraries_that_are_not_installed_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torchvision", None)
    monkeypatch.setitem(sys.modules, "detectron2", None)
    with pytest.raises(ConfigError, match=r"torchvision:fcos.*pip install torchvision"):
        open_detector("torchvision:fcos")
    with pytest.raises(ConfigError, match=r"detectron2:x\.yaml.*Install the package detectron2"):
        open_detector("detectron2:x.yaml")


class FakeMaskNetwork(torch.nn.Module):
    """Answers like torchvision's Mask R-CNN."""

    def forward(self, images: list[torch.Tensor]) -> list[dict[str, torch.Tensor]]:
        (image,) = images
        assert image.shape == (3, 60, 120) and image.max() <= 1 and not self.training
        masks = torch.zeros(3, 1, 60, 120)
        masks[1, 0, 10:20, 10:20] = 0.6
        return [
            {
                "boxes": torch.tensor([[0.0, 0, 5, 5], [10, 10, 200, 20], [1, 1, 9, 9]]),
                "scores": torch.tensor([0.1, 0.9, 0.5]),
                "labels": torch.tensor([1, 2, 1]),
                "masks": masks,
            }
        ]


@pytest.fixture
def fake_torchvision(monkeypatch: pytest.MonkeyPatch) -> None:
    weights = SimpleNamespace(DEFAULT=SimpleNamespace(meta={"categories": ["__background__", "person", "car"]}))
    models = SimpleNamespace(
        detection="detection",
        list_models=lambda module: ["maskrcnn_resnet50_fpn"] if module == "detection" else ["resnet50"],
        get_model_weights=lambda name: weights,
        get_model=lambda name, weights: FakeMaskNetwork(),
    )
    module = ModuleType("torchvision")
    module.models = models  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "torchvision", module)


@pytest.mark.usefixtures("fake_torchvision")
def test_a_network_of_torchvision_answers_in_the_same_form(tmp_path: Path) -> None:
    detector = open_detector("torchvision:maskrcnn_resnet50_fpn", min_score=0.4)
    found = detector.detect(IMAGE)
    assert detector.has_masks and [detector.class_names[k] for k in found.classes] == ["car", "person"]
    assert found.boxes[0].tolist() == [10, 10, 120, 20] and found.scores == pytest.approx([0.9, 0.5])
    assert found.masks is not None and found.masks.sum((1, 2)).tolist() == [100, 0]
    with pytest.raises(InputError, match=r"no detector 'resnet50'.*maskrcnn_resnet50_fpn"):
        open_detector("torchvision:resnet50")
    (tmp_path / "names.txt").write_text("car\n")
    with pytest.raises(InputError, match="has 3 classes, and the list of class names has 1"):
        open_detector("torchvision:maskrcnn_resnet50_fpn", tmp_path / "names.txt")


class FakeInstances:
    """Detectron2's instances of one image."""

    pred_boxes = SimpleNamespace(tensor=torch.tensor([[1.0, 2, 30, 40]]))
    scores = torch.tensor([0.8])
    pred_classes = torch.tensor([0])
    pred_masks = torch.ones(1, 60, 120, dtype=torch.bool)

    def to(self, device: str) -> FakeInstances:
        assert device == "cpu"
        return self


def test_a_configuration_of_detectron2_answers_in_the_same_form(monkeypatch: pytest.MonkeyPatch) -> None:
    config = SimpleNamespace(
        MODEL=SimpleNamespace(WEIGHTS="", DEVICE="", MASK_ON=True, ROI_HEADS=SimpleNamespace(SCORE_THRESH_TEST=0.0)),
        DATASETS=SimpleNamespace(TRAIN=("train",)),
        merge_from_file=lambda path: None,
    )
    seen: list[np.ndarray] = []

    def predictor(settings: object) -> object:
        def predict(image: np.ndarray) -> dict[str, FakeInstances]:
            seen.append(image)
            return {"instances": FakeInstances()}

        return predict

    def find_config(name: str) -> str:
        if name != "a.yaml":
            raise RuntimeError(f"{name} not available in Model Zoo!")
        return name

    zoo = SimpleNamespace(get_config_file=find_config, get_checkpoint_url=lambda name: f"weights of {name}")
    contents = {
        "detectron2": {"model_zoo": zoo},
        "detectron2.config": {"get_cfg": lambda: config},
        "detectron2.data": {"MetadataCatalog": {"train": SimpleNamespace(thing_classes=["car"])}},
        "detectron2.engine": {"DefaultPredictor": predictor},
    }
    for name, values in contents.items():
        module = ModuleType(name)
        vars(module).update(values)
        monkeypatch.setitem(sys.modules, name, module)
    detector = open_detector("detectron2:a.yaml", min_score=0.6)
    image = IMAGE.copy()
    image[..., 0] = 200
    found = detector.detect(image)
    assert (seen[0][0, 0] == [0, 0, 200]).all()  # blue first
    assert found.boxes.tolist() == [[1, 2, 30, 40]] and detector.class_names == ("car",) and detector.has_masks
    assert config.MODEL.WEIGHTS == "weights of a.yaml" and config.MODEL.ROI_HEADS.SCORE_THRESH_TEST == 0.6
    with pytest.raises(InputError, match=r"no configuration 'b\.yaml'"):
        open_detector("detectron2:b.yaml")


@pytest.mark.parametrize("name", FILES)
def test_a_real_detector_finds_the_cars_of_a_street(name: str) -> None:
    image_path = REAL / "pandaset/002/camera/front_camera/10.jpg"
    if not (REAL / "detectors" / name).is_file() or not image_path.is_file():
        pytest.skip("the detector or the log is not there")
    detector = open_detector(str(REAL / "detectors" / name))
    with Image.open(image_path) as file:
        image = np.asarray(file.convert("RGB"))
    found = detector.detect(image)
    cars = found.select(found.classes == 2)
    assert len(cars) >= 8 and (np.diff(found.scores) <= 0).all() and detector.class_names[2] == "car"
    # The white car in the middle, and the dark one at the left edge.
    for place in ((945, 625), (150, 880)):
        inside = (cars.boxes[:, :2] < place).all(1) & (cars.boxes[:, 2:] > place).all(1)
        assert inside.any()
        if detector.has_masks:
            assert cars.masks is not None and cars.masks[inside][:, place[1], place[0]].any()
    assert len(detector.detect(np.full_like(image, 127))) == 0


def test_an_archive_of_many_files_is_not_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "many.tflite"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for number in range(200):
            archive.writestr(f"{number}.txt", "0" * 900_000)
        archive.writestr("large.txt", "0" * 2_000_000)
    assert sum(map(len, _read_attached_metadata(path).values())) < 20_000_000
