"""Synchronised videos, one per camera that stands still: what Neu3D's folders and others of the kind share.

A folder with a model of COLMAP whose pictures are called as the videos (`cam00.png` and `cam00.mp4`, in `videos/` or
beside the model) is one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pd4dgs_codec.data.cameras import UnreadView, rectify
from pd4dgs_codec.data.colmap import registered
from pd4dgs_codec.data.files import check_downscale, shrink_image, shrink_mask
from pd4dgs_codec.data.frame_cache import StoredView, stored_frames
from pd4dgs_codec.data.posed import geometry, without_first_camera
from pd4dgs_codec.data.videos import video_size
from pd4dgs_codec.data.view import Dataset
from pd4dgs_codec.errors import DataError

SUFFIXES = (".mp4", ".mov", ".mkv", ".avi", ".webm", ".MP4", ".MOV")


def synchronised_dataset(
    folder: Path,
    cameras: Sequence[UnreadView],
    points: np.ndarray | None,
    colors: np.ndarray | None,
    downscale: int,
    holdout: int,
    depth: tuple[float, float] | None = None,
) -> Dataset:
    """The dataset of these cameras, each with its video as its image. The first camera is held out, none for holdout 0.
    depth: near and far, if the folder tells them."""
    views: list[StoredView] = []
    count, fps = 0, 0.0
    for i, camera in enumerate(cameras):
        lens, path = camera.lens, camera.image
        check_downscale((lens.width, lens.height), downscale, str(path))
        mask = None
        if not lens.is_pinhole:
            mask = shrink_mask(rectify(np.zeros((lens.height, lens.width, 3), np.uint8), lens)[1], downscale)

        def treat(picture: np.ndarray, camera: UnreadView = camera) -> np.ndarray:
            if not camera.lens.is_pinhole:
                picture = rectify(picture, camera.lens)[0]
            return shrink_image(picture, downscale)

        frames = stored_frames(path, f"{downscale} {lens if mask is not None else ''}", treat)
        if i and (len(frames) != count or frames.fps != fps):
            first = cameras[0].image.name
            found = f"{len(frames)} frames at {frames.fps:g} per second and {first} {count} at {fps:g}"
            raise DataError(f"{path}: has {found}, expected synchronised videos")
        count, fps = len(frames), frames.fps
        fixed = {
            "viewmat": camera.viewmat.astype(np.float32),
            "K": lens.matrix(downscale),
            "camera_id": i,
            "mask": mask,
        }
        for k in range(count):
            time = k / (count - 1) if count > 1 else 0.0
            views.append(StoredView(frames, k, time=time, name=f"{path.stem}_{k:04d}", **fixed))
    train, test = without_first_camera(folder, views, holdout)
    return Dataset(
        name=folder.resolve().name,
        train=tuple(train),
        test=tuple(test),
        background=(0.0, 0.0, 0.0),
        time_range=(0.0, (count - 1) / fps if count > 1 else 1.0),
        **geometry(cameras, points, colors, depth),
    )


def find_videos(folder: Path) -> dict[str, Path]:
    """Videos by name without suffix, in `videos/` or in the folder itself; none if it has `images/` instead."""
    if (folder / "images").is_dir() and not (folder / "videos").is_dir():
        return {}
    place = folder / "videos" if (folder / "videos").is_dir() else folder
    return {file.stem: file for file in sorted(place.iterdir()) if file.suffix in SUFFIXES}


def read_synchronised(
    folder: Path, videos: dict[str, Path], model: Path, suffix: str, downscale: int, holdout: int
) -> Dataset:
    """Read a folder with a model of COLMAP and a video for each of its pictures."""
    listed, points, colors = registered(model, suffix)
    cameras = []
    for image, viewmat, lens in listed:
        where = f"{model}: {image.name}"
        video = videos.get(Path(image.name).stem) or videos.get(Path(image.name).parts[0])
        if video is None:
            raise DataError(f"{where}: there is no video of this name among {len(videos)}, expected one per picture")
        size = video_size(video)
        if size != (lens.width, lens.height):
            found = f"{size[0]}x{size[1]}"
            raise DataError(f"{video}: is {found}, and its camera in {model} {lens.width}x{lens.height}")
        cameras.append(UnreadView(video.stem, 0, 0.0, viewmat, lens, video))
    twice = next((c.name for i, c in enumerate(cameras) if any(c.image == d.image for d in cameras[:i])), None)
    if twice is not None:
        raise DataError(f"{model}: two pictures are of the video {twice}, expected one per camera")
    cameras = [replace(camera, camera_id=i) for i, camera in enumerate(cameras)]
    return synchronised_dataset(folder, cameras, points, colors, downscale, holdout)
