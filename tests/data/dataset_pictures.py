"""Poses and pictures the dataset tests are made of."""

import numpy as np


def pose(angle: float = 0.0, distance: float = 4.0) -> list:
    """OpenGL camera-to-world of a camera that looks at the origin from `distance` away, in the x-z plane."""
    c, s = np.cos(angle), np.sin(angle)
    return [[c, 0, s, distance * s], [0, 1, 0, 0], [-s, 0, c, distance * c], [0, 0, 0, 1]]


def gradient(w: int, h: int, shift: int = 0) -> np.ndarray:
    """A picture in which every pixel differs."""
    y, x = np.mgrid[:h, :w]
    return np.stack([x * 7 + shift, y * 11, x * 3 + y * 5], axis=2).astype(np.uint8)
