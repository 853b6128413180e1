"""Reads SOG files of version 2: a zip archive of WebP images without loss, a pixel per Gaussian, and their `meta.json`.

https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog
"""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from pd4dgs_codec.data.files import FREE_BYTES, INFLATES, whole_number
from pd4dgs_codec.errors import DataError, one_line, required

META = b"meta.json"
MODES = 252  #: the fourth byte of a rotation, less the place of its largest component
PALETTES = 64  #: in a row of their image
WEBP = b"RIFFWEBPVP8L"  #: the first 16 bytes of an image without loss but four, its size


def read_sog(path: Path, raw: bytes) -> dict[str, np.ndarray]:
    """Returns float32 arrays by the names of Splats. The images take at most FREE_BYTES, and INFLATES for each byte of
    the file. Raises DataError."""
    images = required("PIL.Image", "interchange", "SOG files")
    try:
        return _read(zipfile.ZipFile(io.BytesIO(raw)), FREE_BYTES + INFLATES * len(raw), images.open)
    except DataError as error:
        raise DataError(f"{path}: {error}") from None
    except Exception as error:  # zipfile, json, Pillow, and what damaged numbers lead to, raise many kinds
        raise DataError(f"{path}: is a damaged SOG file ({one_line(repr(error), 120)})") from None


@np.errstate(all="ignore")
def _read(archive: zipfile.ZipFile, left: int, opened: Any) -> dict[str, np.ndarray]:
    """Reads an archive whose members and images take at most `left` bytes. opened: Pillow's function."""

    def member(name: str) -> bytes:
        nonlocal left
        left -= archive.getinfo(name).file_size
        if left < 0:
            raise DataError(f"{one_line(name, 60)} unpacks to more bytes than expected in a file of this size")
        return archive.read(name)

    meta = json.loads(member(META.decode()))
    if meta.get("version") != 2:
        found = one_line(repr(meta.get("version")), 20)
        raise DataError(f"is a SOG file of version {found}, expected 2: convert it with splat-transform")
    count = whole_number(meta["count"], "meta.json: count", 1)

    def image(part: str, place: int = 0) -> np.ndarray:
        """Returns uint8 [height, width, 4]."""
        nonlocal left
        name = meta[part]["files"][place]
        data, size = member(name), 0
        if data[:4] + data[8:16] == WEBP:
            bits = int.from_bytes(data[21:25], "little")
            size = ((bits & 0x3FFF) + 1) * ((bits >> 14 & 0x3FFF) + 1)
        left -= 4 * size
        if not size or left < 0:
            raise DataError(f"{one_line(name, 60)}: expected WebP without loss, of no more pixels than fit this file")
        return np.asarray(opened(io.BytesIO(data), formats=["WEBP"]).convert("RGBA"))

    def rows(part: str, place: int = 0) -> np.ndarray:
        """Returns a pixel for each Gaussian, uint8 [count, 4]."""
        if len(found := image(part, place).reshape(-1, 4)) < count:
            raise DataError(f"{part} has {len(found):,} pixels, expected one for each of {count:,} Gaussians")
        return found[:count]

    codes = {part: np.array(meta[part]["codebook"], np.float32) for part in ("scales", "sh0", "shN") if part in meta}
    least, most = (np.array(meta["means"][name], np.float32) for name in ("mins", "maxs"))
    logs = rows("means")[:, :3] + rows("means", 1)[:, :3] * np.float32(256)
    logs = logs * ((most - least) / np.float32(65535)) + least
    base, packed = rows("sh0"), rows("quats")
    sh = [codes["sh0"][base[:, None, :3]]]
    if "shN" in meta:
        labels = rows("shN", 1).astype(np.int64)
        palettes = image("shN")[:, :, :3]
        palettes = palettes.reshape(-1, palettes.shape[1] // PALETTES, 3)
        sh.append(codes["shN"][palettes[labels[:, 0] + 256 * labels[:, 1]]])
    others = (packed[:, :3] / np.float32(255) - np.float32(0.5)) * np.float32(2**0.5)
    largest = np.sqrt(np.maximum(1 - np.square(others).sum(axis=1, keepdims=True), 0))
    quats = np.zeros((count, 4), np.float32)  # they stay 0 where the mode is unknown
    for place in range(4):
        own = packed[:, 3] == MODES + place
        quats[own] = np.insert(others[own], [place], largest[own], axis=1)
    means, scales = np.sign(logs) * np.expm1(np.abs(logs)), np.exp(codes["scales"][rows("scales")[:, :3]])
    opacities = base[:, 3] / np.float32(255)
    return {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "sh": np.concatenate(sh, axis=1)}
