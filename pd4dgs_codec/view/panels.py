"""Pictures next to each other under captions: people would rather look than read."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

GAP = 4
PAPER, INK = (255, 255, 255), (30, 30, 30)


def side_by_side(images: Sequence[np.ndarray], captions: Sequence[str]) -> np.ndarray:
    """uint8 [h, w, 3] images of one height, left to right on white, each under its caption; the result is uint8 too."""
    from PIL import Image, ImageDraw, ImageFont

    height = images[0].shape[0]
    size = int(np.clip(height / 14, 10, 28))
    font = ImageFont.load_default(size)
    band = size + 6
    width = sum(image.shape[1] for image in images) + GAP * (len(images) - 1)
    sheet = Image.new("RGB", (width, height + band), PAPER)
    draw = ImageDraw.Draw(sheet)
    left = 0
    for image, caption in zip(images, captions, strict=True):
        text = _fitting(caption, image.shape[1] - 4, lambda line: draw.textlength(line, font=font))
        draw.text((left + 3, 1), text, fill=INK, font=font)
        sheet.paste(Image.fromarray(image), (left, band))
        left += image.shape[1] + GAP
    return np.asarray(sheet)


def _fitting(text: str, width: int, length) -> str:
    """As much of the text's beginning as fits, whole words first."""
    while length(text) > width and text:
        text = text.rsplit(" ", 1)[0] if " " in text else text[:-1]
    return text


def level_caption(level: int, cumulative_bytes: int | None) -> str:
    """ "level 1, 312 kB": what the viewer sees and what it cost."""
    if cumulative_bytes is None:
        return f"level {level}"
    size = f"{cumulative_bytes / 1e6:.2f} MB" if cumulative_bytes >= 1e6 else f"{cumulative_bytes / 1e3:.0f} kB"
    return f"level {level}, {size}"
