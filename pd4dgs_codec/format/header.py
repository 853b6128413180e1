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
from pd4dgs_codec.format.parameters import Declared, as_step, pack_rows, unpack_kind, unpack_rows
from pd4dgs_codec.format.registry import LAYERS, MAX_ANCHORS, MAX_CHUNKS, MAX_PAYLOAD
from pd4dgs_codec.scene import Camera, SceneInfo
from pd4dgs_codec.tensors.quantise import MAX_SYMBOL, RowTable
from pd4dgs_codec.tensors.tables import Kind

# Keys of the header map.
CHUNKS, MODE, KIND, ROWS, CENTRE, VOXEL_SIZE, BOX, TIME_RANGE = range(1, 9)
BACKGROUND, NEAR_FAR, UP, UNIT, CAMERA, DIGEST, BASE = range(9, 16)
KEYS = set(range(CHUNKS, BASE + 1))
# Keys of the camera map.
VIEWMAT, INTRINSICS, WIDTH, HEIGHT = range(1, 5)

MAX_CAMERA_SIDE = 65535
DIGEST_SIZE = 16  #: bytes
BASE_DIGEST_SIZE = 32


@dataclass(frozen=True)
class Reference:
    """What a file says of its base, the layer 0 of another file (clause 5.6). scene_id: of that file. digest: SHA-256
    of the layer. rows: its anchors. bytes: that the digest covers."""

    scene_id: bytes
    digest: bytes
    rows: int
    bytes: int


@dataclass(frozen=True, eq=False)
class Header:
    """The file header. chunks: (type, payload length in bytes) in file order. kind: of the scene. table: of the rows.
    digest: payload_digest of the layers that were encoded together. base: None for a file that holds its scene whole.
    """

    chunks: tuple[tuple[int, int], ...]
    mode: str
    kind: Kind
    table: RowTable
    info: SceneInfo
    digest: bytes
    base: Reference | None = None

    @property
    def of_rows(self) -> object:
        """What rows mean and how they are coded, which a file shares with its base."""
        table = self.table
        return self.kind, table.tensors, table.graded, table.centre_values.tolist(), self.info.voxel_size

    @property
    def declared(self) -> Declared:
        """The sums before the first slice, which are those of the base."""
        if self.base is None:
            return Declared()
        width = self.table.channels + 4 + self.table.graded
        return Declared(self.base.rows, width * self.base.rows, self.base.bytes)


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
    if header.base is not None:
        fields[BASE] = list(vars(header.base).values())
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
    digest = _unpack_bytes(fields.get(DIGEST), DIGEST_SIZE, "digest of the layers")
    return Header(chunks, mode, kind, table, info, digest, _unpack_base(fields))


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
    return hashlib.sha256(identity_of(header)).digest()[:SCENE_ID_SIZE]


def identity_of(header: bytes) -> bytes:
    """Returns the header's bytes after its chunk list."""
    fields = canonical.unpack(header)
    map_head = 1 if len(fields) < 16 else 3
    chunk_list = len(canonical.pack(CHUNKS)) + len(canonical.pack(fields[CHUNKS]))
    return header[map_head + chunk_list :]


def _unpack_bytes(value: object, size: int, what: str) -> bytes:
    if not isinstance(value, bytes) or len(value) != size:
        raise Malformed(f"header: {what}, expected {size} bytes")
    return value


def _unpack_base(header: Fields) -> Reference | None:
    if BASE not in header:
        return None
    scene_id, digest, rows, size = header.sequence(BASE, 4)
    return Reference(
        _unpack_bytes(scene_id, SCENE_ID_SIZE, "scene id of the base"),
        _unpack_bytes(digest, BASE_DIGEST_SIZE, "digest of the base"),
        as_integer(rows, MAX_ANCHORS, "header: rows of the base"),
        as_integer(size, MAX_PAYLOAD, "header: bytes of the base", 1),
    )


def _unpack_chunks(value: object) -> tuple[tuple[int, int], ...]:
    chunks = []
    for i, row in enumerate(as_long(value, "header: chunks", MAX_CHUNKS)):
        found, size = as_list(row, f"header: chunk {i}", 2)
        kind = as_integer(found, 0xFFFF, f"header: type of chunk {i}")
        chunks.append((kind, as_integer(size, MAX_PAYLOAD, f"header: length of chunk {i}")))
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
