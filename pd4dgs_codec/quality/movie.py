"""Frames to files: numbered pictures, an animated GIF, or an MP4."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pd4dgs_codec.errors import RenderError


def write_pictures(frames: Iterator[np.ndarray], paths: list[Path]) -> None:
    """One uint8 [H, W, 3] frame per path."""
    from PIL import Image

    for frame, path in zip(frames, paths, strict=True):
        Image.fromarray(frame).save(path)


def write_gif(frames: Iterator[np.ndarray], path: Path, fps: float) -> None:
    """A looping GIF; all frames share the palette of the first, so that still parts do not flicker."""
    from PIL import Image

    images = [Image.fromarray(frame) for frame in frames]
    palette = images[0].quantize(256, method=Image.Quantize.MEDIANCUT)
    indexed = [image.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG) for image in images]
    indexed[0].save(
        path, format="GIF", save_all=True, append_images=indexed[1:], duration=round(1000 / fps), loop=0, optimize=False
    )


def write_mp4(frames: Iterator[np.ndarray], path: Path, fps: float, *, fragment: int | None = None) -> None:
    """H.264 in 4:2:0, which every browser plays; an odd row or column is cropped. RenderError without ffmpeg.

    fragment: frames per fragment that starts with a key frame, as streaming wants them; None for a plain file.
    """
    check_mp4()
    import imageio_ffmpeg

    writer = None
    movflags = "+frag_keyframe+empty_moov+default_base_moof"
    options = ["-g", str(fragment), "-sc_threshold", "0", "-bf", "0", "-movflags", movflags] if fragment else []
    try:
        for frame in frames:
            even = np.ascontiguousarray(frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2])
            if writer is None:
                size = (even.shape[1], even.shape[0])
                writer = imageio_ffmpeg.write_frames(
                    str(path),
                    size,
                    fps=fps,
                    quality=8,
                    macro_block_size=2,
                    ffmpeg_log_level="error",
                    output_params=options,
                )
                writer.send(None)
            writer.send(even)
        if writer is not None:
            writer.close()
            writer = None
    except OSError as error:
        raise RenderError(f"ffmpeg stopped: {' '.join(str(error).split())[:300]}") from None
    finally:
        if writer is not None:
            writer.close()


def check_mp4() -> None:
    """RenderError now, rather than after all frames, if MP4 cannot be written here."""
    try:
        import imageio_ffmpeg

        imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError):
        raise RenderError(
            "writing .mp4 needs imageio-ffmpeg with its ffmpeg program; install it or write .gif or .png"
        ) from None
