"""Lenses and shutters between the wire and GenRe's own: the pinhole with Brown-Conrady distortion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flows.simulators.alpasim import sensorsim_pb2
from flows.simulators.image_request import CameraDescription
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.logs.types import Lens

MAX_COEFFICIENT = 1e4
_MAX_FOCAL_PX = 1e6
_MAX_SIDE_PX = 1 << 16


def read_lens(spec: sensorsim_pb2.CameraSpec, width_px: int, height_px: int) -> Lens:
    """Reads the lens of a request.

    Args:
        spec: of the wire. Its resolution is the image that the lens is stated for; without one it is the requested
            image.
        width_px: of the requested image.
        height_px: of the requested image.

    Returns:
        The lens for the requested image.

    Raises:
        InputError: a number is missing, not finite or absurd.
        ConfigError: the camera model is one that GenRe does not render.
    """
    model = spec.WhichOneof("camera_param")
    if model is None:
        raise InputError("the request has no camera model", remedy="Send opencv_pinhole_param.")
    if model != "opencv_pinhole_param":
        raise ConfigError(
            f"the camera model {model} is not rendered",
            remedy="Send opencv_pinhole_param, as get_available_cameras states it.",
        )
    if spec.WhichOneof("external_distortion") is not None:
        raise ConfigError("a windshield in front of the lens is not rendered", remedy="Leave it out.")
    stated = (spec.resolution_w or width_px, spec.resolution_h or height_px)
    if max(stated) > _MAX_SIDE_PX:
        raise InputError(f"a lens for {stated[0]} × {stated[1]} pixels is absurd", remedy="Send its real resolution.")
    return _read_pinhole(spec.opencv_pinhole_param, *stated).resized(width_px, height_px)


def _read_pinhole(pinhole: sensorsim_pb2.OpenCVPinholeCameraParam, width_px: int, height_px: int) -> Lens:
    focal = (pinhole.focal_length_x, pinhole.focal_length_y)
    center = (pinhole.principal_point_x, pinhole.principal_point_y)
    if not np.isfinite([*focal, *center]).all() or not all(0.01 <= f <= _MAX_FOCAL_PX for f in focal):
        raise InputError(
            f"focal lengths {focal} or principal point {center} are not those of a lens",
            remedy="Send pixels, focal lengths above 0.",
        )
    if np.abs(center).max() > _MAX_FOCAL_PX:
        raise InputError(f"the principal point {center} is absurd", remedy="Send pixels.")
    radial = _read_coefficients(pinhole.radial_coeffs, 6, "radial")
    tangential = _read_coefficients(pinhole.tangential_coeffs, 2, "tangential")
    prism = _read_coefficients(pinhole.thin_prism_coeffs, 4, "thin prism")
    if any(radial[3:]) or any(prism):
        raise ConfigError(
            "the rational terms k4 to k6 and the thin prism s1 to s4 are not rendered",
            remedy="Send them as 0, with k1, k2, p1, p2 and k3 fitted to the lens.",
        )
    distortion = (radial[0], radial[1], tangential[0], tangential[1], radial[2])
    return Lens(
        fx_px=focal[0],
        fy_px=focal[1],
        cx_px=center[0],
        cy_px=center[1],
        width_px=width_px,
        height_px=height_px,
        distortion=distortion if any(distortion) else (),
    )


def _read_coefficients(values: Sequence[float], count: int, name: str) -> list[float]:
    # As many as `count`, 0 where the wire has fewer.
    if len(values) > count:
        raise InputError(f"a lens has at most {count} {name} coefficients, not {len(values)}", remedy="Send fewer.")
    if not np.isfinite(values).all() or max(map(abs, values), default=0.0) > MAX_COEFFICIENT:
        raise InputError(f"the {name} coefficients {list(values)} are not those of a lens", remedy="Send finite ones.")
    return [*values, *[0.0] * (count - len(values))]


def write_camera_spec(camera: CameraDescription) -> sensorsim_pb2.CameraSpec:
    """Writes a camera of the run for the wire.

    Args:
        camera: of the run's rig.

    Returns:
        Its lens at the working resolution, and its shutter.
    """
    lens = camera.lens
    k1, k2, p1, p2, k3 = lens.coefficients
    return sensorsim_pb2.CameraSpec(
        logical_id=camera.name,
        resolution_h=lens.height_px,
        resolution_w=lens.width_px,
        shutter_type=sensorsim_pb2.ROLLING_TOP_TO_BOTTOM if camera.readout_s else sensorsim_pb2.GLOBAL,
        opencv_pinhole_param=sensorsim_pb2.OpenCVPinholeCameraParam(
            principal_point_x=lens.cx_px,
            principal_point_y=lens.cy_px,
            focal_length_x=lens.fx_px,
            focal_length_y=lens.fy_px,
            # AlpaSim's configuration has all of them, and copies them one by one.
            radial_coeffs=[k1, k2, k3, 0.0, 0.0, 0.0],
            tangential_coeffs=[p1, p2],
            thin_prism_coeffs=[0.0, 0.0, 0.0, 0.0],
        ),
    )
