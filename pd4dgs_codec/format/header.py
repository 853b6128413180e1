"""The file header <-> canonical msgpack (clause 5): chunk list, coding mode, kind, rows, SceneInfo."""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pd4dgs_codec.errors import Malformed
from pd4dgs_codec.format import canonical
from pd4dgs_codec.format.canonical import Fields, as_integer, as_list, as_long
from pd4dgs_codec.format.container import PREAMBLE_SIZE, SCENE_ID_SIZE
from pd4dgs_codec.format.options import MODES
from pd4dgs_codec.format.parameters import as_step, pack_rows, unpack_kind, unpack_rows
from pd4dgs_codec.format.registry import LAYERS, MAX_CHUNKS, MAX_PAYLOAD
from pd4dgs_codec.scene import Camera, SceneInfo
from pd4dgs_codec.tensors.quantise import MAX_SYMBOL, RowTable
from pd4dgs_codec.tensors.tables import Kind

# Keys of the header map.
CHUNKS, MODE, KIND, ROWS, CENTRE, VOXEL_SIZE, BOX, TIME_RANGE = range(1, 9)
BACKGROUND, NEAR_FAR, UP, UNIT, CAMERA, DIGEST = range(9, 15)
KEYS = set(range(CHUNKS, DIGEST + 1))
# Keys of the camera map.
VIEWMAT, INTRINSICS, WIDTH, HEIGHT = range(1, 5)

MAX_CAMERA_SIDE = 65535
DIGEST_SIZE = 16  #: bytes


@dataclass(frozen=True, eq=False)
class Header:
    """The file header. chunks: (type, payload length in bytes) in file order. kind: of the scene. table: of the rows.
    digest: payload_digest of the layers that were encoded together."""

    chunks: tuple[tuple[int, int], ...]
    mode: str
    kind: Kind
    table: RowTable
    info: SceneInfo
    digest: bytes


def _f32(values: ArrayLike) -> list[float]:
    return [float(np.float32(v)) for v in np.ravel(values)]


def pack_header(header: Header) -> bytes:
    """Returns the header's bytes. Raises EncodeError for a value that canonical msgpack cannot hold."""
    info, table = header.info, header.table
    fields: dict[int, object] = {
        CHUNKS: [list(chunk) for chunk in header.chunks],
        MODE: MODES[header.mode],
        KIND: list(header.kind),
        ROWS: pack_rows(table.tensors),
        VOXEL_SIZE: _f32(info.voxel_size)[0],
        BOX: _f32(info.box),
        TIME_RANGE: _f32(info.time_range),
        BACKGROUND: _f32(info.background),
        NEAR_FAR: _f32([info.near, info.far]),
        UP: _f32(info.up),
        UNIT: _f32(info.unit)[0],
        DIGEST: header.digest,
    }
    if table.centre is not None:
        fields[CENTRE] = table.centre.tolist()
    if info.camera is not None:
        camera = info.camera
        fields[CAMERA] = {
            VIEWMAT: _f32(camera.viewmat[:3]),
            INTRINSICS: _f32(camera.K[[0, 1, 0, 1], [0, 1, 2, 2]]),
            WIDTH: int(camera.width),
            HEIGHT: int(camera.height),
        }
    return canonical.pack(fields)


def unpack_header(data: bytes) -> Header:
    """The inverse of pack_header. Raises subclasses of DecodeError."""
    fields = Fields(canonical.unpack(data, offset=PREAMBLE_SIZE), "header", KEYS)
    voxel_size = as_step(fields.get(VOXEL_SIZE), "header: voxel size")
    box = np.array(fields.reals(BOX, 6), dtype=np.float32).reshape(2, 3)
    if (box[0] > box[1]).any():
        raise Malformed("header: a lower corner of the box lies above the upper one")
    near, far = fields.reals(NEAR_FAR, 2)
    info = SceneInfo(
        voxel_size=voxel_size,
        box=box,
        time_range=fields.reals(TIME_RANGE, 2),  # type: ignore[arg-type]
        background=fields.reals(BACKGROUND, 3),  # type: ignore[arg-type]
        near=near,
        far=far,
        up=fields.reals(UP, 3),  # type: ignore[arg-type]
        unit=fields.real(UNIT),
        camera=_unpack_camera(fields.get(CAMERA)) if CAMERA in fields else None,
    )
    fault = info_fault(info)
    if fault is not None:
        raise Malformed(f"header: {fault}")
    chunks, mode = _unpack_chunks(fields.get(CHUNKS)), fields.choice(MODE, MODES)
    layers = layers_of(chunks)
    if mode == "lzma" and len(set(layers)) < len(layers):
        raise Malformed(f"header: layer chunks {layers} in mode lzma, expected each layer in one slice")
    kind, table = unpack_kind(fields.get(KIND), "header: kind"), _unpack_table(fields)
    return Header(chunks, mode, kind, table, info, _unpack_digest(fields.get(DIGEST)))


