"""A GIF of a scene that becomes better as its bytes arrive, while its time runs and the camera moves.

    python benchmarks/refining_gif.py scene.pd4 [SOURCE] -o docs/img/refining.gif

Best with a file in slices (`pd4dgs-encode --slices 50k`). The first picture is that of the first slice; then follow the
other slices of layer 0, and the layers above it. Without a dataset the file's own camera draws it, from side to side.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pd4dgs_codec.data.dataset import load
from pd4dgs_codec.format.info import info
from pd4dgs_codec.io import whole_file
from pd4dgs_codec.quality.frames import Frame, dataset_frames, own_frames
from pd4dgs_codec.quality.image import to_uint8
from pd4dgs_codec.quality.levels import load_levels
from pd4dgs_codec.scene import Camera

#: Bytes of the GIF at most, and what is tried in turn to stay below: (colours, pictures a second).
LIMIT, TRIED = 1_500_000, ((192, 10), (96, 8), (64, 6), (64, 5), (16, 4))
WIDTH = 320
#: Seconds that each prefix is shown, and the whole file.
PREFIX_SECONDS, LAST_SECONDS = 0.9, 3.0
#: Seconds in which the recording runs from its start to its end; with cameras of a dataset it then runs back.
PERIOD = 4.0
#: Frames of the file's own camera, and the degrees by which it turns.
FRAMES, ORBIT = 120, 50.0
BAR = 26
#: Thresholds of ordered dithering, -0.5 to 0.5, and their weight in levels of 8 bits. Unlike diffused errors they are
#: the same in every picture, so that what stands still stays equal.
BAYER = np.array([[0, 8, 2, 10], [12, 4, 14, 6], [3, 11, 1, 9], [15, 7, 13, 5]]) / 16 - 15 / 32
DITHER = 3
#: The layer that the last bytes belong to, in words.
SHOWN = "one instant", "its motion", "motion finer in time"


def draw(data: bytes, source: str | None, path: Path) -> None:
    """Writes the GIF of the file `data`, from the cameras of the dataset `source` in the order of their times."""
    ends = [(row["layer"], part["end"]) for row in info(data)["layers"] for part in row["slices"]]
    shown = [load_levels(data, max_bytes=end, last_only=True)[-1] for _, end in ends]
    frames = _frames(source) if source else own_frames(shown[-1].model.info, FRAMES, ORBIT)
    for colours, rate in TRIED:
        pictures, second = [], 0.0
        for (layer, end), level in zip(ends, shown, strict=True):
            stays = LAST_SECONDS if end == ends[-1][1] else PREFIX_SECONDS
            for _ in range(round(stays * rate)):
                share = 1 - abs(1 - second / PERIOD % 2) if source else second / PERIOD % 1
                frame = frames[round(share * (len(frames) - 1))]
                picture = level.picture(widened(frame.camera, WIDTH), frame.time)
                pictures.append(labelled(dithered(picture), layer, end, len(data)))
                second += 1 / rate
        with whole_file(path, overwrite=True) as temporary:
            write(pictures, temporary, colours, rate)
        if path.stat().st_size <= LIMIT:
            break


def _frames(source: str) -> list[Frame]:
    """The dataset's views in the order of their times."""
    dataset = load(source)
    return dataset_frames(sorted((*dataset.train, *dataset.test), key=lambda view: view.time))


def widened(camera: Camera, width: int) -> Camera:
    """The same view in a picture of another width."""
    height = round(camera.height * width / camera.width)
    scale = np.array([[width / camera.width], [height / camera.height], [1]], np.float32)
    return replace(camera, width=width, height=height, K=camera.K * scale)


def dithered(picture: np.ndarray) -> np.ndarray:
    """uint8 [H, W, 3] of a picture in 0..1, with the noise that hides the steps of a small palette."""
    height, width = picture.shape[:2]
    noise = np.tile(BAYER, (-(-height // 4), -(-width // 4)))[:height, :width, None]
    return to_uint8(picture + noise * DITHER / 255)


def labelled(picture: np.ndarray, layer: int, end: int, size: int) -> np.ndarray:
    """uint8 [H + BAR, W, 3]: the picture above a bar of what has arrived of the file."""
    from PIL import Image, ImageDraw, ImageFont

    height, width = picture.shape[:2]
    sheet = Image.new("RGB", (width, height + BAR), (255, 255, 255))
    sheet.paste(Image.fromarray(picture))
    pen = ImageDraw.Draw(sheet)
    pen.rectangle((0, height, width * end // size, height + BAR), fill=(190, 214, 240))
    words = f"{end / 1000:,.0f} kB of {size / 1000:,.0f} kB: {SHOWN[layer]}"
    pen.text((6, height + 4), words, fill=(0, 0, 0), font=ImageFont.load_default(15))
    return np.asarray(sheet)


def write(pictures: Sequence[np.ndarray], path: Path, colours: int, rate: float) -> None:
    """A looping GIF of one palette, that of the first, middle and last picture. Equal pixels of successive pictures
    stay equal and cost nothing."""
    from PIL import Image

    images: list[Any] = [Image.fromarray(picture) for picture in pictures]
    sample = np.concatenate([pictures[0], pictures[len(pictures) // 2], pictures[-1]])
    palette = Image.fromarray(sample).quantize(colours, method=Image.Quantize.MEDIANCUT)
    first, *rest = (image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images)
    first.save(path, format="GIF", save_all=True, append_images=rest, duration=round(1000 / rate), loop=0)


def main() -> None:
    """The GIF of the file that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, help="a .pd4 file")
    parser.add_argument("source", metavar="SOURCE", nargs="?", help="the dataset whose cameras draw it")
    parser.add_argument("-o", "--output", type=Path, required=True)
    args = parser.parse_args()
    draw(args.file.read_bytes(), args.source, args.output)
    print(f"{args.output}: {args.output.stat().st_size:,} bytes")


if __name__ == "__main__":
    main()
