"""Checked reading of JSON, numbers, options, images, masks and PLY files: each failure is a DataError of one line."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import importlib
import io
import json
import os
import re
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import TYPE_CHECKING, Any

import numpy as np

from pd4dgs_codec.errors import DamageWarning, DataError, one_line
from pd4dgs_codec.io import reading

if TYPE_CHECKING:
    from PIL.Image import Image as Picture

#: Largest length in scene units or pixels: products and squares of such numbers stay finite in binary32.
LARGEST = 1e9
Color = tuple[float, float, float]  #: RGB 0..1
WHITE = (1.0, 1.0, 1.0)
PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
REMARKED = 4  #: names that a remark lists
FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TIFF")  #: of pictures; another format of Pillow runs programs
#: A compressed file may unpack to FREE_BYTES, and INFLATES more for each of its bytes.
FREE_BYTES, INFLATES = 1 << 20, 16
#: A picture may have FREE_PIXELS, which admits blank 4K ones, and PIXELS_PER_BYTE more for each byte of its file.
FREE_PIXELS, PIXELS_PER_BYTE = 1 << 24, 256
#: Scans of a progressive JPEG, each over all pixels: ten are usual, and a few bytes add one.
MAX_SCANS, SCAN = 100, b"\xff\xda"
LOSSY = ("JPEG", "MPO", "WEBP")  #: formats whose black may come back as dark grey
#: Pillow's pixel modes with one obvious conversion to RGB; others (CMYK, LAB, floats) are refused.
GREY16_MODES = {"I;16", "I;16L", "I;16B"}
READABLE_MODES = {"1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX"} | GREY16_MODES
ORIENTATION, UPRIGHT = 0x0112, 1  #: EXIF's orientation tag, and its value for pixels stored upright
TURNS = {2: 0, 3: 3, 4: 1, 5: 5, 6: 4, 7: 6, 8: 2}  #: its other values as Pillow's `Transpose`
SWAPS = (5, 6, 7, 8)  #: those that swap width and height
TILE_WIDTH, TILE_LENGTH = 322, 323  #: TIFF's tags
GAMMA = (0.40, 0.51)  #: exponents that PNG files give for sRGB: 1/2.2 as encoders round it


@dataclass(frozen=True)
class Reading:
    """The folder that is being read, with links resolved; by what was assumed or left out, the names that it concerns;
    by folder, the names of its files by these names in lower case."""

    folder: Path
    notes: dict[str, list[str]] = field(default_factory=dict)
    listed: dict[Path, dict[str, str]] = field(default_factory=dict)

    def remarks(self) -> list[str]:
        """What was assumed or left out, a line each."""
        return [counted(what, names) for what, names in self.notes.items()]


_READING: ContextVar[Reading | None] = ContextVar("_READING", default=None)


@contextlib.contextmanager
def reading_folder(folder: Path) -> Iterator[Reading]:
    """Within the block, `check_regular` refuses files outside this folder, also behind links, `note` collects remarks,
    and warnings of libraries about damaged files, which an error or a remark replaces, are not shown."""
    reading = Reading(folder.resolve())
    before = _READING.set(reading)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.simplefilter("always", DamageWarning)
            yield reading
    finally:
        _READING.reset(before)


def note(what: str, name: str) -> None:
    """Adds a name to the remark `what` on the folder that is being read."""
    if reading := _READING.get():
        reading.notes.setdefault(what, []).append(name)


def counted(what: str, names: Collection[str]) -> str:
    """A remark on so many things, with the names of the first."""
    return f"{what} ({len(names)}): {', '.join(list(names)[:REMARKED])}{', ...' * (len(names) > REMARKED)}"


def check_regular(path: Path) -> None:
    """Raises DataError for pipes and devices, which may never end, and for files outside the dataset that is being
    read; OSError or ValueError for invalid names."""
    if path.exists() and not path.is_file():
        raise DataError(f"{path}: is not a regular file")
    reading = _READING.get()
    if reading and reading.folder not in Path(os.path.realpath(path)).parents:  # resolve() raises in a circle of links
        raise DataError(f"{path}: leads out of {reading.folder}, expected the name of a file in this folder")


def read_file(path: Path) -> bytes:
    """Reads all bytes of a regular file. Raises DataError."""
    with reading(path):
        check_regular(path)
        return path.read_bytes()


def read_json(path: Path) -> dict[str, Any]:
    """Reads the JSON object in a file. Raises DataError."""
    raw = read_file(path)
    try:
        value = json.loads(raw.decode("utf-8"))
    except json.JSONDecodeError as e:
        raise DataError(f"{path}: line {e.lineno}, column {e.colno}: broken JSON: {e.msg}") from None
    except (ValueError, RecursionError) as e:
        raise DataError(f"{path}: cannot be read as JSON: {e}") from None
    if not isinstance(value, dict):
        raise DataError(f"{path}: found a JSON {type(value).__name__}, expected an object")
    return value


def read_npy(raw: bytes, where: str) -> np.ndarray:
    """Parses the bytes of a .npy file: numbers in an array of any shape. Raises DataError."""
    try:
        found = np.load(io.BytesIO(raw), allow_pickle=False)
    except Exception:  # numpy parses the header as Python, which raises errors of many kinds
        raise DataError(f"{where}: not a .npy file of numbers") from None
    if not isinstance(found, np.ndarray) or found.dtype.kind not in "fiu":
        raise DataError(f"{where}: found {getattr(found, 'dtype', 'an archive')}, expected a .npy file of numbers")
    return found


def number(value: Any, where: str, *, positive: bool = False, largest: float = LARGEST) -> float:
    """`value` as a float of at most `largest` in magnitude, and > 0 if `positive`. Raises DataError."""
    expected = "a number" + (" > 0" if positive else "")
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise DataError(f"{where} is {one_line(repr(value), 60)}, expected {expected}")
    if not abs(value) <= largest or (positive and value <= 0):  # also true of NaN and of integers beyond any float
        raise DataError(f"{where} is {one_line(str(value), 24)}, expected {expected} and at most {largest:g}")
    return float(value)


def whole_number(value: Any, where: str, low: int = 0, largest: float = LARGEST) -> int:
    """`value` as an integer >= low; 2.0 is one. Raises DataError."""
    result = number(value, where, largest=largest)
    if result != int(result) or result < low:
        raise DataError(f"{where} is {result:g}, expected a whole number >= {low}")
    return int(result)


def array(value: Any, shape: tuple[int, ...], where: str) -> np.ndarray:
    """`value` as a float64 array of the given shape. Raises DataError, also for numbers beyond LARGEST in magnitude."""
    if value is None:
        raise DataError(f"{where} is missing, expected an array of shape {shape}")
    try:
        result = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise DataError(f"{where} is not a numeric array, expected shape {shape}") from None
    if result.shape != shape:
        raise DataError(f"{where} has shape {result.shape}, expected {shape}")
    if not (np.abs(result) <= LARGEST).all():  # also true of NaN
        found = "NaN" if np.isnan(result).any() else f"{float(np.abs(result).max()):g}"
        raise DataError(f"{where} holds {found}, expected numbers of at most {LARGEST:g} in magnitude")
    return result


def split_options(
    text: str, source: str, value: Callable[[str, str], Any], examples: Mapping[str, str]
) -> tuple[str, dict[str, Any]]:
    """Splits `NAME?key=value&key=value` into NAME and its options, whose keys must be in `examples`.

    value: parses (key, text) or raises ValueError. Raises DataError, which names `source` and shows the key's example.
    """
    name, _, query = text.partition("?")
    values: dict[str, Any] = {}
    for part in query.split("&") if "?" in text else []:
        key, _, given = part.partition("=")
        if key not in examples or key in values:
            keys = ", ".join(examples)
            raise DataError(f"{source}: found {part!r}, expected each of {keys} once at most, as key=value")
        try:
            values[key] = value(key, given)
        except ValueError:
            raise DataError(f"{source}: {key} is {given!r}; expected for example {examples[key]}") from None
    return name, values


# -- images and masks --------------------------------------------------------------------------------------------------


def inside(folder: Path, name: str) -> Path:
    """The path in `folder` of `name`, which a file of the dataset gives; it need not exist. Raises DataError if the
    path leads out of `folder`, also through a link."""
    path = folder / name
    with contextlib.suppress(OSError, ValueError, RuntimeError):  # a NUL, a circle of links, a name that is too long
        if folder.resolve() in path.resolve().parents:
            return path
    raise DataError(f"{folder}: {one_line(repr(name), 120)} is not the name of a file in this folder")


def files_of(folder: Path, suffixes: Collection[str]) -> list[Path]:
    """The files of a folder with one of these suffixes, in lower or upper case, by name; without hidden ones, such as
    the `._NAME` that macOS adds to each NAME."""
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in suffixes and not p.name.startswith("."))


def last_numbers(paths: Iterable[Path]) -> list[int] | None:
    """The last number in each file name without suffix; None if any name has none."""
    found = [re.findall(r"\d{1,15}", path.stem) for path in paths]
    return [int(numbers[-1]) for numbers in found] if all(found) else None


def find_image(folder: Path, name: str) -> Path:
    """The picture that a file of the dataset names, also if the name lacks the suffix or has backslashes, letters in
    the wrong case or another picture's suffix, which is noted; the path that it would have if it is missing. Raises
    DataError for a name that leads out of the folder."""
    path = inside(folder, name)
    if is_there(path):
        return path
    if PureWindowsPath(name).drive:
        raise DataError(f"{folder}: {one_line(repr(name), 120)} is not the name of a file in this folder")
    plain = name.replace("\\", "/")
    inside(folder, plain)
    found = similar(folder, plain)
    if found is None:
        return path
    if not found.name.startswith(PurePosixPath(plain).name):
        note("found under another name", f"{found.relative_to(folder)} for {name}")
    return inside(folder, str(found.relative_to(folder)))


def similar(folder: Path, name: str) -> Path | None:
    """The file of this name in any case, with the suffix of a picture added or replaced; None if there is none."""
    *parents, last = PurePosixPath(name).parts or (name,)
    for parent in parents:
        folder /= parent if (folder / parent).is_dir() else _listed(folder).get(parent.casefold(), parent)
    names, stem = _listed(folder), PurePosixPath(last)
    bases = (last, stem.stem) if stem.suffix.casefold() in PICTURES else (last,)
    wanted = ((base + suffix).casefold() for base in bases for suffix in ("", *PICTURES))
    return next((folder / names[each] for each in wanted if each in names and is_there(folder / names[each])), None)


def _listed(folder: Path) -> dict[str, str]:
    """The names in a folder by these names in lower case; a folder is listed once per reading."""
    reading = _READING.get()
    listed = reading.listed if reading else {}
    if folder not in listed:
        names: list[str] = []
        with contextlib.suppress(OSError, ValueError):
            names = sorted(path.name for path in folder.iterdir())
        listed[folder] = {name.casefold(): name for name in names}
    return listed[folder]


def is_there(path: Path) -> bool:
    """Whether there is anything but a folder; false for a name that the system does not take."""
    with contextlib.suppress(OSError, ValueError):
        return path.exists() and not path.is_dir()
    return False


def check_pixels(count: int, files: Iterable[Path], where: str) -> None:
    """Raises DataError for pictures of more pixels than files of their size hold: a few kB can unpack to gigabytes."""
    try:
        held = FREE_PIXELS + PIXELS_PER_BYTE * sum(file.stat().st_size for file in files)
    except OSError:
        return  # reading the file reports the error
    if count > held:
        raise DataError(f"{where}: {count:,} pixels, expected {held:,} at most for files of this size")


def _open(path: Path, *, header_only: bool = False) -> Picture:
    """Opens a picture without decoding its pixels. header_only: they will not be decoded. Raises DataError."""
    from PIL import Image  # of the extra `train`

    try:
        check_regular(path)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of Pillow, about sizes
            picture = Image.open(path, formats=FORMATS)
        tags: Any = getattr(picture, "tag_v2", {})  # of TIFF, whose tiles are decoded whole however small the picture
        tile = int(tags.get(TILE_WIDTH, 0)) * int(tags.get(TILE_LENGTH, 1))
    except FileNotFoundError:
        raise DataError(f"{path}: image is missing") from None
    except DataError:
        raise
    except Exception:  # Pillow raises many kinds
        raise DataError(f"{path}: not an image that can be read, expected {', '.join(FORMATS)}") from None
    with contextlib.ExitStack() as refused:
        refused.callback(picture.close)
        check_pixels(picture.width * picture.height, [path], str(path))
        check_pixels(tile, [path], f"{path}: a tile")
        jpeg = picture.format in ("JPEG", "MPO") and not header_only
        if jpeg and (scans := path.read_bytes().count(SCAN)) > MAX_SCANS:
            raise DataError(f"{path}: {scans:,} scans, expected {MAX_SCANS} at most in a JPEG")
        refused.pop_all()
    if picture.format == "TIFF":
        _silence_libtiff()
    return picture


@functools.cache
def _silence_libtiff() -> None:
    """Stops libtiff from printing what is wrong with a picture, which Pillow also raises."""
    with contextlib.suppress(AttributeError, OSError):  # some builds of Pillow do not show the libraries they contain
        ctypes.CDLL(importlib.import_module("PIL._imaging").__file__).TIFFSetErrorHandler(None)


def image_info(path: Path, *, upright: bool = False) -> tuple[int, int, bool]:
    """Width, height and whether there is an alpha channel, from the file's header. upright: turned as EXIF says."""
    with _open(path, header_only=True) as image:
        swapped = upright and _turn(image) in SWAPS
        return (*(image.size[::-1] if swapped else image.size), _has_alpha(image))


