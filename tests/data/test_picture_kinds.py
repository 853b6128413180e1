"""Every pixel format of picture files is converted to sRGB or refused."""

import io
import random
import struct
import warnings
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageCms
from PIL.PngImagePlugin import PngInfo
from test_data_fuzz import damage_bytes

from pd4dgs_codec.data.files import image_info, read_image, read_mask
from pd4dgs_codec.errors import DataError

RAMP = np.arange(256, dtype=np.uint8).reshape(16, 16)
COLOUR = np.stack([RAMP, RAMP.T, 255 - RAMP], axis=-1)
ALPHA = np.where(RAMP > 100, 255, RAMP).astype(np.uint8)
ON_WHITE = np.rint(COLOUR * (ALPHA[..., None] / 255.0) + 255 - ALPHA[..., None]).astype(int)


def grey(levels: np.ndarray) -> np.ndarray:
    return np.repeat(levels[..., None], 3, axis=-1)


def palette() -> Image.Image:
    image = Image.fromarray(RAMP, "P")
    image.putpalette(np.stack([RAMP.ravel(), 255 - RAMP.ravel(), RAMP.ravel() // 2], axis=-1).tobytes())
    return image


def deep(wide: np.ndarray, path: Path) -> None:
    """A PNG of 16 bits a channel, uint16 [H, W, C] (C: 2 grey and alpha, 3 RGB, 4 RGBA), which Pillow cannot write."""
    height, width, channels = wide.shape

    def chunk(name: bytes, data: bytes) -> bytes:
        return len(data).to_bytes(4, "big") + name + data + zlib.crc32(name + data).to_bytes(4, "big")

    head = width.to_bytes(4, "big") + height.to_bytes(4, "big") + bytes([16, {2: 4, 3: 2, 4: 6}[channels], 0, 0, 0])
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in wide)
    parts = chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + parts)


def linear_profile() -> bytes:
    """An RGB profile of sRGB's primaries whose channels are linear in light: sRGB's own with its curves replaced."""
    data = bytearray(srgb_profile())
    curve = b"curv" + bytes(8)  # a curve of no points is the identity
    for i in range(int.from_bytes(data[128:132], "big")):
        entry = 132 + 12 * i
        offset = int.from_bytes(data[entry + 4 : entry + 8], "big")
        if data[entry : entry + 4] in (b"rTRC", b"gTRC", b"bTRC"):
            data[offset : offset + 12] = curve
            data[entry + 8 : entry + 12] = (12).to_bytes(4, "big")
        if data[entry : entry + 4] == b"desc":
            start = data.find("sRGB".encode("utf-16-be"), offset)
            data[start : start + 8] = "line".encode("utf-16-be")
    return bytes(data)


def from_linear(levels: np.ndarray) -> np.ndarray:
    """8-bit levels that are linear in light as those of sRGB (IEC 61966-2-1)."""
    light = levels / 255.0
    return 255 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


#: Writer, expected pixels, and the tolerance in levels.
READ = {
    "grey.png": (lambda p: Image.fromarray(RAMP).save(p), grey(RAMP), 0),
    "one-bit.png": (lambda p: Image.fromarray(RAMP > 99).save(p), grey(255 * (RAMP > 99)), 0),
    "grey-16.png": (lambda p: Image.fromarray(RAMP.astype(np.uint16) * 257).save(p), grey(RAMP), 0),
    "grey-16.tif": (lambda p: Image.fromarray(RAMP.astype(np.uint16) * 257).save(p), grey(RAMP), 0),
    "rgb.png": (lambda p: Image.fromarray(COLOUR).save(p), COLOUR, 0),
    "rgb.webp": (lambda p: Image.fromarray(COLOUR).save(p, lossless=True), COLOUR, 0),
    "rgb-16.png": (lambda p: deep(COLOUR.astype(np.uint16) * 257, p), COLOUR, 1),
    "palette.png": (lambda p: palette().save(p), np.asarray(palette().convert("RGB")), 0),
    "rgba.png": (lambda p: Image.fromarray(np.dstack([COLOUR, ALPHA])).save(p), ON_WHITE, 1),
    "rgba-16.png": (lambda p: deep(np.dstack([COLOUR, ALPHA]).astype(np.uint16) * 257, p), ON_WHITE, 1),
    "grey-alpha.png": (
        lambda p: Image.fromarray(np.dstack([RAMP, ALPHA]), "LA").save(p),
        grey(np.rint(RAMP * (ALPHA / 255.0) + 255 - ALPHA)),
        1,
    ),
    "key.png": (lambda p: Image.fromarray(RAMP).save(p, transparency=7), grey(np.where(RAMP == 7, 255, RAMP)), 0),
    "upright.jpg": (lambda p: Image.fromarray(grey(RAMP)).save(p, quality=100, exif=oriented(1)), grey(RAMP), 4),
    "srgb-profile.png": (lambda p: Image.fromarray(COLOUR).save(p, icc_profile=srgb_profile()), COLOUR, 0),
    "linear-profile.png": (
        lambda p: Image.fromarray(COLOUR).save(p, icc_profile=linear_profile()), from_linear(COLOUR), 3
    ),
}  # fmt: skip


def oriented(flag: int) -> bytes:
    exif = Image.Exif()
    exif[0x0112] = flag
    return exif.tobytes()


def srgb_profile() -> bytes:
    return ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()


def huge_tile(path: Path) -> None:
    """A TIFF file of 16 x 16 pixels in a tile of 26,752 x 26,752."""
    tags = {256: 16, 257: 16, 258: 8, 259: 5, 262: 1, 277: 1, 322: 26752, 323: 26752, 324: 8, 325: 64}
    rows = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags.items())
    path.write_bytes(b"II*\0" + struct.pack("<IH", 8, len(tags)) + rows + bytes(64))


