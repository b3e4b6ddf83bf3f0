"""Colour spaces that a stage states for its Gaussians, and how each is read."""

from __future__ import annotations

from genre_tasks.exchange.linear_light import LINEAR_LOSS

SRGB = "srgb_rec709_scene"
"""What is written: the one name of OpenUSD for colours with sRGB's curve."""

# 3dgrut and fvdb-reality-capture write the second one, which OpenUSD itself does not know.
_SRGB_SPACES = (SRGB, "srgb_rec709_display")
_LINEAR_PREFIX = "lin_rec709"
_SHOWN_CHARACTERS = 40


def is_linear(space: str) -> bool:
    """Tells whether colours of a space are linear light with sRGB's primaries.

    Args:
        space: its name; empty where the stage states none.

    >>> is_linear("lin_rec709_scene"), is_linear("srgb_rec709_scene"), is_linear("")
    (True, False, False)
    """
    return space.startswith(_LINEAR_PREFIX)


def describe_color_losses(space: str, *, has_harmonics: bool) -> tuple[str, ...]:
    """Lists what the colours of a field lose when they are read as sRGB.

    Args:
        space: name of their space; empty where the stage states none, which is no loss.
        has_harmonics: whether they are spherical harmonics; else there is one colour for all directions.

    Returns:
        Sentences.

    >>> describe_color_losses("lin_ap1_scene", has_harmonics=True)
    ('Colours of the space lin_ap1_scene are not converted: they are read as sRGB.',)
    """
    if not space or space in _SRGB_SPACES:
        return ()
    if is_linear(space):
        # One colour is converted exactly.
        return (LINEAR_LOSS,) if has_harmonics else ()
    # The name is the file's own, and may hold anything.
    shown = "".join(letter for letter in space[:_SHOWN_CHARACTERS] if letter.isprintable())
    return (f"Colours of the space {shown} are not converted: they are read as sRGB.",)
