"""Time and memory of every reader of strangers' files on its worst input known, as a Markdown table.

Each input is read in a process of its own; memory is the rise of its peak, after imports.

    python benchmarks/readers.py            # all rows, a minute
    python benchmarks/readers.py PNG        # those whose name holds a text
"""

from __future__ import annotations

import argparse
import gzip
import io
import json
import resource
import struct
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from common import ROOT, peak_bytes
from PIL import Image

from pd4dgs_codec import decode, segments
from pd4dgs_codec.archives import read_tensors
from pd4dgs_codec.batch.job import OPS, read_manifest
from pd4dgs_codec.data import colmap
from pd4dgs_codec.data.captures import _panoptic_points
from pd4dgs_codec.data.dataset import load
from pd4dgs_codec.data.files import image_info, read_image, read_mask, read_npy
from pd4dgs_codec.data.videos import open_video
from pd4dgs_codec.data.view import Lens, UnreadView, read_view
from pd4dgs_codec.errors import Pd4Error
from pd4dgs_codec.format import canonical
from pd4dgs_codec.format.container import read_preamble, write_chunk, write_preamble
from pd4dgs_codec.format.header import scene_id_of
from pd4dgs_codec.interchange import runs
from pd4dgs_codec.interchange.splats import fourdgs_bytes, read_splats
from pd4dgs_codec.interchange.teacher import read_model
from pd4dgs_codec.kinds.splats import Splats
from pd4dgs_codec.model import checkpoint
from pd4dgs_codec.quality.frames import write_mp4
from pd4dgs_codec.web.client import SceneClient
from pd4dgs_codec.web.package import library
from pd4dgs_codec.web.server import Server

MEGABYTE = 1 << 20
VECTORS = ROOT / "spec" / "vectors"


