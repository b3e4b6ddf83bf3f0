"""Scenes as other people's tools leave them: a PLY file in the layout of Inria's 3DGS, and the points of a garden."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from genre_tasks.exchange.activations import colors_to_sh_dc
from genre_tasks.exchange.types import SH_REST_COUNTS, SplatCloud
from genre_tasks.logs.types import Float32, Float64

GARDEN = Path(__file__).resolve().parents[3] / "shared/data/splats/test_garden.npz"
"""Points, colours and three cameras of a garden, without scales."""

needs_garden = pytest.mark.skipif(not GARDEN.exists(), reason="the garden's points are not beside the checkout")


@dataclass(frozen=True)
class ForeignScene:
    """Gaussians in the axes of COLMAP, with cameras.

    Attributes:
        cloud: N Gaussians.
        camera_SE3_scene: [V, 4, 4].
        intrinsics_px: [V, 3, 3].
        width_px: of the images.
        height_px: of the images.
    """

    cloud: SplatCloud
    camera_SE3_scene: Float64
    intrinsics_px: Float64
    width_px: int
    height_px: int


def make_garden(source: Path = GARDEN, sh_degree: int = 3, seed: int = 0) -> ForeignScene:
    """Gives the garden's points what they lack, as 3DGS starts from points: sizes by their three nearest neighbours.

    Rotations and faint harmonics are drawn by chance, so that a reader that mixes them up is found out.
    """
    data = np.load(source)
    means = data["means3d"].astype(np.float32)
    random = np.random.default_rng(seed)
    distances = cKDTree(means).query(means, k=4)[0][:, 1:]
    spacing = np.sqrt(np.square(distances).mean(1))
    # Lone points would hide the garden behind blots.
    spacing = spacing.clip(1e-4, 3 * np.median(spacing))
    cloud = SplatCloud(
        means=means,
        log_scales=np.log(spacing[:, None] * random.uniform(0.6, 1.1, (len(means), 3))).astype(np.float32),
        quats=random.normal(size=(len(means), 4)).astype(np.float32),
        logit_opacities=random.normal(2.0, 0.5, len(means)).astype(np.float32),
        sh_dc=colors_to_sh_dc(data["colors"] / 255),
        sh_rest=random.normal(0, 0.03, (len(means), SH_REST_COUNTS[sh_degree], 3)).astype(np.float32),
    )
    views = data["viewmats"].astype(np.float64)
    return ForeignScene(cloud, views, data["Ks"].astype(np.float64), int(data["width"]), int(data["height"]))


def write_inria_ply(path: Path, cloud: SplatCloud) -> None:
    """Writes a cloud as Inria's 3DGS does: with normals of zero, harmonics before opacity, no comments.

    By plain bytes, so that it shares no code with the format that is tested.
    """
    columns: list[tuple[str, Float32]] = [(name, cloud.means[:, k]) for k, name in enumerate("xyz")]
    columns += [(name, np.zeros(len(cloud), np.float32)) for name in ("nx", "ny", "nz")]
    columns += [(f"f_dc_{k}", cloud.sh_dc[:, k]) for k in range(3)]
    count = cloud.sh_rest.shape[1]
    columns += [(f"f_rest_{c * count + k}", cloud.sh_rest[:, k, c]) for c in range(3) for k in range(count)]
    columns += [("opacity", cloud.logit_opacities)]
    columns += [(f"scale_{k}", cloud.log_scales[:, k]) for k in range(3)]
    columns += [(f"rot_{k}", cloud.quats[:, k]) for k in range(4)]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(cloud)}"]
    header += [f"property float {name}" for name, _ in columns]
    body = np.stack([values for _, values in columns], 1).astype("<f4")
    path.write_bytes("\n".join([*header, "end_header", ""]).encode() + body.tobytes())
