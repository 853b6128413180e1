"""SPZ and 4dgs files, written by the libraries of their makers; both are in the extra `interchange`."""

from __future__ import annotations

import contextlib
import ctypes
import io
import os
import sys
from collections.abc import Iterator, Sequence
from importlib import import_module
from typing import Any

import numpy as np

from pd4dgs_codec.errors import DataError
from pd4dgs_codec.interchange.ply import ply_bytes
from pd4dgs_codec.interchange.splats import SH_C0, Splats

#: Steps of a position in SPZ files and how far from 0 one can be, scene units: 24 bits, 12 of them behind the point.
SPZ_STEP, SPZ_REACH = 1 / 4096, 2048.0
#: Harmonics but the constant are bytes in 4dgs files, from -SH_SPAN to SH_SPAN.
SH_SPAN = 4.0


def library(name: str, what: str) -> Any:
    """A module of the extra; DataError that names it if it is not there."""
    try:
        return import_module(name)
    except ImportError:
        raise DataError(
            f"{what} need the package {name}, which is not installed: pip install 'pd4dgs-codec[interchange]'"
        ) from None


def spz_bytes(splats: Splats) -> bytes:
    """An SPZ 3 file. Raises DataError for Gaussians that its fixed point cannot hold."""
    reach = float(np.abs(splats.means).max(initial=0))
    if reach >= SPZ_REACH:
        raise DataError(
            f"a Gaussian lies {reach:.4g} units from 0, SPZ holds {SPZ_REACH:g} at most: --scale less than 1"
        )
    with quiet():
        result = library("gaussforge", "SPZ files").GaussForge().convert(ply_bytes(splats), "ply", "spz", spz_version=3)
    if "error" in result:
        raise DataError(f"gaussforge cannot write this SPZ file: {result['error']}")
    return bytes(result["data"])


def fourdgs_bytes(frames: Sequence[tuple[float, Splats, np.ndarray]], seconds: float) -> bytes:
    """A .4dgs file of frames (start in seconds, Gaussians, their slots int64 [N]), the first at 0, ascending, for
    `seconds` in all: each Gaussian shows during its frame and moves towards where the next frame has its slot."""
    fourdgs = library("fourdgs", ".4dgs files")
    starts = [start for start, _, _ in frames]
    ends = [*starts[1:], seconds]
    parts: dict[str, list[np.ndarray]] = {}
    for i, (start, splats, slots) in enumerate(frames):
        n, middle = len(slots), (start + ends[i]) / 2
        speed = np.zeros((n, 3), np.float32)
        if i + 1 < len(frames):
            _, later, later_slots = frames[i + 1]
            _, here, there = np.intersect1d(slots, later_slots, assume_unique=True, return_indices=True)
            speed[here] = (later.means[there] - splats.means[here]) / np.float32(ends[i] - start)
        rest = splats.sh[:, 1:].transpose(0, 2, 1).reshape(n, 3 * (splats.sh.shape[1] - 1))
        rgb = np.clip(splats.sh[:, 0] * np.float32(SH_C0) + np.float32(0.5), 0, 1)
        for name, values in {
            "positions": splats.means + speed * np.float32(middle - start),
            "scales": splats.scales,
            "rotations": splats.quats[:, [1, 2, 3, 0]],
            "colors": np.concatenate([rgb, splats.opacities[:, None]], axis=1),
            "motions": speed,
            "mu_t": np.full(n, middle, np.float32),
            "sigma_t": np.full(n, np.inf, np.float32),
            "win_lo": np.full(n, start),
            "win_hi": np.full(n, ends[i]),
            "sh": np.clip(np.rint((rest + SH_SPAN) * (255 / (2 * SH_SPAN))), 0, 255).astype(np.uint8),
        }.items():
            parts.setdefault(name, []).append(values)
    columns: dict[str, Any] = {name: np.concatenate(values) for name, values in parts.items()}
    degree = frames[0][1].degree
    if degree == 0:
        columns["sh"] = None
    stream = io.BytesIO()
    try:
        fourdgs.write(stream, fourdgs.GaussianSet(**columns, sh_degree=degree), seconds)
    except (fourdgs.FourdgsError, ValueError) as error:
        raise DataError(f"fourdgs cannot write this file: {error}") from None
    return stream.getvalue()


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """What libraries print, from C too, is dropped: what a caller must know comes back to it."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = [os.dup(stream) for stream in (1, 2)]
    with open(os.devnull, "w") as nowhere:
        try:
            for stream in (1, 2):
                os.dup2(nowhere.fileno(), stream)
            yield
        finally:
            with contextlib.suppress(TypeError):  # Windows finds no C library by this name
                ctypes.CDLL(None).fflush(None)  # else what C's stdio holds back comes out later
            for stream, old in zip((1, 2), kept, strict=True):
                os.dup2(old, stream)
                os.close(old)
