"""Levels side by side under captions that say what each cost: people would rather look than read."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from pd4dgs_codec.quality.frames import Frame
from pd4dgs_codec.quality.image import to_uint8
from pd4dgs_codec.quality.levels import Level

GAP = 4
PAPER, INK = (255, 255, 255), (30, 30, 30)


class Panel(NamedTuple):
    """A picture, uint8 [h, w, 3], what is written above it, and the milliseconds that drawing it took."""

    picture: np.ndarray
    caption: str
    milliseconds: float = 0.0


def level_panels(levels: Sequence[Level], frame: Frame) -> list[Panel]:
    """What each level shows of the frame."""
    panels = []
    for level in levels:
        image, milliseconds = level.timed_picture(frame.camera, frame.time)
        panels.append(Panel(to_uint8(image), level_caption(level.level, level.cumulative_bytes), milliseconds))
    return panels


def side_by_side(panels: Sequence[Panel]) -> np.ndarray:
    """uint8 [h, w, 3]: panels of one height, left to right on white, each under its caption."""
    from PIL import Image, ImageDraw, ImageFont

    height = panels[0].picture.shape[0]
    size = int(np.clip(height / 14, 10, 28))
    font = ImageFont.load_default(size)
    band = size + 6
    width = sum(panel.picture.shape[1] for panel in panels) + GAP * (len(panels) - 1)
    sheet = Image.new("RGB", (width, height + band), PAPER)
    draw = ImageDraw.Draw(sheet)
    left = 0
    for panel in panels:
        width = panel.picture.shape[1]
        text = _fitting(panel.caption, width - 4, lambda line: draw.textlength(line, font=font))
        draw.text((left + 3, 1), text, fill=INK, font=font)
        sheet.paste(Image.fromarray(panel.picture), (left, band))
        left += width + GAP
    return np.asarray(sheet)


def _fitting(text: str, width: int, length: Callable[[str], float]) -> str:
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