def archive(pickled: bytes, method: int = zipfile.ZIP_STORED, storage: bytes = b"", members: int = 1) -> bytes:
    """A file as torch writes it."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as made:
        made.writestr("a/data.pkl", b"\x80\x02" + pickled + b".")
        for i in range(members):
            made.writestr(f"a/data/{i}", storage)
    return stream.getvalue()


def text(value: str) -> bytes:
    """A text in a pickle."""
    return b"X" + len(value).to_bytes(4, "little") + value.encode()


def number(value: int) -> bytes:
    """A number of at most 15 bytes in a pickle."""
    return b"\x8a\x0f" + value.to_bytes(15, "little")


def checkpoint_with(training: bytes) -> bytes:
    """A checkpoint with this value of "training", and a digest that is found wrong once all of it is walked."""
    head = text("format") + text("pd4dgs-checkpoint") + text("version") + b"K\x01"
    return archive(b"}(" + head + text("training") + training + b"u")


def zipped_array(zeros: int) -> bytes:
    """An .npz of zeros, deflated."""
    stream = io.BytesIO()
    np.savez_compressed(stream, data=np.zeros(zeros // 8))
    return stream.getvalue()


def blank_png(width: int, height: int) -> bytes:
    """A picture of one colour."""
    stream = io.BytesIO()
    Image.new("1", (width, height)).save(stream, "png")
    return stream.getvalue()


def blank_tiff(width: int, height: int) -> bytes:
    """A TIFF file of one colour, deflated, in one strip."""
    stream = io.BytesIO()
    Image.new("RGB", (width, height)).save(stream, "tiff", compression="tiff_adobe_deflate", tiffinfo={278: height})
    return stream.getvalue()


def huge_tile(side: int) -> bytes:
    """A TIFF file of 16 x 16 pixels in a tile of side x side."""
    tags = {256: 16, 257: 16, 258: 8, 259: 5, 262: 1, 277: 1, 322: side, 323: side, 324: 8, 325: 64}
    rows = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags.items())
    return b"II*\0" + struct.pack("<IH", 8, len(tags)) + rows + bytes(64)


def many_scans(side: int) -> bytes:
    """A progressive JPEG of one grey with as many passes over its pixels as are read."""
    stream = io.BytesIO()
    Image.new("L", (side, side), 128).save(stream, "jpeg", progressive=True)
    raw = stream.getvalue()[:-2]
    return raw + (100 - raw.count(b"\xff\xda")) * raw[raw.rindex(b"\xff\xda") :] + b"\xff\xd9"


def blank_film(side: int, frames: int) -> bytes:
    """A video of one colour."""
    with tempfile.TemporaryDirectory() as folder:
        write_mp4((np.zeros((side, side, 3), np.uint8) for _ in range(frames)), Path(folder) / "x.mp4", 30)
        return (Path(folder) / "x.mp4").read_bytes()


def spz(size: int) -> bytes:
    """An SPZ file that says it has ten million Gaussians, all zero."""
    return gzip.compress(b"NGSP" + (2).to_bytes(4, "little") + (10_000_000).to_bytes(4, "little") + bytes(size))


def spz_count(zipped: bool) -> bytes:
    """An SPZ file that says it has ten million Gaussians, and holds none."""
    head = b"NGSP" + struct.pack("<IIBBBB", 3 if zipped else 4, 10_000_000, 0, 12, 0, 0 if zipped else 1)
    return gzip.compress(head) if zipped else head + struct.pack("<IIQQQ", 32, 0, 0, 9, 1 << 20) + bytes(9)


def splat(rows: int) -> bytes:
    """A .splat file of equal Gaussians."""
    return (np.ones(6, "<f4").tobytes() + bytes([9, 9, 9, 255, 255, 128, 128, 128])) * rows


def stretched(rows: int) -> bytes:
    """A checkpoint of gsplat whose tensors repeat one number."""
    stream = io.BytesIO()
    shapes = dict(means=(3,), quats=(4,), scales=(3,), opacities=(), sh0=(1, 3), shN=(0, 3))
    one = torch.ones(1)
    torch.save({"splats": {name: one.expand(rows, *shape) for name, shape in shapes.items()}}, stream)
    return stream.getvalue()


def compressed_ply(points: int) -> bytes:
    """A compressed PLY of so many Gaussians, all zero."""
    chunks = -(-points // 256)
    kinds = ("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b")
    bounds = [f"property float {end}_{name}" for names in kinds for end in ("min", "max") for name in names]
    packed = [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    head = ["ply", "format binary_little_endian 1.0", f"element chunk {chunks}", *bounds]
    lines = [*head, f"element vertex {points}", *packed, "end_header", ""]
    return "\n".join(lines).encode() + bytes(72 * chunks + 16 * points)


def equal_gaussians(count: int) -> bytes:
    """A .4dgs file of Gaussians that are all one."""
    ones = [np.ones((count, *shape), np.float32) for shape in ((3,), (4,), (3,), (), (1, 3))]
    return fourdgs_bytes([(0.0, Splats(*ones), np.arange(count))], 1.0)


def sog(side: int) -> bytes:
    """A SOG file of side x side equal Gaussians, whose images are of one colour."""
    picture, stream = io.BytesIO(), io.BytesIO()
    Image.new("RGBA", (side, side), (1, 2, 3, 252)).save(picture, "webp", lossless=True)
    meta = {
        "version": 2, "count": side**2, "means": {"mins": [0] * 3, "maxs": [1] * 3, "files": ["x", "x"]},
        "quats": {"files": ["x"]}, **{part: {"codebook": [0] * 256, "files": ["x"]} for part in ("scales", "sh0")},
    }  # fmt: skip
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as made:
        made.writestr("meta.json", json.dumps(meta))
        made.writestr("x", picture.getvalue())
    return stream.getvalue()


def splatv(rows: int) -> bytes:
    """A .splatv file of equal Gaussians, 64 bytes each."""
    camera = {"position": [0, 0, -4], "rotation": np.eye(3).tolist(), "fx": 60, "fy": 60, "width": 64, "height": 64}
    part = {"type": "splat", "size": 64 * rows, "texwidth": 4096, "texheight": 1, "cameras": [camera]}
    head = json.dumps([part]).encode()
    row = np.ones(3, "<f4").tobytes() + np.ones(26, "<f2").tobytes()
    return np.array([0x674B, len(head)], "<u4").tobytes() + head + row * rows


def npy(head: str) -> bytes:
    """A .npy file that says what it holds, and 8 bytes."""
    head = f"{head:<117}\n"
    return b"\x93NUMPY\1\0" + len(head).to_bytes(2, "little") + head.encode() + bytes(8)


def endless(size: int) -> bytes:
    """A file whose layer 0 has so many bytes, all of them zero, and a wrong checksum."""
    known = canonical.unpack(read_preamble((VECTORS / "valid" / "layers-0-1.pd4").read_bytes()).header)
    header = canonical.pack({**known, 1: [[0, size]]})
    return write_preamble(header) + write_chunk(0, 0, scene_id_of(header), bytes(size))[:-4] + bytes(4)


def read_scene(path: Path) -> None:
    """A .pd4 file."""
    decode(path.read_bytes())


def read_url(path: Path) -> None:
    """The same from a server, which is measured as well."""
    with Server(path.parent) as server, server.running(), SceneClient(f"{server.url}{path.name}") as client:
        list(client.scenes())


def read_import(path: Path) -> None:
    """A model as pd4dgs-import reads it."""
    read_tensors(path.read_bytes(), str(path))


def read_teacher(path: Path) -> None:
    """Gaussians over time, at one time."""
    read_model(str(path), 30).splats(0.5)


def read_colmap(path: Path) -> None:
    """COLMAP's points and images."""
    reader = (colmap._Text if path.suffix == ".txt" else colmap._Binary)(path)
    list(reader.points() if "points" in path.name else reader.images())


