"""A room with textured walls, seen by a camera that walks: ray casting in numpy, its poses known."""

from __future__ import annotations

import numpy as np

#: Of pictures, pixels, unless another size is asked for.
WIDTH, HEIGHT, FOCAL = 320, 240, 260.0


def texture(seed: int, size: int = 512) -> np.ndarray:
    """float32 [size, size, 3]: noise of several sizes, with corners that are found again; 80 pixels are a unit."""
    rng = np.random.default_rng(seed)
    total = np.zeros((size, size, 3), np.float32)
    for cell, weight in ((4, 1.0), (8, 1.0), (32, 1.0)):
        noise = rng.random((size // cell, size // cell, 3), dtype=np.float32)
        total += weight * noise.repeat(cell, 0).repeat(cell, 1)
    return total / 3 * 255


def pose(step: float) -> np.ndarray:
    """float64 [4, 4] world to camera; OpenCV axes. step 0..1 along a bow of 2 units before a wall 5 units away."""
    angle = 0.5 * (step - 0.5)
    center = np.array([4 * np.sin(angle), 0.3 * np.sin(6 * step), 5 - 5 * np.cos(angle)])
    ahead = np.array([0, 0, 5.0]) - center
    ahead /= np.linalg.norm(ahead)
    right = np.cross([0, 1, 0], ahead)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(ahead, right), ahead])
    view = np.eye(4)
    view[:3, :3], view[:3, 3] = rotation, -rotation @ center
    return view


def picture(
    view: np.ndarray,
    textures: list[np.ndarray],
    patch: float | None = None,
    size: tuple[int, int] = (WIDTH, HEIGHT),
    focal: float = FOCAL,
) -> np.ndarray:
    """uint8 [height, width, 3] of a wall, a floor, a box's front, and a square that stands at x = patch if given; size:
    (width, height)."""
    u, v = np.meshgrid(*(np.arange(side) + 0.5 - side / 2 for side in size))
    rays = np.stack([u / focal, v / focal, np.ones_like(u)], axis=-1) @ view[:3, :3]
    eye = -view[:3, :3].T @ view[:3, 3]
    # point, normal, two axes, half sizes
    planes = [
        ((0, 0, 6.0), (0, 0, 1.0), (1, 0, 0), (0, 1, 0), (50, 50)),
        ((0, 1.5, 5.0), (0, 1.0, 0), (1, 0, 0), (0, 0, 1), (50, 50)),
        ((-1, 0.5, 4.5), (0, 0, 1.0), (1, 0, 0), (0, 1, 0), (0.7, 1.0)),
    ]
    if patch is not None:
        planes.append(((patch, -0.2, 3.5), (0, 0, 1.0), (1, 0, 0), (0, 1, 0), (0.5, 0.5)))
    result = np.zeros(rays.shape, np.float32)
    nearest = np.full(u.shape, np.inf)
    for image, (point, normal, a, b, half) in zip(textures, planes, strict=False):
        facing = rays @ np.array(normal)
        depth = (np.array(point) - eye) @ np.array(normal) / np.where(np.abs(facing) < 1e-9, np.inf, facing)
        place = eye + depth[..., None] * rays - np.array(point)
        s, t = place @ np.array(a, float), place @ np.array(b, float)
        hit = (depth > 0.1) & (depth < nearest) & (np.abs(s) <= half[0]) & (np.abs(t) <= half[1])
        color, (fx, fy) = 0.0, ((80 * place) % 1 for place in (s, t))
        x, y = np.floor(80 * s).astype(int), np.floor(80 * t).astype(int)
        for i, j, share in ((0, 0, (1 - fx) * (1 - fy)), (1, 0, fx * (1 - fy)), (0, 1, (1 - fx) * fy), (1, 1, fx * fy)):
            color += image[(y + j) % len(image), (x + i) % len(image)] * share[..., None]
        result[hit], nearest[hit] = color[hit], depth[hit]
    return np.clip(result + 0.5, 0, 255).astype(np.uint8)


def walk(count: int, *, moves: bool = False) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """(pictures, poses) of so many frames; moves: a square crosses the view."""
    textures = [texture(seed) for seed in range(4)]
    steps = [i / (count - 1) for i in range(count)]
    views = [pose(step) for step in steps]
    patches = [-0.9 + 1.8 * step if moves else None for step in steps]
    return [picture(view, textures, patch) for view, patch in zip(views, patches, strict=True)], views
