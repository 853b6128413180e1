"""Checked reading of JSON, numbers, options, images, masks and PLY files: each failure is a DataError of one line."""

from __future__ import annotations

import contextlib
import io
import json
import re
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pd4dgs_codec.errors import DataError, one_line
from pd4dgs_codec.io import reading

if TYPE_CHECKING:
    from PIL.Image import Image as Picture

#: Largest length in scene units or pixels: products and squares of such numbers stay finite in binary32.
LARGEST = 1e9
Color = tuple[float, float, float]  #: RGB 0..1
WHITE = (1.0, 1.0, 1.0)
IMAGE_SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")
FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TIFF")  #: of pictures; another format of Pillow runs programs
#: A compressed file may unpack to FREE_BYTES, and INFLATES more for each of its bytes.
FREE_BYTES, INFLATES = 1 << 20, 16
#: A picture may have FREE_PIXELS, which admits blank 4K ones, and PIXELS_PER_BYTE more for each byte of its file.
FREE_PIXELS, PIXELS_PER_BYTE = 1 << 24, 256
#: Scans of a progressive JPEG, each over all pixels: ten are usual, and a few bytes add one.
MAX_SCANS, SCAN = 100, b"\xff\xda"
#: Pillow's pixel modes with one obvious conversion to RGB; others (CMYK, LAB, floats) are refused.
GREY16_MODES = {"I;16", "I;16L", "I;16B"}
READABLE_MODES = {"1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX"} | GREY16_MODES
ORIENTATION, UPRIGHT = 0x0112, 1  #: EXIF's orientation tag, and its value for pixels stored upright
GAMMA = (0.40, 0.51)  #: exponents that PNG files give for sRGB: 1/2.2 as encoders round it


#: The folder of the dataset that is being read, with links resolved.
_FOLDER: ContextVar[Path | None] = ContextVar("_FOLDER", default=None)


@contextlib.contextmanager
def staying_inside(folder: Path) -> Iterator[None]:
    """Within the block, `check_regular` refuses files outside this folder, also behind links."""
    before = _FOLDER.set(folder.resolve())
    try:
        yield
    finally:
        _FOLDER.reset(before)


def check_regular(path: Path) -> None:
    """Raises DataError for pipes and devices, which may never end, and for files outside the dataset that is being
    read; OSError or ValueError for invalid names."""
    if path.exists() and not path.is_file():
        raise DataError(f"{path}: is not a regular file")
    folder = _FOLDER.get()
    if folder is not None and folder not in path.resolve().parents:
        raise DataError(f"{path}: leads out of {folder}, expected the name of a file in this folder")


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
    """The image file of a `file_path` written with or without its extension. Raises DataError if it is missing."""
    for suffix in IMAGE_SUFFIXES:
        path = inside(folder, name + suffix)
        with contextlib.suppress(OSError):  # a name too long for the system
            if path.is_file():
                return path
    raise DataError(f"{folder / name}: image is missing (tried the name alone, .png, .jpg and .jpeg)")


def check_pixels(count: int, files: Iterable[Path], where: str) -> None:
    """Raises DataError for pictures of more pixels than files of their size hold: a few kB can unpack to gigabytes."""
    try:
        held = FREE_PIXELS + PIXELS_PER_BYTE * sum(file.stat().st_size for file in files)
    except OSError:
        return  # reading the file reports the error
    if count > held:
        raise DataError(f"{where}: {count:,} pixels, expected {held:,} at most for files of this size")


def _open(path: Path, what: str = "image", size: tuple[int, int] | None = None) -> Picture:
    """Opens a picture without decoding its pixels. size: the expected (W, H). Raises DataError."""
    from PIL import Image  # of the extra `train`

    try:
        check_regular(path)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of Pillow, about sizes
            picture = Image.open(path, formats=FORMATS)
    except FileNotFoundError:
        raise DataError(f"{path}: image is missing") from None
    except DataError:
        raise
    except Exception:  # Pillow raises many kinds
        raise DataError(f"{path}: not an image that can be read, expected {', '.join(FORMATS)}") from None
    with contextlib.ExitStack() as refused:
        refused.callback(picture.close)
        check_pixels(picture.width * picture.height, [path], str(path))
        scans = path.read_bytes().count(SCAN) if picture.format in ("JPEG", "MPO") else 0
        if scans > MAX_SCANS:
            raise DataError(f"{path}: {scans:,} scans, expected {MAX_SCANS} at most in a JPEG")
        if size is not None and picture.size != size:
            raise DataError(f"{path}: {what} is {picture.width}x{picture.height}, expected {size[0]}x{size[1]}")
        refused.pop_all()
    return picture


