"""Networks in files, ONNX or TFLite: an array goes in, arrays come out."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from genre_tasks.detection.output_forms import SUPPORTED_FORMS
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.logs.types import Float32

DEFAULT_SIZE = 640
"""Height and width of the input where a file leaves them open."""

_MAX_METADATA_FILES = 16
_MAX_METADATA_BYTES = 1_000_000
_ONNX_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16}


class Network(Protocol):
    """A network of one image.

    Attributes:
        input_size: height and width of the image that it takes.
        metadata: what the file says about itself, as texts by their keys.
    """

    @property
    def input_size(self) -> tuple[int, int]: ...

    @property
    def metadata(self) -> dict[str, str]: ...

    def run(self, image: Float32) -> list[Float32]:
        """Computes the outputs.

        Args:
            image: [1, 3, H, W].

        Returns:
            The outputs, each with the batch's axis; maps with their channels before rows and columns.
        """
        ...


class OnnxNetwork:
    """A network of an ONNX file.

    Args:
        session: onnxruntime's session of the network.
        file: where it is from, for errors.

    Raises:
        InputError: it takes something else than one image.
    """

    def __init__(self, session: Any, file: Path) -> None:
        inputs = session.get_inputs()
        shapes = [list(given.shape) for given in inputs]
        if len(inputs) != 1 or inputs[0].type not in _ONNX_TYPES:
            raise InputError(
                f"the network takes {shapes} of {', '.join(given.type for given in inputs)}",
                remedy=SUPPORTED_FORMS,
                file=file,
            )
        self._session = session
        self._name = inputs[0].name
        self._type = _ONNX_TYPES[inputs[0].type]
        self._rows_first, self.input_size = read_input_shape(shapes[0], file)
        self.metadata: dict[str, str] = dict(session.get_modelmeta().custom_metadata_map)

    def run(self, image: Float32) -> list[Float32]:
        """Computes the outputs, see :class:`Network`.

        Args:
            image: [1, 3, H, W].
        """
        # Converters to TensorFlow put the channels last.
        given = image.transpose(0, 2, 3, 1) if self._rows_first else image
        outputs = self._session.run(None, {self._name: np.ascontiguousarray(given, self._type)})
        return [_order_map(np.asarray(output, np.float32), self.input_size) for output in outputs]


class LiteRtNetwork:
    """A network of a TFLite file.

    Args:
        interpreter: LiteRT's interpreter, with its tensors allocated.
        file: where it is from, for errors.
        metadata: what the file says about itself.

    Raises:
        InputError: it takes something else than one image.
    """

    def __init__(self, interpreter: Any, file: Path, metadata: dict[str, str]) -> None:
        inputs = interpreter.get_input_details()
        shapes = [[int(n) for n in given["shape"]] for given in inputs]
        if len(inputs) != 1:
            raise InputError(f"the network takes {shapes}", remedy=SUPPORTED_FORMS, file=file)
        self._interpreter = interpreter
        self._input = inputs[0]
        self._rows_first, self.input_size = read_input_shape(shapes[0], file)
        self.metadata = metadata

    def run(self, image: Float32) -> list[Float32]:
        """Computes the outputs, see :class:`Network`.

        Args:
            image: [1, 3, H, W].
        """
        given = image.transpose(0, 2, 3, 1) if self._rows_first else image
        self._interpreter.set_tensor(self._input["index"], _quantise(given, self._input))
        self._interpreter.invoke()
        outputs = [
            _dequantise(self._interpreter.get_tensor(detail["index"]), detail)
            for detail in self._interpreter.get_output_details()
        ]
        return [_order_map(output, self.input_size) for output in outputs]


def open_onnx(path: Path) -> OnnxNetwork:
    """Opens an ONNX file.

    Args:
        path: the file.

    Raises:
        ConfigError: onnxruntime is not installed.
        InputError: the file holds no network of one image.
    """
    try:
        import onnxruntime
    except ImportError as error:
        raise ConfigError(
            "detectors in ONNX files run with onnxruntime, which is not installed",
            remedy="Run `pip install 'genre[perception]'`.",
        ) from error
    options = onnxruntime.SessionOptions()
    # onnxruntime would take all cores, whatever number torch was given, and its idle threads would spin.
    options.intra_op_num_threads = torch.get_num_threads()
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    # Warnings about a file's unused constants are of no use to who only runs it.
    options.log_severity_level = 3
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's own exceptions have no common class
        raise InputError(f"the detector cannot be read: {error}", remedy=SUPPORTED_FORMS, file=path) from error
    return OnnxNetwork(session, path)


def open_litert(path: Path) -> LiteRtNetwork:
    """Opens a TFLite file.

    Args:
        path: the file.

    Raises:
        ConfigError: LiteRT is not installed.
        InputError: the file holds no network of one image.
    """
    try:
        from ai_edge_litert.interpreter import Interpreter
    except ImportError as error:
        raise ConfigError(
            "detectors in TFLite files run with ai-edge-litert, which is not installed",
            remedy="Run `pip install 'genre[perception]'`.",
        ) from error
    try:
        interpreter = Interpreter(model_path=str(path), num_threads=torch.get_num_threads())
        interpreter.allocate_tensors()
    except (ValueError, RuntimeError) as error:
        raise InputError(f"the detector cannot be read: {error}", remedy=SUPPORTED_FORMS, file=path) from error
    return LiteRtNetwork(interpreter, path, _read_attached_metadata(path))


def read_input_shape(shape: Sequence[int | str | None], file: Path) -> tuple[bool, tuple[int, int]]:
    """Reads what kind of image a network takes.

    Args:
        shape: of its input; entries that a file leaves open are texts or ``None``.
        file: for the error.

    Returns:
        Whether rows and columns come before the channels, and height and width, pixels.

    Raises:
        InputError: it is not the shape of one image with three channels.

    >>> read_input_shape(["batch", 3, "height", "width"], Path("x.onnx"))
    (False, (640, 640))
    >>> read_input_shape([1, 384, 640, 3], Path("x.tflite"))
    (True, (384, 640))
    """
    sizes = [n if isinstance(n, int) and n > 0 else None for n in shape]
    if len(sizes) == 4 and sizes[0] in (1, None):
        # Channels first wherever both could be: a file that leaves all sizes open was exported from PyTorch.
        for rows_first, axis in ((False, 1), (True, 3)):
            if sizes[axis] == 3 or (sizes[axis] is None and not rows_first and sizes[3] != 3):
                height, width = sizes[1:3] if rows_first else sizes[2:4]
                return rows_first, (height or DEFAULT_SIZE, width or DEFAULT_SIZE)
    raise InputError(f"the network takes {list(shape)}, not one image", remedy=SUPPORTED_FORMS, file=file)


def _order_map(output: Float32, input_size: tuple[int, int]) -> Float32:
    """An output with four axes with its channels before rows and columns."""
    if output.ndim == 4:
        height, width = input_size
        aspects = [output.shape[a] * width == output.shape[b] * height for a, b in ((1, 2), (2, 3))]
        # Rows and columns are those axes whose lengths have the ratio of the image's height and width.
        if aspects == [True, False]:
            return output.transpose(0, 3, 1, 2)
    return output


def _quantise(values: Float32, detail: dict[str, Any]) -> NDArray[Any]:
    """Values in the type of a tensor: floating-point numbers, or integers with the tensor's step and zero."""
    kind = np.dtype(detail["dtype"])
    step, zero = detail["quantization"]
    if kind.kind == "f" or not step:
        return np.ascontiguousarray(values, kind)
    # Rounded and clipped, because a cast would wrap around.
    limits = np.iinfo(kind)
    return np.ascontiguousarray((values / step + zero).round().clip(limits.min, limits.max).astype(kind))


def _dequantise(values: NDArray[Any], detail: dict[str, Any]) -> Float32:
    """The numbers that a tensor's values stand for."""
    step, zero = detail["quantization"]
    if values.dtype.kind == "f" or not step:
        return values.astype(np.float32)
    return ((values.astype(np.float32) - zero) * step).astype(np.float32)


def _read_attached_metadata(path: Path) -> dict[str, str]:
    """Texts of a ZIP archive that tools append to a TFLite file; empty without one."""
    # The archive stands behind the network, so the ending does not tell.
    if not zipfile.is_zipfile(path):
        return {}
    texts: dict[str, str] = {}
    with zipfile.ZipFile(path) as archive:
        for entry in archive.infolist()[:_MAX_METADATA_FILES]:
            # Files of a few KB; an archive that unpacks to gigabytes is not read.
            if entry.file_size < _MAX_METADATA_BYTES:
                texts[entry.filename] = archive.read(entry).decode("utf-8", "replace")
    return texts