def _turn(image: Picture) -> int:
    """EXIF's orientation, UPRIGHT if it has none that is valid."""
    with contextlib.suppress(Exception):  # Pillow raises many kinds
        flag = image.getexif().get(ORIENTATION, UPRIGHT)
        return flag if flag in TURNS else UPRIGHT
    return UPRIGHT


def _has_alpha(image: Picture) -> bool:
    return "A" in image.getbands() or "transparency" in image.info


def _check_readable(image: Picture, where: str) -> None:
    """Raises DataError for pictures that Pillow would not decode as their makers saw them."""
    found = None
    if getattr(image, "is_animated", False):  # Pillow takes quadratic time to count the pictures of a TIFF file
        found = "holds several pictures, expected one"
    elif image.mode not in READABLE_MODES:
        found = f"has pixels of kind {image.mode}, expected grey of 8 or 16 bits, a palette, RGB or RGBA"
    elif image.mode in GREY16_MODES and _has_alpha(image):
        found = "has 16-bit grey with a transparent value, expected 8 bits or an alpha channel"
    elif not GAMMA[0] <= image.info.get("gamma", GAMMA[0]) <= GAMMA[1]:
        found = f"has a gamma of {image.info['gamma']:g}, expected that of sRGB (0.455)"
    if found:
        raise DataError(f"{where}: {found}")