def read_picture(path: Path) -> None:
    """A picture."""
    read_image(path, image_info(path)[:2])


def read_distorted(path: Path) -> None:
    """A picture through a lens that distorts, at 1/64 of its size."""
    width, height, _ = image_info(path)
    lens = Lens(width, height, width, width, width / 2, height / 2, radial=(0.1, 0.0, 0.0))
    read_view(UnreadView("x", 0, None, np.eye(4), lens, path), 0.0, 64, None)


def read_film(path: Path) -> None:
    """Every frame of a video, one at a time."""
    for _ in open_video(path).pictures:
        pass


#: Name of the row -> (name of the file, its content, its reader).
CASES: dict[str, tuple[str, Callable[[], bytes], Callable[[Path], object]]] = {
    ".pd4: symbols, the file that takes most memory": (
        "x.pd4", (VECTORS / "worst-case" / "memory-0.pd4").read_bytes, read_scene
    ),
    ".pd4: symbols, the file that takes longest": (
        "x.pd4", (VECTORS / "worst-case" / "seconds-0.pd4").read_bytes, read_scene
    ),
    ".pd4 from a server: zeros": ("x.pd4", lambda: endless(64 * MEGABYTE), read_url),
    "checkpoint: empty dicts": ("m.pt", lambda: checkpoint_with(b"](" + b"}" * MEGABYTE + b"e"), checkpoint.load),
    "checkpoint: one tuple again and again": (
        "m.pt", lambda: checkpoint_with(b"((K\1K\1K\1tq\0](" + b"h\0" * (MEGABYTE // 2) + b"et"), checkpoint.load
    ),
    "checkpoint: lists in lists": ("m.pt", lambda: checkpoint_with(b"](" * 400_000 + b"e" * 400_000), checkpoint.load),
    "checkpoint: deflated": (
        "m.pt", lambda: archive(b"}", zipfile.ZIP_DEFLATED, bytes(256 * MEGABYTE)), checkpoint.load
    ),
    "checkpoint: keys of one hash": (
        "m.pt",
        lambda: checkpoint_with(b"}(" + b"".join(number(k * (2**61 - 1)) + b"N" for k in range(1, 99_000)) + b"u"),
        checkpoint.load,
    ),
    "model to import: modules": (
        "m.pt", lambda: archive(b"](c__torch__.a\nb\nq\0)\x81" + b"h\0)\x81" * (MEGABYTE // 4) + b"e"), read_import
    ),
    "model to import: members": ("m.pt", lambda: archive(b"}", members=20_000), read_import),
    "points (.npz): zeros": ("x.npz", lambda: zipped_array(512 * MEGABYTE), _panoptic_points),
    "points (.ply): as text": (
        "x.ply",
        lambda: b"ply\nformat ascii 1.0\nelement vertex 170000\n" + b"".join(b"property float %c\n" % c for c in b"xyz")
        + b"end_header\n" + b"0 0 0\n" * 170_000,
        read_splats,
    ),
    "Gaussians (.spz): zeros": ("x.spz", lambda: spz(256 * MEGABYTE), read_splats),
    "Gaussians (.spz): a count": ("x.spz", lambda: spz_count(zipped=True), read_splats),
    "Gaussians (.spz 4): a count": ("x.spz", lambda: spz_count(zipped=False), read_splats),
    "Gaussians (.splat)": ("x.splat", lambda: splat(MEGABYTE // 32), read_splats),
    "Gaussians (.ply): lines of a header": ("x.ply", lambda: b"ply\n" + b"\n" * MEGABYTE, read_splats),
    "Gaussians (.ply): elements": (
        "x.ply",
        lambda: b"ply\nformat ascii 1.0\n" + b"element a 1\n" * 5000 + b"element vertex 0\nend_header\n",
        read_splats,
    ),
    "Gaussians (gsplat): stride 0": ("ckpt.pt", lambda: stretched(50_000_000), read_splats),
    "Gaussians (.compressed.ply): zeros": ("x.compressed.ply", lambda: compressed_ply(MEGABYTE // 16), read_splats),
    "Gaussians (SOG): pictures of one colour": ("x.sog", lambda: sog(220), read_splats),
    "Gaussians (.splatv)": ("x.splatv", lambda: splatv(MEGABYTE // 64), read_teacher),
    "Gaussians (.4dgs): equal ones": ("x.4dgs", lambda: equal_gaussians(45_000), read_teacher),
    "Gaussians (.4dgs): too many equal ones": ("x.4dgs", lambda: equal_gaussians(300_000), read_teacher),
    "run of another trainer: cameras.json": (
        "cameras.json", lambda: b"[" + b"{}," * (MEGABYTE // 3) + b"{}]", runs.read_cameras
    ),
    "run of another trainer: cfg_args": (
        "cfg_args",
        lambda: b"no_dx=a" * (MEGABYTE // 7),
        lambda path: runs.Config.of(path.parent).flag("no_dx", "False"),
    ),
    "array (.npy): 2^40 numbers": (
        "x.npy",
        lambda: npy("{'descr': '<f8', 'fortran_order': False, 'shape': (1099511627776,), }"),
        lambda path: read_npy(path.read_bytes(), str(path)),
    ),
    "transforms.json: empty lists": (
        "transforms.json", lambda: b'{"frames": [' + b"[]," * (MEGABYTE // 3) + b"0]}", lambda path: load(path.parent)
    ),
    "COLMAP: blank lines": ("images.txt", lambda: b"\n" * MEGABYTE, read_colmap),
    "COLMAP: points as text": ("points3D.txt", lambda: b"1 0 0 0 0 0 0 0\n" * (MEGABYTE // 16), read_colmap),
    "COLMAP: points, binary": (
        "points3D.bin", lambda: (MEGABYTE // 51).to_bytes(8, "little") + bytes(51 * (MEGABYTE // 51)), read_colmap
    ),
    "picture: 16 megapixels (PNG)": ("x.png", lambda: blank_png(4096, 4096), read_picture),
    "picture: 177 megapixels (PNG)": ("x.png", lambda: blank_png(16384, 10800), read_picture),
    "picture: 16 megapixels, to undistort (PNG)": ("x.png", lambda: blank_png(4096, 4096), read_distorted),
    "picture: 16 megapixels in one strip (TIFF)": ("x.tif", lambda: blank_tiff(4096, 4096), read_picture),
    "picture: a tile of 716 megapixels (TIFF)": ("x.tif", lambda: huge_tile(26752), read_picture),
    "mask: 16 megapixels (PNG)": ("x.png", lambda: blank_png(4096, 4096), lambda path: read_mask(path, (4096, 4096))),
    "picture: 16 megapixels in 100 scans (JPEG)": ("x.jpg", lambda: many_scans(4096), read_picture),
    "video: 30 blank frames of 2048 x 2048": ("x.mp4", lambda: blank_film(2048, 30), read_film),
    "segments.json: empty lists": (
        segments.INDEX,
        lambda: b'{"segments_version": 1, "bases": [], "segments": [], "x": [' + b"[]," * (MEGABYTE // 3) + b"0]}",
        segments.read_index,
    ),
    "library: lists in lists": ("a/index.json", lambda: b"[" * MEGABYTE, lambda path: library(path.parent.parent)),
    "manifest: broken lines": (
        "m.jsonl",
        lambda: b"{}\n" * (MEGABYTE // 12),
        lambda path: read_manifest(str(path), OPS["encode"], lambda source, options: None),
    ),
}  # fmt: skip


def measure(name: str, path: Path) -> None:
    """Prints seconds, bytes of memory and the answer of one reader, as JSON."""
    before, begin, answer = peak_bytes(), time.process_time(), "read"
    try:
        CASES[name][2](path)
    except Pd4Error as error:
        answer = str(error).replace(str(path.parent), "")
    seconds = time.process_time() - begin + resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    print(json.dumps([seconds, peak_bytes() - before, answer]))


def main() -> None:
    """The table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", nargs="?", default="", help="only rows whose name holds this text")
    parser.add_argument("path", nargs="?", type=Path, help=argparse.SUPPRESS)  # of one row, in its own process
    args = parser.parse_args()
    if args.path:
        measure(args.name, args.path)
        return
    print("| reader and input | bytes | s | µs per byte | MiB | answer |\n|---|---:|---:|---:|---:|---|")
    for name, (file, make, _) in CASES.items():
        if args.name not in name:
            continue
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / file
            path.parent.mkdir(exist_ok=True)
            size = path.write_bytes(make())
            found = subprocess.run([sys.executable, __file__, name, str(path)], capture_output=True, check=True)
        seconds, memory, answer = json.loads(found.stdout)
        cost = f"{1e6 * seconds / size:.2f} | {memory / MEGABYTE:.0f}"
        print(f"| {name} | {size:,} | {seconds:.2f} | {cost} | {answer[:90]} |", flush=True)


if __name__ == "__main__":
    main()
