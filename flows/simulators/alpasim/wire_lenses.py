"""Lenses between the wire and GenRe's own: pinholes with Brown-Conrady distortion, f-theta and fisheye lenses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flows.simulators.alpasim import sensorsim_pb2
from flows.simulators.image_request import CameraDescription
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.logs.types import Lens
from genre_tasks.render.wide_lens import WideLens, fisheye_polynomial

MAX_COEFFICIENT = 1e6
_MAX_FOCAL_PX = 1e6
_MAX_SIDE_PX = 1 << 16
_MAX_DEGREE = 16
_IDENTITY = (1.0, 0.0, 0.0, 1.0)


def read_lens(spec: sensorsim_pb2.CameraSpec, width_px: int, height_px: int) -> Lens | WideLens:
    """Reads the lens of a request.

    Args:
        spec: of the wire. Its resolution is the image that the lens is stated for; without one it is the requested
            image.
        width_px: of the requested image.
        height_px: of the requested image.

    Returns:
        A pinhole for the requested image, or a wide lens for the image that it is stated for.

    Raises:
        InputError: a number is missing, not finite or absurd.
        ConfigError: the camera has what GenRe does not render.
    """
    model = spec.WhichOneof("camera_param")
    if model is None:
        raise InputError("the request has no camera model", remedy="Send opencv_pinhole_param.")
    if spec.WhichOneof("external_distortion") is not None:
        raise ConfigError("a windshield in front of the lens is not rendered", remedy="Leave it out.")
    stated = (spec.resolution_w or width_px, spec.resolution_h or height_px)
    if max(stated) > _MAX_SIDE_PX:
        raise InputError(f"a lens for {stated[0]} × {stated[1]} pixels is absurd", remedy="Send its real resolution.")
    if model == "ftheta_param":
        return _read_ftheta(spec.ftheta_param, *stated)
    if model == "opencv_fisheye_param":
        return _read_fisheye(spec.opencv_fisheye_param, *stated)
    return _read_pinhole(spec.opencv_pinhole_param, *stated).resized(width_px, height_px)


def _read_ftheta(ftheta: sensorsim_pb2.FthetaCameraParam, width_px: int, height_px: int) -> WideLens:
    forward = _read_coefficients(ftheta.angle_to_pixeldist_poly, _MAX_DEGREE, "f-theta")
    backward = _read_coefficients(ftheta.pixeldist_to_angle_poly, _MAX_DEGREE, "f-theta")
    # The reference is exact, and the other polynomial an approximation of its inverse.
    uses_forward = ftheta.reference_poly == sensorsim_pb2.FthetaCameraParam.ANGLE_TO_PIXELDIST or not any(backward)
    if not any(forward if uses_forward else backward):
        raise InputError("the f-theta lens has no polynomial", remedy="Send its reference polynomial.")
    linear = ftheta.linear_cde
    matrix = (linear.linear_c, linear.linear_d, linear.linear_e, 1.0) if ftheta.HasField("linear_cde") else _IDENTITY
    return WideLens(
        width_px=width_px,
        height_px=height_px,
        center_px=_read_center(ftheta.principal_point_x, ftheta.principal_point_y),
        matrix=_check_matrix(matrix),
        angle_to_radius=tuple(forward) if uses_forward else (),
        radius_to_angle=() if uses_forward else tuple(backward),
        max_angle_rad=_read_angle(ftheta.max_angle),
    )


def _read_fisheye(fisheye: sensorsim_pb2.OpenCVFisheyeCameraParam, width_px: int, height_px: int) -> WideLens:
    radial = _read_coefficients(fisheye.radial_coeffs, 4, "radial")
    return WideLens(
        width_px=width_px,
        height_px=height_px,
        center_px=_read_center(fisheye.principal_point_x, fisheye.principal_point_y),
        matrix=_check_matrix((fisheye.focal_length_x, 0.0, 0.0, fisheye.focal_length_y)),
        angle_to_radius=fisheye_polynomial(radial),
        max_angle_rad=_read_angle(fisheye.max_angle),
    )


def _read_center(x: float, y: float) -> tuple[float, float]:
    if not np.isfinite([x, y]).all() or max(abs(x), abs(y)) > _MAX_FOCAL_PX:
        raise InputError(f"the principal point {x:g}, {y:g} is absurd", remedy="Send pixels.")
    return x, y


def _check_matrix(matrix: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    if not np.isfinite(matrix).all() or max(map(abs, matrix)) > _MAX_FOCAL_PX:
        raise InputError(f"the lens's scales {list(matrix)} are absurd", remedy="Send finite numbers.")
    return matrix


def _read_angle(angle_rad: float) -> float:
    # 0 is what a message has where nothing is stated.
    if not 0 <= angle_rad <= 2 * np.pi:
        raise InputError(f"a largest angle of {angle_rad:g} is none", remedy="Send radians, or nothing.")
    return angle_rad


def _read_pinhole(pinhole: sensorsim_pb2.OpenCVPinholeCameraParam, width_px: int, height_px: int) -> Lens:
    focal = (pinhole.focal_length_x, pinhole.focal_length_y)
    center = _read_center(pinhole.principal_point_x, pinhole.principal_point_y)
    # Compared this way round, so that NaN fails too.
    if not all(0.01 <= f <= _MAX_FOCAL_PX for f in focal):
        raise InputError(f"focal lengths of {focal[0]:g} and {focal[1]:g} are no lens's", remedy="Send pixels above 0.")
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
