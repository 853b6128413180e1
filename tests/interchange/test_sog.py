"""SOG files, written here by their specification, and by gaussforge."""

import io
import json
import zipfile

import numpy as np
import pytest
from PIL import Image
from test_kinds import equal, packed

from pd4dgs_codec.errors import DamageWarning, DataError
from pd4dgs_codec.interchange.splats import quiet, read_splats
from pd4dgs_codec.interchange.teacher import read_model
from pd4dgs_codec.kinds.splats import Splats

COUNT, WIDTH = 50, 8


def webp(values: np.ndarray, **options) -> bytes:
    """An image [h, w, 4], or [n, 4] of WIDTH pixels a row, the last ones empty."""
    if values.ndim == 2:
        values = np.concatenate([values, np.zeros((-len(values) % WIDTH, 4), np.uint8)]).reshape(-1, WIDTH, 4)
    stream = io.BytesIO()
    Image.fromarray(values).save(stream, "WEBP", **{"lossless": True, "exact": True} | options)
    return stream.getvalue()


def made(degree: int = 2) -> tuple[dict[str, bytes], dict, Splats]:
    """Members, what meta.json says, and the Gaussians that they stand for."""
    rng = np.random.default_rng(degree)

    def channels(count: int = COUNT) -> np.ndarray:
        return rng.integers(0, 256, (count, 4)).astype(np.uint8)

    low, high, sizes, base = channels(), channels(), channels(), channels()
    books = {name: np.sort(rng.normal(0, 1, 256)) for name in ("scales", "sh0", "shN")}
    quats = rng.normal(size=(COUNT, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    mode = np.abs(quats).argmax(axis=1)
    quats *= np.sign(quats[np.arange(COUNT), mode])[:, None]
    rest = np.stack([np.delete(q, m) for q, m in zip(quats, mode, strict=True)])
    rotations = np.concatenate([np.rint((rest / 2**0.5 + 0.5) * 255), 252 + mode[:, None]], axis=1).astype(np.uint8)
    least, most = np.array([-1.0, 0.5, -2]), np.array([1.0, 2, 2])
    logs = least + (low[:, :3] + 256.0 * high[:, :3]) / 65535 * (most - least)
    sh = [books["sh0"][base[:, None, :3]]]
    meta = {
        "version": 2, "count": COUNT, "means": {"mins": least.tolist(), "maxs": most.tolist(), "files": ["l", "u"]},
        "quats": {"files": ["q"]}, "scales": {"codebook": books["scales"].tolist(), "files": ["s"]},
        "sh0": {"codebook": books["sh0"].tolist(), "files": ["c"]},
    }  # fmt: skip
    members = {"l": webp(low), "u": webp(high), "q": webp(rotations), "s": webp(sizes), "c": webp(base)}
    if degree:
        width = (degree + 1) ** 2 - 1
        palettes, labels = channels(5 * 64 * width).reshape(5, 64 * width, 4), channels()
        labels[:, :2] = np.stack(np.divmod(rng.integers(0, 320, COUNT), 256)[::-1], axis=1)
        meta["shN"] = {"bands": degree, "count": 320, "codebook": books["shN"].tolist(), "files": ["p", "i"]}
        members |= {"p": webp(palettes), "i": webp(labels)}
        chosen = labels[:, 0] + 256 * labels[:, 1].astype(int)
        own = [palettes[k // 64, k % 64 * width : (k % 64 + 1) * width, :3] for k in chosen]
        sh.append(books["shN"][np.stack(own)])
    splats = Splats(
        np.sign(logs) * (np.exp(np.abs(logs)) - 1), quats, np.exp(books["scales"][sizes[:, :3]]), base[:, 3] / 255,
        np.concatenate(sh, axis=1),
    )  # fmt: skip
    return members, meta, splats


def archive(members: dict[str, bytes], meta: object, kind: int = zipfile.ZIP_STORED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", kind) as file:
        for name, data in members.items():
            file.writestr(name, data)
        file.writestr("meta.json", meta if isinstance(meta, bytes) else json.dumps(meta))
    return stream.getvalue()


@pytest.mark.parametrize("degree", range(4))
def test_every_part_is_as_specified(tmp_path, degree):
    members, meta, expected = made(degree)
    (tmp_path / "a.ply").write_bytes(archive(members, meta, zipfile.ZIP_DEFLATED if degree else zipfile.ZIP_STORED))
    found = read_splats(tmp_path / "a.ply")
    assert found.degree == degree
    turns = np.abs(np.einsum("nd,nd->n", found.quats, expected.quats))
    assert turns.min() > 0.9999  # a byte for each component
    equal(found, Splats(**vars(expected) | {"quats": found.quats}))


def test_as_another_program_reads_what_it_writes(tmp_path):
    forge = pytest.importorskip("gaussforge").GaussForge()
    (tmp_path / "a.sog").write_bytes(data := packed("sog"))
    with quiet():
        (tmp_path / "a.ply").write_bytes(bytes(forge.convert(data, "sog", "ply")["data"]))
    equal(read_splats(tmp_path / "a.sog"), read_splats(tmp_path / "a.ply"))


def test_a_rotation_of_no_known_mode_is_left_out(tmp_path):
    members, meta, _ = made()
    members["q"] = webp(np.full((COUNT, 4), [9, 9, 9, 251], np.uint8))
    (tmp_path / "a.sog").write_bytes(archive(members, meta))
    with pytest.raises(DataError, match="a.sog: none of 50 Gaussians is finite"):
        read_splats(tmp_path / "a.sog")
    some = np.full((COUNT, 4), [128, 128, 128, 252], np.uint8)
    some[:9, 3] = 0
    members["q"] = webp(some)
    (tmp_path / "a.sog").write_bytes(archive(members, meta))
    with pytest.warns(DamageWarning, match="9 of 50 Gaussians are left out"):
        assert len(read_splats(tmp_path / "a.sog").means) == 41


def test_broken_files_are_one_line(tmp_path):
    members, meta, _ = made()
    whole, large = archive(members, meta), bytearray(members["c"])
    large[21:25] = ((16383 << 14) + 16383 | 1 << 28).to_bytes(4, "little")
    far = np.zeros((COUNT, 4), np.uint8)
    far[3, 1] = 2  # 512 of 320
    old = {"means": {"shape": [50, 3], "mins": [0], "maxs": [1], "files": ["l", "u"]}}
    cases = [
        (whole[:-60], "is a damaged SOG file .BadZipFile"),
        (archive(members, old), "is a SOG file of version None, expected 2: convert it with splat-transform"),
        (archive(members, b"{"), "is a damaged SOG file .JSONDecodeError"),
        (archive(members, b"[" * 9000), "is a damaged SOG file .RecursionError"),
        (archive(members, b"[]"), "is a damaged SOG file .AttributeError"),
        (archive(members, meta | {"count": 57}), "means has 56 pixels, expected one for each of 57 Gaussians"),
        (archive(members, meta | {"count": 1e400}), "meta.json: count"),
        (archive(members, meta | {"count": "many"}), "meta.json: count"),
        (archive(members, meta | {"sh0": {"files": ["c"]}}), "is a damaged SOG file .KeyError"),
        (archive(members, meta | {"sh0": meta["sh0"] | {"codebook": [1.0] * 9}}), "damaged SOG file .IndexError"),
        (archive(members, meta | {"quats": {"files": ["gone"]}}), "is a damaged SOG file .KeyError"),
        (archive(members | {"c": bytes(large)}, meta), "c: expected WebP without loss, of no more pixels than fit"),
        (archive(members | {"c": webp(far, lossless=False)}, meta), "c: expected WebP without loss"),
        (archive(members | {"c": members["c"][:60]}, meta), "is a damaged SOG file"),
        (archive(members | {"i": webp(far)}, meta), "is a damaged SOG file .IndexError"),
        (archive(members | {"c": bytes(1 << 24)}, meta, zipfile.ZIP_DEFLATED), "c unpacks to more bytes"),
        (archive(members, b" " * (1 << 24), zipfile.ZIP_DEFLATED), "meta.json unpacks to more bytes than expected"),
        (archive(members, meta | {"means": meta["means"] | {"mins": [float("nan")] * 3}}), "none of 50 Gaussians"),
    ]
    for data, message in cases:
        (tmp_path / "a.sog").write_bytes(data)
        with pytest.raises(DataError, match=message) as error:
            read_splats(tmp_path / "a.sog")
        assert str(error.value).startswith(str(tmp_path / "a.sog: ")) and "\n" not in str(error.value)


def test_frames_may_be_sog_files(tmp_path):
    members, meta, _ = made(0)
    for i in range(3):
        meta["means"]["maxs"][0] = 1.0 + i
        (tmp_path / f"{i}.sog").write_bytes(archive(members, meta))
    model = read_model(str(tmp_path), 30)
    assert model.times == (0.0, 0.5, 1.0) and np.ptp([model.splats(t).means for t in model.times], axis=0).max() > 1
