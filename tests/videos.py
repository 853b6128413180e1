"""Videos that tests write: every pixel comes back as it was."""

from pathlib import Path

import numpy as np


def write_video(path: Path, pictures: list[np.ndarray], fps: int) -> None:
    """pictures: uint8 [height, width, 3], all of one size, which is even."""
    import imageio_ffmpeg  # of an extra: what collects the tests may lack it

    height, width = pictures[0].shape[:2]
    writer = imageio_ffmpeg.write_frames(
        str(path), (width, height), fps=fps, codec="libx264rgb", pix_fmt_out="rgb24", quality=None,
        macro_block_size=1, output_params=["-preset", "ultrafast", "-qp", "0"],
    )  # fmt: skip
    writer.send(None)
    for picture in pictures:
        writer.send(np.ascontiguousarray(picture))
    writer.close()
