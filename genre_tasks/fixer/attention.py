"""Condition-mixing self-attention: the views of one sample share their tokens (paper Sec. III-B; Wonder3D, Difix3D)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from torch import Tensor

if TYPE_CHECKING:
    from diffusers.models.attention_processor import Attention


class ViewMixingProcessor:
    """Self-attention over the tokens of all views of a sample.

    The batch holds ``views`` consecutive entries per sample; their tokens are concatenated, attended to by diffusers'
    own processor, and the layout is restored. With ``views=1`` this is that processor exactly.
    """

    def __init__(self) -> None:
        """Wraps diffusers' processor."""
        from diffusers.models.attention_processor import AttnProcessor2_0

        self.attend = AttnProcessor2_0()

    def __call__(
        self,
        attn: Attention,
        hidden_states: Tensor,  # [B · views, tokens, channels]
        encoder_hidden_states: Tensor | None = None,
        attention_mask: Tensor | None = None,
        temb: Tensor | None = None,
        views: int = 1,
    ) -> Tensor:
        """Mixes the tokens of each sample's views, as diffusers calls its attention processors.

        Args:
            attn: the attention layer with its weights.
            hidden_states: tokens of B samples, whose views follow one another.
            encoder_hidden_states: tokens of a condition, if any.
            attention_mask: passed on to diffusers' processor.
            temb: passed on to diffusers' processor.
            views: number of views per sample.

        Returns:
            The mixed tokens, of the same shape.

        Raises:
            ValueError: the batch is no multiple of ``views``.
        """
        # Attention has no weights per token, so that joining the views along the token axis is all that mixing takes.
        batch, tokens, channels = hidden_states.shape
        if batch % views:
            raise ValueError(f"expected a batch that is a multiple of {views} views, got {batch}")
        stacked = hidden_states.reshape(batch // views, views * tokens, channels)
        return self.attend(attn, stacked, encoder_hidden_states, attention_mask, temb).reshape(batch, tokens, channels)


def remove_text_attention(unet: Any) -> None:
    """Takes the CLIP cross-attention layers out of a UNet: the fixer has no text (paper Sec. III-B).

    Args:
        unet: a ``UNet2DConditionModel``, changed in place.
    """
    from diffusers.models.attention import BasicTransformerBlock

    # diffusers' blocks skip a layer that is None, so that neither their code nor the other weights change.
    for module in unet.modules():
        if isinstance(module, BasicTransformerBlock):
            module.attn2 = None  # type: ignore[assignment]
            module.norm2 = None  # type: ignore[assignment]


def mix_views(unet: Any) -> None:
    """Replaces every self-attention processor of a UNet by a :class:`ViewMixingProcessor`.

    Args:
        unet: a ``UNet2DConditionModel``, changed in place; ``cross_attention_kwargs`` then take the number of views.
    """
    # A new dictionary for each call: diffusers empties the one that it receives.
    unet.set_attn_processor({name: ViewMixingProcessor() for name in unet.attn_processors})
