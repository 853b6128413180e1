"""The table of the README: one dynamic scene as a .pd4 file and in the files that people use today.

    python benchmarks/alternatives.py scene.pd4 SOURCE

Every other file holds the Gaussians that the .pd4 file decodes to, of all levels, at 30 instants a second, without view
dependence; the video shows one orbit of its camera. PSNR is that of the held-out views of SOURCE.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from common import command, table

from pd4dgs_codec.data.dataset import load
from pd4dgs_codec.draw.gaussians import near_plane
from pd4dgs_codec.draw.player import Player
from pd4dgs_codec.format.decoder import decode
from pd4dgs_codec.format.info import info
from pd4dgs_codec.interchange.export import Export, eyes_of_scene
from pd4dgs_codec.interchange.splats import fourdgs_bytes, picture, ply_bytes, read_splats, spz_bytes
from pd4dgs_codec.quality.image import mpsnr

FPS = 30


def measure(file: Path, source: str, folder: Path) -> list[tuple[str, int, int, str]]:
    """Rows (what, bytes, bytes before the first picture, PSNR)."""
    data = file.read_bytes()
    player, views = Player(decode(data)), load(source).test
    export, (start, end) = Export(player, eyes_of_scene(player), 0, 0), player.info.time_range
    seconds = end - start
    times = np.linspace(0, 1, round(seconds * FPS))
    frames = [(float(t), splats, learnt.slots) for t in times for splats, learnt in [export.splats(float(t))]]
    quality = {kind: [] for kind in ("ply", "spz", "pd4")}
    for view in views:
        quality["pd4"].append(mpsnr(player.picture(view.camera, view.time), view.image))
        splats, _ = export.splats(view.time)
        for kind, pack in (("ply", ply_bytes), ("spz", spz_bytes)):
            path = folder / f"frame.{kind}"
            path.write_bytes(pack(splats))
            shown = picture(read_splats(path), view.camera, player.info.background, near_plane(player.info))
            quality[kind].append(mpsnr(shown, view.image))
    rows = []
    for name, kind, pack in (("a PLY file per frame", "ply", ply_bytes), ("an SPZ file per frame", "spz", spz_bytes)):
        sizes = [len(pack(splats)) for _, splats, _ in frames]
        rows.append((name, sum(sizes), sizes[0], f"{np.mean(quality[kind]):.1f}"))
    size = len(fourdgs_bytes(frames, seconds))
    rows.append(("a .4dgs file", size, size, ""))
    video = folder / "orbit.mp4"
    command("render", file, "-o", video, "--orbit", 90, "--fps", FPS, "--duration", f"{seconds:.3f}s")
    size = video.stat().st_size
    rows.append(("an H.264 video of one orbit, no free camera", size, 0, ""))
    first = info(data)["layers"][0]["slices"][0]["end"]
    rows.append(("this codec", len(data), first, f"{np.mean(quality['pd4']):.1f}"))
    return rows


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, help="a .pd4 file in slices")
    parser.add_argument("source", metavar="SOURCE", help="the dataset that it was trained on")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        rows = measure(args.file, args.source, Path(name))
    head = ("the scene as", "bytes", "before the first picture", "PSNR dB")
    print(table(head, [(what, f"{size:,}", f"{first:,}" if first else "-", db) for what, size, first, db in rows]))


if __name__ == "__main__":
    main()
