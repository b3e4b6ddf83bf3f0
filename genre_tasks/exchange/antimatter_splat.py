"""Files of 32 bytes a Gaussian, ``.splat``, as antimatter15's viewer reads them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from genre_tasks.errors import InputError
from genre_tasks.exchange.activations import (
    colors_to_sh_dc,
    logits_to_opacities,
    logs_to_scales,
    opacities_to_logits,
    scales_to_logs,
    sh_dc_to_colors,
)
from genre_tasks.exchange.checks import check_finite_cloud, check_finite_values, measure_file
from genre_tasks.exchange.one_cloud import describe_one_cloud_losses, make_resting_scene, take_one_cloud
from genre_tasks.exchange.types import ExchangeScene, SplatCloud
from genre_tasks.logs.types import Float32, Float64

_ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])
_QUANTISED = "Colours and opacities are rounded to 256 steps, and rotations to about half a degree."


class AntimatterSplatFormat:
    """The format; see :class:`genre_tasks.exchange.types.ExchangeFormat`. It has no header and no harmonics."""

    name = "splat"
    suffixes = (".splat",)
    can_write = True
    carries_nodes = False

    def read(self, path: Path) -> ExchangeScene:
        """Reads a file.

        Args:
            path: of the file.

        Returns:
            A scene of one node that rests, with unit quaternions.

        Raises:
            InputError: the file's size is no multiple of 32 bytes, a value is not finite, or a scale is not above 0.
        """
        size = measure_file(path)
        if size % _ROW.itemsize:
            problem = f"a .splat file has {_ROW.itemsize} bytes a Gaussian, and this one has {size} bytes"
            raise InputError(problem, remedy="Export the file again, or give one that is complete.", file=path)
        rows = np.fromfile(path, _ROW)
        check_finite_values(path, "means", rows["means"])
        check_finite_values(path, "scales", rows["scales"])
        rgba = rows["rgba"].astype(np.float64) / 255
        cloud = SplatCloud(
            means=rows["means"].astype(np.float32),
            log_scales=scales_to_logs(path, rows["scales"]),
            quats=_unpack_quats(rows["quats"].astype(np.float64)),
            logit_opacities=opacities_to_logits(rgba[:, 3]),
            sh_dc=colors_to_sh_dc(rgba[:, :3]),
            sh_rest=np.zeros((len(rows), 0, 3), np.float32),
        )
        return make_resting_scene(cloud)

    def write(self, path: Path, scene: ExchangeScene) -> None:
        """Writes a file; :meth:`describe_losses` says what is rounded and cut.

        Args:
            path: of the file; an existing one is replaced.
            scene: with one resting node.

        Raises:
            InputError: the scene has several nodes, holds what is not finite, or scales that float32 does not hold.
        """
        cloud = take_one_cloud(path, scene)
        check_finite_cloud(path, cloud)
        rows = np.empty(len(cloud), _ROW)
        rows["means"] = cloud.means
        rows["scales"] = logs_to_scales(path, cloud.log_scales)
        rows["rgba"][:, :3] = np.round(np.clip(sh_dc_to_colors(cloud.sh_dc), 0, 1) * 255)
        rows["rgba"][:, 3] = np.round(logits_to_opacities(cloud.logit_opacities) * 255)
        rows["quats"] = _pack_quats(cloud.quats)
        # Not by `tofile`, whose errors do not say that the disk is full.
        path.write_bytes(rows.data)

    def describe_losses(self, scene: ExchangeScene) -> tuple[str, ...]:
        """Lists what of a scene the format cannot carry: harmonics, anti-aliasing, fine steps, parts and motion.

        Args:
            scene: to be written.
        """
        clouds = [node.cloud for node in scene.nodes]
        losses = [*describe_one_cloud_losses(scene), _QUANTISED]
        degree = max((cloud.sh_degree for cloud in clouds), default=0)
        if degree:
            losses.append(f"Spherical harmonics of degree {degree} are left out: colours are the same from all sides.")
        outside = sum(int(_is_out_of_range(cloud).sum()) for cloud in clouds)
        if outside:
            total = sum(len(cloud) for cloud in clouds)
            losses.append(f"The colours of {outside} of {total} Gaussians are cut to the range from 0 to 1.")
        if any(cloud.antialiased for cloud in clouds):
            losses.append("That the scene was made with anti-aliasing is left out: without it thin parts look thicker.")
        return tuple(losses)


def _is_out_of_range(cloud: SplatCloud) -> NDArray[np.bool_]:
    colors = sh_dc_to_colors(cloud.sh_dc)
    # Rounding brings back what is less than half a step outside.
    return np.asarray(((colors < -0.5 / 255) | (colors > 1 + 0.5 / 255)).any(1))


def _pack_quats(quats: Float32) -> Float64:
    length = np.linalg.norm(quats.astype(np.float64), axis=1, keepdims=True)
    # A quaternion without direction stays one.
    steps = np.round(quats / np.where(length > 0, length, 1) * 128)
    # 128 steps up do not fit, 128 down do; a quaternion and its negative are the same rotation.
    flipped = np.where((steps > 127).any(1, keepdims=True), -steps, steps)
    return np.asarray(flipped + 128)


def _unpack_quats(packed: Float64) -> Float32:
    quats = (packed - 128) / 128
    length = np.linalg.norm(quats, axis=1, keepdims=True)
    return np.asarray(quats / np.where(length > 0, length, 1), np.float32)


SPLAT = AntimatterSplatFormat()