def image_info(path: Path) -> tuple[int, int, bool]:
    """Width, height and whether there is an alpha channel, from the file's header."""
    with _open(path) as image:
        return image.width, image.height, _has_alpha(image)


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
    elif image.getexif().get(ORIENTATION, UPRIGHT) != UPRIGHT:  # some tools rotate, some do not
        flag = image.getexif()[ORIENTATION]
        found = f"is stored rotated (orientation flag {flag}), expected upright pixels as the camera has"
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


def read_image(path: Path, size: tuple[int, int], *, downscale: int = 1, under: Color | None = WHITE) -> np.ndarray:
    """uint8 [H // downscale, W // downscale, 3], the mean of each block; the file must measure `size` = (W, H).

    under: RGB 0..1 on which a transparent image is laid; None drops its alpha (photographs).
    """
    with _open(path, size=size) as image:
        check_downscale(size, downscale, str(path))
        try:
            rgb = _rgb(image, str(path), under)
        except DataError:
            raise
        except Exception as e:
            raise DataError(f"{path}: image data is broken: {e}") from None
        if downscale > 1:
            w, h = size[0] // downscale, size[1] // downscale
            rgb = rgb.reduce(downscale, box=(0, 0, w * downscale, h * downscale))
        return np.array(rgb)


def read_mask(path: Path, size: tuple[int, int], *, downscale: int = 1) -> np.ndarray:
    """bool [H // downscale, W // downscale]: True where every pixel of the block is non-zero."""
    with _open(path, "mask", size) as image:
        try:
            return shrink_mask(np.array(image.convert("L")) > 0, downscale)
        except Exception as e:
            raise DataError(f"{path}: mask data is broken: {e}") from None


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
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "<i2", "int16": "<i2", "ushort": "<u2",
    "uint16": "<u2", "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4", "float": "<f4", "float32": "<f4",
    "double": "<f8", "float64": "<f8",
}  # fmt: skip
END = b"end_header"
DIGITS = 12  #: of a count; Python refuses to parse thousands


def _header(path: Path, raw: bytes) -> tuple[str, int, np.dtype, int]:
    """(format, vertex count, dtype of a vertex, byte at which the body starts). Raises DataError."""
    stop = raw.find(END)
    if not raw.startswith(b"ply") or stop < 0:
        raise DataError(f"{path}: not a PLY file (expected it to start with 'ply' and hold an end_header line)")
    newline = raw.find(b"\n", stop)
    kind, count, fields, elements = "", -1, [], 0
    for line in raw[:stop].decode("ascii", "replace").splitlines():
        words = line.split()
        if words[:1] == ["format"] and len(words) >= 2:
            kind = words[1]
        elif words[:1] == ["element"] and len(words) == 3:
            elements += 1
            if elements == 1 and words[1] == "vertex" and words[2].isdigit() and len(words[2]) <= DIGITS:
                count = int(words[2])
        elif words[:1] == ["property"] and elements == 1:
            if len(words) != 3 or words[1] not in SCALARS:
                raise DataError(f"{path}: unknown vertex property {' '.join(words[1:])!r}, expected a scalar")
            fields.append((words[2], SCALARS[words[1]]))
    if kind not in ("ascii", "binary_little_endian") or count < 0 or newline < 0:
        found = f"format {kind!r}, first element with {count} vertices"
        raise DataError(f"{path}: found {found}; expected ascii or binary_little_endian and the element vertex first")
    names = [name for name, _ in fields]
    if len(set(names)) != len(names) or not {"x", "y", "z"} <= set(names):
        raise DataError(f"{path}: vertex properties are {', '.join(names)}, expected x, y, z once each")
    return kind, count, np.dtype(fields), newline + 1


def read_vertices(path: Path, raw: bytes | None = None) -> np.ndarray:
    """Structured array [count] of the vertex element, one field per property. raw: the file's bytes, if known."""
    raw = read_file(path) if raw is None else raw
    kind, count, dtype, start = _header(path, raw)
    names, body = dtype.names or (), raw[start:]
    if kind == "binary_little_endian":
        if len(body) < count * dtype.itemsize:
            size = count * dtype.itemsize
            raise DataError(f"{path}: {len(body)} bytes of vertices, expected {size} for {count} of them")
        return np.frombuffer(body, dtype, count)
    lines = body.decode("ascii", "replace").splitlines()[:count]
    if len(lines) < count:
        raise DataError(f"{path}: {len(lines)} vertex lines, expected {count}")
    try:
        table = np.array([line.split()[: len(names)] for line in lines], np.float64).reshape(count, len(names))
    except ValueError:
        raise DataError(f"{path}: vertex lines are not {len(names)} numbers each") from None
    vertices = np.empty(count, dtype)
    with np.errstate(over="ignore"):  # numbers beyond a type's range become infinite
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
    points = np.stack([vertices[c] for c in "xyz"], axis=1, dtype=np.float64)
    return np.asarray(points[(np.abs(points) <= LARGEST).all(axis=1)])  # without NaN, too
