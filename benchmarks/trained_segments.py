"""A long capture trained as one file, as files of their own, and as segments that continue a whole, at equal steps.

`python benchmarks/trained_segments.py` trains a synthetic scene in three ways, whose steps are as many in all, and
measures bytes, dB on held-out views, and how far pictures half a frame before and after an instant differ, at seams and
inside segments. --no-own leaves out the files of their own. What is trained already is kept.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import Row, command, say, table

from pd4dgs_codec import decode
from pd4dgs_codec.cli.train_segments import Capture
from pd4dgs_codec.data.view import Dataset
from pd4dgs_codec.draw.player import Drawer, drawer
from pd4dgs_codec.quality.image import mpsnr
from pd4dgs_codec.quality.levels import Timeline
from pd4dgs_codec.segments import read_index
from pd4dgs_codec.train.config import TrainConfig
from pd4dgs_codec.train.segmented import Cuts, Part, segment_config, train_part

INSIDE = 4  #: instants of each segment that are compared with seams
At = Callable[[float], tuple[Drawer, float]]  #: seconds -> what draws them, and the normalised time there


def quality(at: At, dataset: Dataset) -> float:
    """Mean PSNR on held-out views, dB."""
    low, high = dataset.time_range
    found = []
    for view in dataset.test:
        part, t = at(low + view.time * (high - low))
        found.append(mpsnr(part.picture(view.camera, t), view.image, view.mask))
    return float(np.mean(found))


def steps(at: At, dataset: Dataset, instants: list[float], half: float) -> float:
    """Mean PSNR of pictures so many seconds before these instants against those after, from the test cameras, in dB."""
    cameras = {view.camera_id: view.camera for view in dataset.test}.values()
    found = []
    for seconds in instants:
        (before, s), (after, t) = at(seconds - half), at(seconds + half)
        found += [mpsnr(before.picture(camera, s), after.picture(camera, t)) for camera in cameras]
    return float(np.mean(found))


def all_steps(config: TrainConfig, count: int) -> int:
    """Steps of a whole and of so many segments."""
    return (config.total or 0) + count * (segment_config(config).total or 0)


def alone(out: Path, capture: Capture, dataset: Dataset, cuts: Cuts) -> list[Path]:
    """Trains each segment as a file of its own; returns the files."""
    count = len(cuts.ranges)
    share = round(all_steps(capture.config, count) / count)
    files = [out / f"alone-{k}.pd4" for k in range(count)]
    for file, times in zip(files, cuts.ranges, strict=True):
        if not file.exists():
            train_part(Part(replace(capture.config, iterations=share), file, times), dataset, None)
    return files


def compared(out: Path, capture: Capture, every: float, with_own: bool) -> list[Row]:
    """Trains in three ways, or without files of their own in two. every: seconds between training frames."""
    dataset, cuts = capture.read()
    source, steps_each, count = capture.config.source, capture.config.total or 0, len(cuts.ranges)
    low, high = dataset.time_range
    common = ("--preset", capture.config.preset, "-j", capture.threads)
    folder, whole = out / "segments", out / "whole.pd4"
    command(
        "train", source, "-o", folder, "--segments", capture.length, "--overlap", capture.overlap, *common,
        "--iterations", steps_each,
    )  # fmt: skip
    files = alone(out, capture, dataset, cuts) if with_own else []
    if not whole.exists():
        command(
            "train", source, "-o", out / "whole.pt", *common, "--iterations", all_steps(capture.config, count), "-f"
        )
        command("encode", out / "whole.pt", "-o", whole)
    timeline, one = Timeline(folder), drawer(decode(whole))
    own, (_, index) = [drawer(decode(file)) for file in files], read_index(folder)

    def of_own(seconds: float) -> tuple[Drawer, float]:
        k = max(k for k, (start, _) in enumerate(cuts.ranges) if k == 0 or start <= seconds)
        start, stop = cuts.ranges[k]
        return own[k], min(max((seconds - start) / (stop - start), 0.0), 1.0)

    seams = [start for start, _ in cuts.ranges[1:]]
    inside = [a + (b - a) * (i + 0.5) / INSIDE for a, b in cuts.ranges for i in range(INSIDE)]
    base, sizes = sum(file.bytes for file in index.bases), [file.bytes for file in index.segments]
    rows = list[Row]()
    for name, at, (first, *later) in (
        ("one file", lambda t: (one, (t - low) / (high - low)), [whole.stat().st_size]),
        *([("files of their own", of_own, [file.stat().st_size for file in files])] if files else []),
        ("segments", lambda t: (timeline, (t - low) / (high - low)), [base + sizes[0], *sizes[1:]]),
    ):
        row: Row = {"way": name, "bytes": first + sum(later), "first": first}
        row |= {"later": float(np.mean(later)) if later else None, "dB": quality(at, dataset)}
        row |= {
            "step inside": steps(at, dataset, inside, every / 2),
            "step seams": steps(at, dataset, seams, every / 2),
        }
        rows.append(row)
        say(str(row))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", default="out/trained-segments", help="folder for checkpoints and files")
    parser.add_argument("--source", default="synthetic:local?seconds=12&frames=144")
    parser.add_argument("--length", type=float, default=2.0, help="seconds of a segment")
    parser.add_argument("--overlap", type=float, default=0.0, help="seconds that segments share")
    parser.add_argument("--iterations", type=int, default=1000, help="steps of the whole")
    parser.add_argument("--no-own", action="store_true", help="train no files of their own")
    parser.add_argument("-j", "--threads", type=int, default=1, help="cores, and segments at a time")
    args = parser.parse_args()
    out = Path(args.output)
    out.mkdir(parents=True, exist_ok=True)
    config = TrainConfig(preset="tiny", source=args.source, iterations=args.iterations)
    capture = Capture(config, {}, args.length, args.overlap, "cpu", args.threads)
    dataset, _ = capture.read()
    low, high = dataset.time_range
    rows = compared(out, capture, (high - low) / (len({view.time for view in dataset.train}) - 1), not args.no_own)
    shown = [
        [
            "" if v is None else v if isinstance(v, str) else f"{v:,.0f}" if v >= 1000 else f"{v:.2f}"
            for v in row.values()
        ]
        for row in rows
    ]
    print(table(list(rows[0]), shown))


if __name__ == "__main__":
    main()
