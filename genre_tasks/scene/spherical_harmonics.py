"""Colour that depends on where it is seen from: real spherical harmonics (Kerbl et al. 2023, Sec. 4).

A Gaussian's colour, seen along the unit direction d from the camera's centre to its mean, is max(c + Σ h_k Y_k(d), 0).
Signs and order are those of 3DGS and gsplat, without the constant term, which is the colour c itself. Coefficients h of
an actor's Gaussians are in its box frame, as its means are: seen from the camera's centre in that frame they turn with
it.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from genre_tasks.logs.types import Float64
from genre_tasks.scene.graph import DEFAULT_SH_DEGREE, FIRST_ACTOR, SH_COUNTS, SceneGraph

NEAREST_M = 0.01
"""Nothing nearer is drawn; down to zero distance the direction's length falls below 1, and all stays finite."""

# The normalisation of each real harmonic: √(3 / 4π), then those of degree 2 and 3 in the order in which they are used.
_C1 = 0.4886025119029199
_C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
_C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)


def with_zero_spherical_harmonics(scene: SceneGraph, degree: int = DEFAULT_SH_DEGREE) -> SceneGraph:
    """Gives a scene spherical harmonics to start an optimisation from, all zero.

    Args:
        scene: returned as it is if it has some already.
        degree: 1, 2 or 3.
    """
    if scene.spherical_harmonics is not None:
        return scene
    return scene.with_spherical_harmonics(scene.gaussians.means.new_zeros(len(scene), SH_COUNTS[degree], 3))


def evaluate_sh_basis(direction: Tensor, count: int) -> list[Tensor]:
    """Evaluates the real spherical harmonics Y_k, without the constant one, as polynomials.

    Args:
        direction: [..., 3] unit vectors.
        count: how many: 3, 8 or 15, for degree 1, 2 or 3.

    Returns:
        ``count`` tensors [...].

    Raises:
        ValueError: another count.

    >>> y = evaluate_sh_basis(torch.tensor([0.0, 0.0, 1.0]), 3)
    >>> [round(float(value), 4) for value in y]
    [-0.0, 0.4886, -0.0]
    """
    if count not in SH_COUNTS.values():
        raise ValueError(f"expected {', '.join(map(str, SH_COUNTS.values()))} harmonics, got {count}")
    x, y, z = direction.unbind(-1)
    out = [-_C1 * y, _C1 * z, -_C1 * x]
    if count > 3:
        a, b, c = _C2
        xx = x * x
        yy = y * y
        zz = z * z
        out += [a * (x * y), -a * (y * z), b * (2 * zz - xx - yy), -a * (x * z), c * (xx - yy)]
    if count > 8:
        a, b, c, e, f = _C3
        out += [-a * (y * (3 * xx - yy)), b * (x * y * z), -c * (y * (4 * zz - xx - yy))]
        out += [e * (z * (2 * zz - 3 * xx - 3 * yy)), -c * (x * (4 * zz - xx - yy))]
        out += [f * (z * (xx - yy)), -a * (x * (xx - 3 * yy))]
    return out


def evaluate_sh_colors(
    camera_centers: Tensor,  # [N, 3] or [3] metres
    means: Tensor,  # [N, 3] metres, in the same frame
    colors: Tensor,  # [N, 3]
    spherical_harmonics: Tensor,  # [N, K, 3]
) -> Tensor:
    """Computes the colours of Gaussians as a camera sees them; differentiable in the Gaussians.

    Args:
        camera_centers: [N, 3], or [3] for all, metres: the camera's centre in each Gaussian's own frame.
        means: [N, 3] metres, in that frame.
        colors: [N, 3] the constant terms.
        spherical_harmonics: [N, K, 3] coefficients.

    Returns:
        Colours [N, 3], at least 0. Gaussians that are not finite get NaN, which no renderer draws, and no gradient.

    >>> evaluate_sh_colors(torch.zeros(3), torch.ones(1, 3), torch.full((1, 3), 0.5), torch.zeros(1, 3, 3)).tolist()
    [[0.5, 0.5, 0.5]]
    """
    finite = torch.isfinite(means).all(1) & torch.isfinite(spherical_harmonics).flatten(1).all(1)
    # Replaced before any arithmetic: a NaN's gradient would be NaN, even where the result is not used.
    means = torch.where(finite[:, None], means, torch.zeros_like(means))
    spherical_harmonics = torch.where(finite[:, None, None], spherical_harmonics, torch.zeros_like(spherical_harmonics))
    offset = means - camera_centers
    x, y, z = offset.unbind(1)
    # Clamped before the root, whose slope at 0 has no end.
    distance = (x * x + y * y + z * z).clamp_min(NEAREST_M**2).sqrt()
    out = colors
    for k, value in enumerate(evaluate_sh_basis(offset / distance[:, None], spherical_harmonics.shape[1])):
        out = out + value[:, None] * spherical_harmonics[:, k]
    return torch.where(finite[:, None], out.clamp_min(0), torch.full_like(out, torch.nan))


def evaluate_sh_colors_by_view(scene: SceneGraph, frames: Sequence[float], centres: Float64) -> Tensor:
    """Computes what several views see of a scene with spherical harmonics, in plain torch: the kernel's oracle.

    Args:
        scene: with spherical harmonics.
        frames: [V] log frame of each view.
        centres: [V, 3] camera centres in metres, chunk coordinates.

    Returns:
        Colours [V, S + F · M, 3], laid out as by ``SceneGraph.gaussians_at_frames``. A view's colours of actors at
        other views' frames are 0: it does not show them.

    Raises:
        ValueError: the scene has no spherical harmonics.
    """
    g = scene.gaussians
    spherical_harmonics = scene.spherical_harmonics
    if spherical_harmonics is None:
        raise ValueError("expected a scene with harmonics, got one without")
    distinct = list(dict.fromkeys(frames))
    moves = scene.nodes >= FIRST_ACTOR if scene.actors else torch.zeros_like(scene.nodes, dtype=torch.bool)
    # Stable, so that both parts keep the order of the Gaussians.
    order = torch.argsort(moves.to(torch.uint8), stable=True)
    moving = int(moves.sum())
    still = len(scene) - moving
    # Without actors that move there is nothing to look up; the clamp keeps the index valid then.
    owner = (scene.nodes[order][still:] - FIRST_ACTOR).clamp_min(0)
    parts = [t.index_select(0, order) if moving else t for t in (g.means, g.colors, spherical_harmonics)]
    rotation, translation, _ = scene.actor_poses(frames)
    out = []
    for v, frame in enumerate(frames):
        centre = torch.as_tensor(centres[v]).to(g.means)
        in_boxes = ((centres[v] - translation[v])[:, None] @ rotation[v])[:, 0]  # Rᵀ (centre − t)
        in_own_box = torch.as_tensor(in_boxes).to(g.means)[owner].view(-1, 3)
        colors = evaluate_sh_colors(torch.cat([centre.expand(still, 3), in_own_box]), *parts)
        if not moving:
            out.append(colors)
            continue
        before = distinct.index(frame) * moving
        after = (len(distinct) - 1) * moving - before
        other_frames = [colors.new_zeros(n, 3) for n in (before, after)]
        out.append(torch.cat([colors[:still], other_frames[0], colors[still:], other_frames[1]]))
    return torch.stack(out)
