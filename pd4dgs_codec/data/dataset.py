"""The table of dataset readers, and `load`, which picks one by the files in a folder.

A new reader is a function `read_NAME(folder, downscale, holdout, background) -> Dataset` in a module of this package
and a row of READERS. The help of the commands, `pd4dgs-batch scan` and the error for unknown folders follow from the
row. This module imports the standard library alone, so that `--help` loads neither numpy nor a reader.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from pkgutil import resolve_name
from typing import TYPE_CHECKING

from pd4dgs_codec.errors import DataError, one_line

if TYPE_CHECKING:
    from pd4dgs_codec.data.files import Color
    from pd4dgs_codec.data.view import Dataset, View

SYNTHETIC = "synthetic:"
COLORS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}


@dataclass(frozen=True)
class Reader:
    """A layout of dataset folders.

    name: of the layout. function: MODULE:FUNCTION below `pd4dgs_codec.data`. marks: sets of glob patterns; a folder has
    this layout if all patterns of one set match in it. contents, remark: for the help and for error messages.
    """

    name: str
    function: str
    marks: tuple[tuple[str, ...], ...]
    contents: str
    remark: str = ""

    def recognises(self, folder: Path) -> bool:
        """Whether the folder has this layout."""
        return any(all(any(folder.glob(mark)) for mark in marks) for marks in self.marks)


#: The places of COLMAP models in a folder, as patterns.
COLMAP = ("sparse/*", "sparse", "colmap/sparse/*", ".")
READERS = (
    Reader(
        "iPhone/DyCheck, Nerfies, HyperNeRF", "captures:read_iphone", (("camera",),), "camera/ and rgb/",
        "split files name the held-out views",
    ),
    Reader("Blender, D-NeRF, nerfstudio", "transforms:read_transforms", (("transforms*.json",),), "transforms*.json"),
    Reader(
        "Neu3D", "captures:read_neu3d", (("poses_bounds.npy",),), "poses_bounds.npy and a video cam*.mp4 per camera",
        "the first camera is held out",
    ),
    Reader("Panoptic Studio", "captures:read_panoptic", (("train_meta.json",),), "train_meta.json and ims/"),
    Reader(
        "Record3D", "captures:read_record3d",
        tuple((meta, pictures) for meta in ("metadata", "metadata.json") for pictures in ("rgbd", "rgb")),
        "metadata and rgbd/",
    ),
    Reader(
        "COLMAP", "colmap:read_colmap",
        tuple((f"{place}/cameras{kind}", f"{place}/images{kind}") for place in COLMAP for kind in (".bin", ".txt")),
        "sparse/ and images/ or videos/", "optional times.txt and masks/; the first video is held out",
    ),
)  # fmt: skip
#: A line of help for each layout.
FOLDERS = tuple(
    f"a folder with {reader.contents} ({reader.name}{'; ' * bool(reader.remark)}{reader.remark})" for reader in READERS
)


def load(
    source: str | Path,
    *,
    downscale: int = 1,
    holdout: int = 8,
    background: Color | None = None,
    fps: float | None = None,
) -> Dataset:
    """Read a dataset.

    source: a folder that one of READERS recognises, or `synthetic:NAME[?key=value&...]` (see `synthetic`).
    downscale: images are averaged over downscale x downscale blocks (the remainder is cropped), intrinsics follow.
    holdout: without split files, frames with i % holdout == holdout // 2 are the test frames; 0 = none.
    background: RGB 0..1 of the scene's background, on which pictures with alpha are laid; opaque ones stay as they are.
    None: white if a training picture has alpha, else the dataset's own or the colour of the pictures' border.
    fps: frames per second, where times are numbers of frames; None for those of the dataset, or 30.
    Views whose masks hold no valid pixel are left out, see `Dataset.left_out`.
    Raises DataError, one line, for anything missing or broken.
    """
    dataset = _without_blind_views(_read(source, downscale, holdout, background), source)
    if background is not None:
        dataset = replace(dataset, background=background)
    if fps and (stored := dataset.origin.fps):
        start, stop = (time * stored / fps for time in dataset.time_range)
        dataset = replace(dataset, time_range=(start, stop), origin=replace(dataset.origin, fps=fps))
    elif fps:
        remark = f"--fps {fps:g} has no effect, since times are known otherwise"
        dataset = replace(dataset, origin=replace(dataset.origin, notes=(*dataset.origin.notes, remark)))
    return dataset


def color(text: str) -> Color:
    """The RGB of black, white or R,G,B in 0..1. Raises ValueError for other texts."""
    if text in COLORS:
        return COLORS[text]
    r, g, b = map(float, text.split(","))
    if not all(0 <= v <= 1 for v in (r, g, b)):
        raise ValueError(text)
    return r, g, b


def dataset_folders(names: Iterable[str]) -> list[str]:
    """The folders that a reader recognises in a tree of files, except those inside another one.

    names: the paths of all files, relative to the root of the tree, which itself does not count.
    """
    paths = {PurePosixPath(name) for name in names}
    paths |= {folder for path in paths for folder in path.parents}
    found: set[PurePosixPath] = set()
    for marks in {marks for reader in READERS for marks in reader.marks}:
        depths = [(mark, len(PurePosixPath(mark).parts)) for mark in marks]
        found |= set.intersection(*({p.parents[n - 1] for p in paths if p.match(mark)} for mark, n in depths))
    found.discard(PurePosixPath("."))
    return sorted(str(folder) for folder in found if found.isdisjoint(folder.parents))


def _read(source: str | Path, downscale: int, holdout: int, background: Color | None) -> Dataset:
    if isinstance(downscale, bool) or not isinstance(downscale, int) or downscale < 1:
        raise DataError(f"{source}: downscale is {downscale}, expected an integer >= 1")
    if isinstance(holdout, bool) or not isinstance(holdout, int) or holdout < 0 or holdout == 1:
        raise DataError(f"{source}: holdout {holdout} leaves no training frame, expected 0 (none) or an integer >= 2")
    if str(source).startswith(SYNTHETIC):
        synthetic: Dataset = resolve_name("pd4dgs_codec.data.synthetic:read_synthetic")(str(source), downscale)
        return synthetic
    folder = Path(source)
    if not folder.is_dir():
        found = "a file" if folder.exists() else "nothing"
        raise DataError(f"{folder}: found {found}, expected a dataset folder or {SYNTHETIC}NAME")
    reading_folder = resolve_name("pd4dgs_codec.data.files:reading_folder")
    for reader in READERS:
        if reader.recognises(folder):
            try:
                with reading_folder(folder) as reading:
                    read = resolve_name(f"pd4dgs_codec.data.{reader.function}")
                    dataset: Dataset = read(folder, downscale, holdout, background)
                    notes = (*dataset.origin.notes, *reading.remarks())
                    return replace(dataset, origin=replace(dataset.origin, notes=notes))
            except (DataError, ImportError, MemoryError):
                raise
            except Exception as error:  # faults of foreign files that no check foresaw
                found = f"{type(error).__name__}: {error}"
                raise DataError(f"{folder}: cannot be read as {reader.name}: {one_line(found, 160)}") from error
    found = "other files" if any(folder.iterdir()) else "an empty folder"
    expected = ", ".join(f"{reader.contents} ({reader.name})" for reader in READERS)
    raise DataError(f"{folder}: found {found}, expected {expected}")


def _without_blind_views(dataset: Dataset, source: str | Path) -> Dataset:
    """The dataset without views that have no valid pixel: they train nothing, and any picture would match them."""

    def sees(view: View) -> bool:
        return "mask" not in vars(view) or view.mask is None or bool(view.mask.any())  # not of a `LaterView`

    train, test = (tuple(filter(sees, views)) for views in (dataset.train, dataset.test))
    left_out = tuple(view.name for view in (*dataset.train, *dataset.test) if not sees(view))
    if not train:
        count = len(dataset.train)
        raise DataError(f"{source}: the masks of all {count} training views hold no valid pixel, expected one at least")
    return replace(dataset, train=train, test=test, left_out=left_out) if left_out else dataset