def _srgb(image: Picture, where: str) -> Picture:
    """Converts the picture to sRGB if its colour profile is another one."""
    profile = image.info.get("icc_profile")
    if not profile:
        return image
    from PIL import ImageCms

    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        name = ImageCms.getProfileDescription(source).strip()
        if "sRGB" in name:
            return image
        mode = image.mode if image.mode in ("L", "RGB", "RGBA") else "RGBA" if _has_alpha(image) else "RGB"
        target, srgb = "RGB" if mode == "L" else mode, ImageCms.createProfile("sRGB")
        converted = ImageCms.profileToProfile(image.convert(mode), source, srgb, outputMode=target)
    except (ImageCms.PyCMSError, OSError, ValueError) as e:
        raise DataError(f"{where}: its colour profile cannot be used: {e}") from None
    assert converted is not None  # None is for changes in place
    return converted


def _rgb(image: Picture, where: str, under: Color | None) -> Picture:
    """The picture in mode RGB and in sRGB; under as in `read_image`."""
    from PIL import Image

    _check_readable(image, where)
    if image.mode in GREY16_MODES:  # Pillow itself would clip to 255
        image = Image.fromarray(((np.asarray(image).astype(np.uint32) * 255 + 32_767) // 65_535).astype(np.uint8))
    image = _srgb(image, where)
    if under is not None and _has_alpha(image):
        image = image.convert("RGBA")
        r, g, b = (round(255 * v) for v in under)
        image = Image.alpha_composite(Image.new("RGBA", image.size, (r, g, b, 255)), image)
    return image.convert("RGB")


def read_image(
    path: Path, size: tuple[int, int], *, downscale: int = 1, under: Color | None = WHITE, upright: bool = False
) -> np.ndarray:
    """uint8 [H // downscale, W // downscale, 3], the mean of each block; the file must measure `size` = (W, H).

    under: RGB 0..1 on which a transparent image is laid; None drops its alpha (photographs). A picture whose EXIF data
    say to turn it is turned only if `size` is that of the turned one, or with `upright`.
    """
    from PIL import Image

    with _open(path) as image:
        check_downscale(size, downscale, str(path))
        try:
            flag, stored = _turn(image), image.size == size
            if not stored and not (flag in SWAPS and image.size == size[::-1]):
                found = f"is {image.width}x{image.height}, expected {size[0]}x{size[1]}"
                raise DataError(f"{path}: image {found} as the camera has; correct one of them")
            rgb = _rgb(image, str(path), under)
            if flag != UPRIGHT and stored and not upright:  # COLMAP, too, takes the pixels as they are stored
                note("not turned as EXIF says, since the camera has the stored size", path.name)
            elif flag != UPRIGHT:
                rgb = rgb.transpose(Image.Transpose(TURNS[flag]))
        except DataError:
            raise
        except Exception as e:
            raise DataError(f"{path}: image data is broken: {e}") from None
        if downscale > 1:
            w, h = size[0] // downscale, size[1] // downscale
            rgb = rgb.reduce(downscale, box=(0, 0, w * downscale, h * downscale))
        return np.array(rgb)


def read_mask(path: Path, size: tuple[int, int], *, downscale: int = 1) -> np.ndarray:
    """bool [H // downscale, W // downscale]: True where every pixel of the block is valid.

    Levels from 128 on are valid, in a lossless file that has none all above 0. If the colours are constant, the alpha
    channel is the mask. A mask of another size and the shape of `size` = (W, H) is scaled.
    """
    from PIL import Image

    with _open(path) as image:
        try:
            levels = np.array(image.convert("L"))
            if _has_alpha(image) and levels.min() == levels.max():
                alpha = np.array(image.convert("RGBA"))[..., 3]
                levels = alpha if alpha.min() < alpha.max() else levels
            valid = levels >= 128 if image.format in LOSSY or levels.max() >= 128 else levels > 0
        except Exception as e:
            raise DataError(f"{path}: mask data is broken: {e}") from None
    if valid.shape != size[::-1]:
        found = f"{image.width}x{image.height}"
        if not same_shape(image.size, size):
            raise DataError(f"{path}: mask is {found}, expected {size[0]}x{size[1]} or a multiple or fraction of it")
        note(f"masks scaled to {size[0]}x{size[1]}", f"{path.name} of {found}")
        valid = np.array(Image.fromarray(valid).resize(size, Image.Resampling.NEAREST))
    return shrink_mask(valid, downscale)


def same_shape(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether two sizes (W, H) have one ratio, but for rounding."""
    scale = other[0] / size[0]
    return abs(size[1] * scale - other[1]) <= max(1.0, scale)


def check_downscale(size: tuple[int, int], downscale: int, where: str) -> None:
    """Raises DataError for a downscale that leaves no pixel."""
    if min(size) // downscale < 1:
        raise DataError(f"{where}: downscale {downscale} leaves nothing of {size[0]}x{size[1]} pixels")


def _blocks(image: np.ndarray, k: int) -> np.ndarray:
    h, w = image.shape[0] // k, image.shape[1] // k
    return image[: h * k, : w * k].reshape(h, k, w, k, *image.shape[2:])


def shrink_image(image: np.ndarray, k: int) -> np.ndarray:
    """uint8 [H, W, 3] -> uint8 [H // k, W // k, 3], mean of each block, halves rounded up (as `read_image` does)."""
    if k == 1:
        return image
    return np.asarray(_blocks(image, k).mean(axis=(1, 3)) + 0.5).astype(np.uint8)


def shrink_mask(mask: np.ndarray, k: int) -> np.ndarray:
    """bool [H, W] -> bool [H // k, W // k], True where the whole block is."""
    return mask if k == 1 else np.asarray(_blocks(mask, k).all(axis=(1, 3)))


# -- PLY files ---------------------------------------------------------------------------------------------------------

SCALARS = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}  #: of the bytes of numbers
END = re.compile(rb"\nend_header[ \t]*\r?\n")  #: as a line: comments may hold the word
MAX_HEADER = 1 << 16  #: bytes of a PLY file's header
DIGITS = 12  #: of a count; Python refuses to parse thousands


def _header(path: Path, raw: bytes) -> tuple[str, int, np.dtype, int, int]:
    """(format, vertex count, dtype of a vertex, byte at which the body starts, bytes or lines before the vertices).
    Raises DataError."""
    end = END.search(raw, 0, MAX_HEADER)
    if not raw.startswith(b"ply") or end is None:
        found = f"begins with {raw[:4]!r}" if not raw.startswith(b"ply") else "has no line end_header"
        raise DataError(f"{path}: not a PLY file: {found}, expected 'ply' and a header of {MAX_HEADER:,} bytes at most")
    kind, elements = "", list[tuple[str, int, list[list[str]]]]()
    for words in map(str.split, raw[: end.start()].decode("ascii", "replace").splitlines()):
        if words[:1] == ["format"] and len(words) >= 2:
            kind = words[1]
        elif words[:1] == ["element"]:
            if len(words) != 3 or not (words[2].isdigit() and len(words[2]) <= DIGITS):
                raise DataError(f"{path}: found {one_line(' '.join(words), 60)!r}, expected a name and a count")
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"] and elements:
            elements[-1][2].append(words[1:])
    places = [i for i, (name, _, _) in enumerate(elements) if name == "vertex"]
    if kind not in ORDERS or not places:
        found = f"format {one_line(repr(kind), 40)} and {'an' if places else 'no'} element vertex"
        raise DataError(f"{path}: found {found}; expected {', '.join(ORDERS)} and the element vertex")
    skipped = 0
    for name, count, properties in elements[: places[0] + 1]:
        for words in properties:
            if len(words) != 2 or words[0] not in SCALARS:
                found = f"{name} property {one_line(' '.join(words), 60)!r}"
                raise DataError(f"{path}: unknown {one_line(found, 80)}, expected a scalar")
        sizes = [np.dtype(SCALARS[scalar]).itemsize for scalar, _ in properties]
        skipped += 0 if name == "vertex" else count * (sum(sizes) if kind != "ascii" else 1)
    names = [name for _, name in properties]
    if len(set(names)) != len(names) or not {"x", "y", "z"} <= set(names):
        found = one_line(", ".join(names), 120)
        raise DataError(f"{path}: vertex properties are {found or 'none'}, expected x, y, z once each")
    fields = [(name, ORDERS[kind] + SCALARS[scalar]) for scalar, name in properties]
    return kind, count, np.dtype(fields), end.end(), skipped


def read_vertices(path: Path, raw: bytes | None = None) -> np.ndarray:
    """Structured array [count] of the vertex element, one field per property. raw: the file's bytes, if known."""
    raw = read_file(path) if raw is None else raw
    kind, count, dtype, start, skipped = _header(path, raw)
    names = dtype.names or ()
    if kind != "ascii":
        size, left = count * dtype.itemsize, len(raw) - start - skipped
        if left < size:
            raise DataError(f"{path}: {max(left, 0)} bytes of vertices, expected {size} for {count} of them")
        return np.frombuffer(raw, dtype, count, start + skipped)
    lines = raw[start:].decode("ascii", "replace").splitlines()[skipped : skipped + count]
    if len(lines) < count:
        raise DataError(f"{path}: {len(lines)} vertex lines, expected {count}")
    try:
        table = np.array([line.split()[: len(names)] for line in lines], np.float64).reshape(count, len(names))
    except ValueError:
        raise DataError(f"{path}: vertex lines are not {len(names)} numbers each") from None
    vertices = np.empty(count, dtype)
    with np.errstate(over="ignore", invalid="ignore"):  # numbers beyond a type's range become infinite or any integer
        for name, column in zip(names, table.T, strict=True):
            vertices[name] = column
    return vertices


def read_only_ply(folder: Path) -> np.ndarray | None:
    """`read_ply` of the only PLY file in a folder; None if there is none or more than one."""
    found = files_of(folder, [".ply"])
    return read_ply(found[0]) if len(found) == 1 else None


def read_ply(path: Path) -> np.ndarray:
    """Points float64 [M, 3], without points that are not finite or beyond LARGEST."""
    vertices = read_vertices(path)
    with np.errstate(invalid="ignore"):  # of a signalling NaN
        points = np.stack([vertices[c] for c in "xyz"], axis=1, dtype=np.float64)
    return np.asarray(points[(np.abs(points) <= LARGEST).all(axis=1)])  # without NaN, too
