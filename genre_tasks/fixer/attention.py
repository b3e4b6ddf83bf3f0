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
        """Mixed tokens, same shape. Raises ``ValueError`` for a batch that is no multiple of ``views``."""
        batch, tokens, channels = hidden_states.shape
        if batch % views:
            raise ValueError(f"expected a batch that is a multiple of {views} views, got {batch}")
        stacked = hidden_states.reshape(batch // views, views * tokens, channels)
        return self.attend(attn, stacked, encoder_hidden_states, attention_mask, temb).reshape(batch, tokens, channels)


def remove_text_attention(unet: Any) -> None:
    """Takes the CLIP cross-attention layers out, in place: the fixer has no text (paper Sec. III-B)."""
    from diffusers.models.attention import BasicTransformerBlock

    for module in unet.modules():
        if isinstance(module, BasicTransformerBlock):
            module.attn2 = None  # type: ignore[assignment]
            module.norm2 = None  # type: ignore[assignment]


def mix_views(unet: Any) -> None:
    """Replaces every self-attention processor, in place; views are passed by ``cross_attention_kwargs``."""
    # a dictionary of its own: diffusers empties the one it is given
    unet.set_attn_processor({name: ViewMixingProcessor() for name in unet.attn_processors})
