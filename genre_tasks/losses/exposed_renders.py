"""Renders as their images' exposures would show them, and the way back to the scene's own colours.

The render gets the gain, rather than the image losing it: what is clipped in an image cannot be restored. That goes
for fixed novel views as well, which have no gain and yet end at 1, where the scene's own colours go on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from genre_tasks.effects.color_gain import apply_gain, gain_factor
from genre_tasks.losses.targets import Target
from genre_tasks.threads import map_single_threaded

CLIPPED = 254.0 / 255
"""Pixels of an image from here on are taken to be clipped: resizing leaves few of them at exactly 1."""


@dataclass(frozen=True)
class ExposedRenders:
    """Renders of V views, at the exposures of the images that they are compared with.

    Attributes:
        targets: V images to compare with.
        color: [V, H, W, 3] sRGB, not clamped; the images themselves on the ego vehicle.
        gains: V log gains [3], ``None`` for an image without one; empty where no image has a gain.
        beyond_clipped: V masks [H, W, 3] of what is brighter than a clipped image; empty where no image has a gain.
    """

    targets: tuple[Target, ...]
    color: Tensor
    gains: tuple[Tensor | None, ...]
    beyond_clipped: tuple[Tensor, ...]

    @staticmethod
    def from_renders(color: Tensor, targets: Sequence[Target]) -> ExposedRenders:
        """Gives each render its image's gain.

        Where an image is clipped, a brighter render is taken to agree with it: a clipped pixel tells that the scene is
        at least so bright. Pulled down to 1 by a bright image, a sky would be too dark in those of a shorter exposure.

        Args:
            color: [V, H, W, 3] in the scene's own colours, sRGB; left as it is, and without its graph.
            targets: V targets.

        Returns:
            ExposedRenders: ``color`` itself where no target has a gain or an ego mask.
        """
        color = color.detach()
        # Most synthetic logs have no gain at all: nothing is to be done for them here, nor on the way back.
        if all(target.log_gain is None for target in targets):
            return ExposedRenders(tuple(targets), _show_images_on_ego(color, targets), (), ())
        gains = tuple(None if target.log_gain is None else color.new_tensor(target.log_gain) for target in targets)
        exposed = torch.empty_like(color)

        def expose(i: int) -> Tensor:
            gain = gains[i]
            image = targets[i].image.pixels
            shown = color[i] if gain is None else apply_gain(color[i], gain)
            beyond = (image >= CLIPPED) & (shown > image)
            torch.where(beyond, image, shown, out=exposed[i])
            return beyond

        beyond_clipped = tuple(map_single_threaded(expose, range(len(targets))))
        return ExposedRenders(tuple(targets), _show_images_on_ego(exposed, targets), gains, beyond_clipped)

    def undo_in_gradient(self, by_color: Tensor) -> None:
        """Turns the gradient at the exposed renders into that at the scene's own colours, in place.

        Args:
            by_color: [V, H, W, 3]; 0 afterwards where a render is beyond a clipped image.
        """

        def undo(i: int) -> None:
            gain = self.gains[i]
            if gain is not None:
                by_color[i].mul_(gain_factor(gain))
            by_color[i].masked_fill_(self.beyond_clipped[i], 0.0)

        map_single_threaded(undo, range(len(self.gains)))

    def undo_in_difference(self, difference: Tensor) -> None:
        """Brings differences of images and exposed renders back to the scene's own colours, in place.

        Args:
            difference: [V, H, W, 3]. The offset of a gain cancels in it: only its factor is undone.
        """

        def undo(i: int) -> None:
            gain = self.gains[i]
            if gain is not None:
                difference[i].div_(gain_factor(gain))

        map_single_threaded(undo, range(len(self.gains)))


def _show_images_on_ego(color: Tensor, targets: Sequence[Target]) -> Tensor:
    """The renders [V, H, W, 3] with their images where these show the ego vehicle; the same tensor where none does."""
    if all(target.ego_mask is None for target in targets):
        return color
    # A masked gradient alone would not do: SSIM's windows and perceptual features reach over the mask's edge.
    shown = color.clone()
    for i, target in enumerate(targets):
        if target.ego_mask is not None:
            shown[i][target.ego_mask] = target.image.pixels[target.ego_mask]
    return shown
