"""How cameras and image sizes are spelt on a command line."""

from __future__ import annotations

from robo_manip_baselines.errors import RequestError


def parse_cameras(cameras: tuple[str, ...]) -> tuple[str, ...]:
    """Return camera names; ``none`` stands for no camera at all, and commas may separate them."""
    names = tuple(name for part in cameras for name in part.split(",") if name)
    return () if names == ("none",) else names


def parse_image_size(size: str) -> tuple[int, int]:
    """Return (height, width) from ``HEIGHTxWIDTH``.

    Raises:
        RequestError: it is not of that form.
    """
    height, cross, width = size.lower().partition("x")
    if not (cross and height.isdecimal() and width.isdecimal()):
        raise RequestError(f"image size '{size}': must be HEIGHTxWIDTH, for example 480x640")
    return int(height), int(width)