def info_fault(info: SceneInfo) -> str | None:
    """Returns the first rule that finite header values break, or None. Encoder and decoder both use it."""
    start, end = info.time_range
    rules = [
        (start <= end, f"time range {start}..{end}, expected it to ascend"),
        (all(0 <= c <= 1 for c in info.background), f"background {info.background}, expected 0..1"),
        (0 <= info.near < info.far, f"near {info.near} and far {info.far}, expected 0 <= near < far"),
        (info.unit >= 0, f"unit {info.unit}, expected 0 or more"),
    ]
    if info.camera is not None:
        fx, fy = float(info.camera.K[0, 0]), float(info.camera.K[1, 1])
        rules.append((fx > 0 and fy > 0, f"camera with focal lengths {fx} and {fy}, expected both positive"))
    return next((fault for holds, fault in rules if not holds), None)


def payload_digest(payloads: Iterable[bytes]) -> bytes:
    """Returns the header's digest, 16 bytes of the SHA-256 of the payloads of all encoded layers in file order."""
    digest = hashlib.sha256()
    for payload in payloads:
        digest.update(payload)
    return digest.digest()[:DIGEST_SIZE]


def scene_id_of(header: bytes) -> bytes:
    """Returns the scene id in every chunk of a file: the first 8 bytes of the SHA-256 of the header's bytes after its
    chunk list. So adding or removing chunks keeps the id. header: canonical, with a chunk list.
    """
    fields = canonical.unpack(header)
    map_head = 1 if len(fields) < 16 else 3
    chunk_list = len(canonical.pack(CHUNKS)) + len(canonical.pack(fields[CHUNKS]))
    return hashlib.sha256(header[map_head + chunk_list :]).digest()[:SCENE_ID_SIZE]


def _unpack_digest(value: object) -> bytes:
    if not isinstance(value, bytes) or len(value) != DIGEST_SIZE:
        raise Malformed(f"header: digest of the layers, expected {DIGEST_SIZE} bytes")
    return value


def _unpack_chunks(value: object) -> tuple[tuple[int, int], ...]:
    chunks = []
    for i, row in enumerate(as_long(value, "header: chunks", MAX_CHUNKS)):
        kind, length = as_list(row, f"header: chunk {i}", 2)
        chunks.append(
            (
                as_integer(kind, 0xFFFF, f"header: type of chunk {i}"),
                as_integer(length, MAX_PAYLOAD, f"header: length of chunk {i}"),
            )
        )
    layers = layers_of(chunks)
    if chunks[0][0] != 0 or layers != sorted(layers):
        raise Malformed(f"header: layer chunks {layers}, expected layer 0 first and the layers ascending")
    return tuple(chunks)


def layers_of(chunks: Iterable[tuple[int, int]]) -> list[int]:
    """Returns the layer of each slice in a chunk list."""
    return [kind for kind, _ in chunks if kind in LAYERS]


def _unpack_table(header: Fields) -> RowTable:
    table = RowTable(unpack_rows(header.get(ROWS), "header: rows"))
    if CENTRE not in header:
        return table
    values: list[Any] = header.sequence(CENTRE, table.channels)
    centre = [as_integer(m, MAX_SYMBOL, "header: a channel's centre", low=-MAX_SYMBOL) for m in values]
    return RowTable(table.tensors, np.array(centre, np.int32))


def _unpack_camera(data: object) -> Camera:
    fields = Fields(data, "header camera", {VIEWMAT, INTRINSICS, WIDTH, HEIGHT})
    viewmat = np.eye(4, dtype=np.float32)
    viewmat[:3] = np.array(fields.reals(VIEWMAT, 12), dtype=np.float32).reshape(3, 4)
    fx, fy, cx, cy = fields.reals(INTRINSICS, 4)
    return Camera(
        viewmat=viewmat,
        K=np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float32),
        width=fields.integer(WIDTH, MAX_CAMERA_SIDE, low=1),
        height=fields.integer(HEIGHT, MAX_CAMERA_SIDE, low=1),
    )
