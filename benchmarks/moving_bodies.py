"""The bodies of a synthetic scene that move: which pixels show them, and the pictures without them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pd4dgs_codec.data.bodies import Eye, place
from pd4dgs_codec.data.synthetic import grid, parse, render
from pd4dgs_codec.data.view import View


@dataclass(frozen=True, eq=False)
class Mover:
    """A body that moves, as V views of a scene show it.

    shown: bool [V, H, W], valid pixels whose centre shows it. without: uint8 [V, H, W, 3], the pictures without it.
    radius: of a disc with as many pixels as it has on average where it is shown; 0 if it never is. step: what its
    centre moves at most between neighbouring instants, in its own sizes (the mean one of its three).
    """

    shown: np.ndarray
    without: np.ndarray
    radius: float
    step: float


def movers(source: str, views: Sequence[View]) -> list[Mover]:
    """All bodies of a synthetic scene that move, in some of its views."""
    take = parse(source)
    scene, lens = take.bodies(), take.lens
    cameras = [(view.viewmat.astype(np.float64), take.clock(view.time)) for view in views]
    hits = [Eye(place(scene, t), viewmat).first_hits(*grid(lens))[1] for viewmat, t in cameras]
    valid = [True if view.mask is None else view.mask for view in views]
    found = []
    for k, body in enumerate(scene):
        A, c = (np.stack(parts) for parts in zip(*map(body.pose, map(take.clock, take.times)), strict=True))
        if np.ptp(A, axis=0).max() + np.ptp(c, axis=0).max() == 0:
            continue
        others = scene[:k] + scene[k + 1 :]
        shown = np.stack([(index == k) & mask for index, mask in zip(hits, valid, strict=True)])
        without = np.stack([render(others, viewmat, t, lens, take.stage.background) for viewmat, t in cameras])
        areas, size = shown.sum(axis=(1, 2)), 2 * np.cbrt(abs(np.linalg.det(A)))
        radius = float(np.sqrt(areas[areas > 0].mean() / np.pi)) if areas.any() else 0.0
        step = float((np.linalg.norm(np.diff(c, axis=0), axis=1) / size[1:]).max())
        found.append(Mover(shown, without, radius, step))
    return found
