"""Pictures inside pages: figures in 256 colours, a third of the bytes, and narrower where that is enough."""

from functools import cache
from io import BytesIO

import numpy as np

GREYS, SHADES = 140, 100  # of images and text, and of the displacement
#: The figure's lines, and how they blend with white (255) or black (0) at their edges.
LINES = ((255, 210, 31), (11, 98, 168), (209, 65, 12), (255, 48, 48))
BLENDS = ((1.0, 255), (0.7, 255), (0.4, 255), (0.6, 0))


def reduced(png: bytes, width: int | None = None) -> bytes:
    """A picture of a run as a PNG of 256 colours, at most `width` pixels wide."""
    from PIL import Image

    picture = Image.open(BytesIO(png)).convert("RGB")
    if width is not None and width < picture.width:
        picture = picture.resize((width, round(picture.height * width / picture.width)), Image.Resampling.LANCZOS)
    holder = Image.new("P", (1, 1))
    holder.putpalette(_colours())
    small = BytesIO()
    picture.quantize(palette=holder, dither=Image.Dither.NONE).save(small, format="PNG", compress_level=6)
    return small.getvalue()


@cache
def _colours() -> bytes:
    """256 colours: greys, those of the displacement, and those of the lines."""
    from matplotlib import colormaps

    greys = np.linspace(0, 255, GREYS)[:, None].repeat(3, axis=1)
    shades = 255 * colormaps["viridis"](np.linspace(0, 1, SHADES))[:, :3]
    lines = [part * np.array(line) + (1 - part) * ground for line in LINES for part, ground in BLENDS]
    return np.concatenate([greys, shades, lines]).round().astype(np.uint8).tobytes()