def gamma_one() -> PngInfo:
    info = PngInfo()
    info.add(b"gAMA", (100_000).to_bytes(4, "big"))
    return info


def several_cut(path: Path) -> None:
    """A TIFF file of pictures whose second is not there."""
    stream = io.BytesIO()
    Image.fromarray(COLOUR).save(stream, "tiff", save_all=True, append_images=[Image.fromarray(COLOUR)] * 3)
    path.write_bytes(stream.getvalue()[: len(stream.getvalue()) // 4 + 100])


REFUSED = {
    "cmyk.jpg": (lambda p: Image.fromarray(COLOUR).convert("CMYK").save(p), "CMYK"),
    "lab.tif": (lambda p: Image.fromarray(COLOUR, "LAB").save(p), "LAB"),
    "float.tif": (lambda p: Image.fromarray(RAMP.astype(np.float32)).save(p), "pixels of kind F"),
    "int.tif": (lambda p: Image.fromarray(RAMP.astype(np.int32)).save(p), "pixels of kind I,"),
    "moving.png": (
        lambda p: Image.fromarray(COLOUR).save(p, save_all=True, append_images=[Image.fromarray(255 - COLOUR)]),
        "holds several pictures",
    ),
    "many-cut.tif": (several_cut, "holds several pictures"),  # counting them takes the square of their number
    "tile.tif": (huge_tile, "a tile: 715,669,504 pixels, expected 16,"),  # of 0.7 GB
    "gamma.png": (lambda p: Image.fromarray(COLOUR).save(p, pnginfo=gamma_one()), "gamma of 1"),
    "broken-profile.png": (lambda p: Image.fromarray(COLOUR).save(p, icc_profile=b"no profile"), "colour profile"),
    "key-16.png": (
        lambda p: Image.fromarray(RAMP.astype(np.uint16)).save(p, transparency=7), "16-bit grey with a transparent"
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", READ)
def test_readable_kinds(tmp_path, name):
    write, expected, tolerance = READ[name]
    write(tmp_path / name)
    got = read_image(tmp_path / name, (16, 16))
    assert got.dtype == np.uint8 and got.shape == (16, 16, 3)
    assert np.abs(got.astype(int) - expected).max() <= tolerance


@pytest.mark.parametrize("name", REFUSED)
def test_refused_kinds(tmp_path, name):
    write, says = REFUSED[name]
    write(tmp_path / name)
    with pytest.raises(DataError, match=f"{name}: .*{says}") as caught:
        read_image(tmp_path / name, (16, 16))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("compression", ["tiff_lzw", "tiff_adobe_deflate"])
def test_a_damaged_tiff_is_one_line_and_none_of_libtiff(tmp_path, compression, capfd):
    stream, path = io.BytesIO(), tmp_path / "a.tif"
    Image.fromarray(COLOUR).save(stream, "tiff", compression=compression)
    raw = bytearray(stream.getvalue())
    raw[12:20] = b"\xff" * 8  # the pixels start at 8
    path.write_bytes(raw)
    for read in (read_image, read_mask):
        with pytest.raises(DataError, match="(image|mask) data is broken: ") as caught:
            read(path, (16, 16))
        assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("kind", ["png", "jpeg", "webp", "bmp", "tiff"])
def test_damaged_pictures_and_masks_are_read_or_refused_in_one_line(tmp_path, kind, capfd):
    stream, path = io.BytesIO(), tmp_path / "a.bin"
    Image.fromarray(COLOUR).save(stream, kind, **({"compression": "tiff_lzw"} if kind == "tiff" else {}))
    whole, refused = stream.getvalue(), 0
    for seed in range(150):
        path.write_bytes(damage_bytes(whole, random.Random(seed)))
        try:
            with warnings.catch_warnings():  # as readers of folders do
                warnings.simplefilter("ignore")
                size = image_info(path)[:2]
                assert read_image(path, size).shape == (*size[::-1], 3)
                assert read_mask(path, size).shape == size[::-1]
        except DataError as error:
            assert str(path) in str(error) and "\n" not in str(error) and len(str(error)) < 300
            refused += 1
    assert refused > 20 and capfd.readouterr() == ("", "")
