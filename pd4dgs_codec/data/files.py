"""Reading JSON, images and points, with every failure turned into one clear DataError."""

from __future__ import annotations

import contextlib
import io
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pd4dgs_codec.errors import DataError, one_line

if TYPE_CHECKING:
    from PIL.Image import Image as Picture

IMAGE_SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")
WHITE = 255
#: Of lengths in scene units and in pixels: their products and squares stay far from the end of binary32.
LARGEST = 1e9
#: Pillow's names of pixels; of the others (CMYK, LAB, floats …) no conversion is the only right one.
GREY16_MODES = {"I;16", "I;16L", "I;16B"}
READABLE_MODES = {"1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX"} | GREY16_MODES
ORIENTATION, UPRIGHT = 0x0112, 1  #: the EXIF flag, and its value for pixels stored as they are seen
GAMMA = (0.40, 0.51)  #: exponents that PNG files give for sRGB: 1/2.2 and what encoders round it to


def read_json(path: Path) -> dict[str, Any]:
    """The JSON object in `path`."""
    try:
        value = json.loads(read_file(path).decode("utf-8"))
    except FileNotFoundError:
        raise DataError(f"{path}: missing, expected a JSON file") from None
    except json.JSONDecodeError as e:
        raise DataError(f"{path}: line {e.lineno}, column {e.colno}: broken JSON: {e.msg}") from None
    except (OSError, ValueError, RecursionError) as e:
        raise DataError(f"{path}: cannot be read as JSON: {e}") from None
    if not isinstance(value, dict):
        raise DataError(f"{path}: found a JSON {type(value).__name__}, expected an object")
    return value


def read_file(path: Path) -> bytes:
    """All of a regular file; DataError for a pipe or a device, whose end may never come, OSError or ValueError else."""
    if path.exists() and not path.is_file():
        raise DataError(f"{path}: is not a regular file")
    return path.read_bytes()


def number(value: Any, where: str, *, positive: bool = False, largest: float = LARGEST) -> float:
    """`value` as a float of at most `largest` in magnitude (greater than zero if `positive`)."""
    expected = "a number" + (" > 0" if positive else "")
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise DataError(f"{where} is {one_line(repr(value), 60)}, expected {expected}")
    if not abs(value) <= largest or (positive and value <= 0):  # also true of NaN and of integers beyond any float
        raise DataError(f"{where} is {one_line(str(value), 24)}, expected {expected} and at most {largest:g}")
    return float(value)


def whole_number(value: Any, where: str, low: int = 0) -> int:
    """`value` as an integer >= low; 2.0 is one."""
    result = number(value, where)
    if result != int(result) or result < low:
        raise DataError(f"{where} is {result:g}, expected a whole number >= {low}")
    return int(result)


def array(value: Any, shape: tuple[int, ...], where: str) -> np.ndarray:
    """`value` as a float64 array of the given shape, its numbers at most LARGEST in magnitude."""
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


def find_image(folder: Path, name: str) -> Path:
    """The image file of a `file_path` written with or without its extension."""
    for suffix in IMAGE_SUFFIXES:
        path = folder / (name + suffix)
        with contextlib.suppress(OSError):  # a name too long for the system
            if path.is_file():
                return path
    raise DataError(f"{folder / name}: image is missing (tried as it is, .png, .jpg and .jpeg)")


def _open(path: Path, what: str = "image", size: tuple[int, int] | None = None) -> Picture:
    """The file's picture, its pixels not read yet; `size` = (W, H) is what it must measure."""
    try:
        from PIL import Image, UnidentifiedImageError
    except ImportError:
        raise DataError(f"{path}: reading images needs pillow (pip install 'pd4dgs-codec[train]')") from None
    try:
        picture = Image.open(path)
    except FileNotFoundError:
        raise DataError(f"{path}: image is missing") from None
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        raise DataError(f"{path}: not an image that can be read") from None
    if size is not None and picture.size != tuple(size):
        picture.close()
        raise DataError(f"{path}: {what} is {picture.width}x{picture.height}, expected {size[0]}x{size[1]}")
    return picture


def image_info(path: Path) -> tuple[int, int, bool]:
    """Width, height and whether there is an alpha channel, from the file's header."""
    with _open(path) as image:
        return image.width, image.height, _has_alpha(image)


def _has_alpha(image: Picture) -> bool:
    return "A" in image.getbands() or "transparency" in image.info


def _check_readable(image: Picture, where: str) -> None:
    """Refuses by name what would not be shown as its maker saw it."""
    found = None
    frames = getattr(image, "n_frames", 1)
    if frames > 1:
        found = f"holds {frames} pictures, expected one"
    elif image.mode not in READABLE_MODES:
        found = f"has pixels of kind {image.mode}, expected grey of 8 or 16 bits, a palette, RGB or RGBA"
    elif image.mode in GREY16_MODES and _has_alpha(image):
        found = "has 16-bit grey with a transparent value, expected 8 bits or an alpha channel"
    elif image.getexif().get(ORIENTATION, UPRIGHT) != UPRIGHT:  # some tools turn such pictures and others do not
        flag = image.getexif()[ORIENTATION]
        found = f"is stored turned (orientation flag {flag}), expected upright pixels that fit the camera"
    elif not GAMMA[0] <= image.info.get("gamma", GAMMA[0]) <= GAMMA[1]:
        found = f"has a gamma of {image.info['gamma']:g}, expected that of sRGB (0.455)"
    if found:
        raise DataError(f"{where}: {found}")


def _srgb(image: Picture, where: str) -> Picture:
    """The picture with its colour profile, if it names one, applied."""
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
        target = "RGB" if mode == "L" else mode
        turned = ImageCms.profileToProfile(
            image.convert(mode), source, ImageCms.createProfile("sRGB"), outputMode=target
        )
    except (ImageCms.PyCMSError, OSError, ValueError) as e:
        raise DataError(f"{where}: its colour profile cannot be used: {e}") from None
    assert turned is not None  # None is for changes in place
    return turned


def _rgb(image: Picture, where: str, *, composite: bool) -> Picture:
    """The picture in mode RGB and in sRGB: alpha composited on white, or dropped."""
    from PIL import Image

    _check_readable(image, where)
    if image.mode in GREY16_MODES:  # Pillow itself would clip to 255
        image = Image.fromarray(((np.asarray(image).astype(np.uint32) * 255 + 32_767) // 65_535).astype(np.uint8))
    image = _srgb(image, where)
    if composite and _has_alpha(image):
        image = image.convert("RGBA")
        image = Image.alpha_composite(Image.new("RGBA", image.size, (WHITE,) * 4), image)
    return image.convert("RGB")


def read_image(path: Path, size: tuple[int, int], *, downscale: int = 1, composite: bool = True) -> np.ndarray:
    """uint8 [H // downscale, W // downscale, 3], the mean of each block; the file must measure `size` = (W, H).

    composite: put a transparent image on white; otherwise its alpha is dropped (photographs).
    """
    with _open(path, "image", size) as image:
        check_downscale(size, downscale, str(path))
        try:
            rgb = _rgb(image, str(path), composite=composite)
        except (OSError, SyntaxError, ValueError) as e:
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
        except (OSError, SyntaxError, ValueError) as e:
            raise DataError(f"{path}: mask data is broken: {e}") from None


def check_downscale(size: tuple[int, int], downscale: int, where: str) -> None:
    """Refuse a downscale that leaves no pixel."""
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
