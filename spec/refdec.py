#!/usr/bin/env python3
"""The reference decoder of the `.pd4` format 3.0-draft, written from spec/format.md with the standard library alone.

    python -I -S spec/refdec.py FILE

prints the hashes of clause 12.4 as JSON. Faults give one line, `name: what`, and exit code 1. Above each function
stands the clause it follows, in the specification's words. It is meant to be read, not to be fast. One file, so that
it can be carried alone.
"""
# ruff: noqa: B905  (lengths agree by construction; strict= would only lengthen the lines)

import hashlib
import json
import math
import struct
import sys
import zlib
from bisect import bisect_right

SIGNATURE = bytes.fromhex("89504434 0D0A1A0A")
K = 1 << 24  # clause 14: coded symbols
MAX_SYMBOL = 1 << 23  # clause 14: symbols of attributes, plane samples and weights
MAX_VOXEL = 1 << 20
MAX_COUNT = 1 << 26
MAX_DICTIONARY = 1 << 26
FREE_ENTRIES, MORE_ENTRIES = 1 << 18, 1 << 10
VARINT_MAX = (1 << 35) - 1  # clause 7.1: five bytes of seven bits
TOTAL = 1 << 24
PLANES = (("xy", 0, 1), ("xz", 0, 2), ("xt", 0, 3), ("yz", 1, 2), ("yt", 1, 3), ("zt", 2, 3))
POSITIONS, MASKS, ATTRIBUTE_SECTION, PLANE_SECTION, WEIGHTS, SYMBOLS = range(6)


class Fault(Exception):
    """A fault of the file; `name` is one of clause 15."""

    def __init__(self, name, what):
        super().__init__(f"{name}: {what}")
        self.name = name


def need(ok, what, name="Malformed"):
    if not ok:
        raise Fault(name, what)


# 14 Limits: "A declared value over its limit is LimitExceeded, and nothing is allocated for it"
def limited(value, high, what, low=0):
    need(type(value) is int, f"{what} is not an integer")
    need(value <= high, f"{what} is {value}, limit {high}", "LimitExceeded")
    need(value >= low, f"{what} is {value}, expected at least {low}")
    return value


# 15 Errors and security: "UnsupportedFeature is an integer of whatever size and sign that is not a registered mode,
# predictor, network or prior family"
def registered(value, known, what):
    need(type(value) is int, f"{what} is not an integer")
    need(value in known, f"{what} is {value}, which is not registered", "UnsupportedFeature")
    return value


# 15 Errors and security: "Inside a payload, bytes that end early are Malformed"
class Reader:
    """Takes bytes from the front."""

    def __init__(self, data):
        self.data, self.at = data, 0

    @property
    def left(self):
        return len(self.data) - self.at

    def take(self, count):
        part = self.data[self.at : self.at + count]
        need(len(part) == count, f"{len(part)} bytes are left, expected {count}")
        self.at += len(part)
        return part

    def number(self, form):
        return struct.unpack(form, self.take(struct.calcsize(form)))[0]

    def byte(self, high=255):
        return limited(self.number("B"), high, "a byte")

    # 2.3 Reserved and unused: "A reserved bit or value MUST be zero or absent in a 3.0 file"
    def bits(self, used):
        value = self.byte()
        need(value >> used == 0, f"a byte is {value:#x}, expected {used} bits")
        return value

    # 7.1 Variable-length integers: "A varint holds seven bits per byte, least significant first; the high bit of a
    # byte says that another follows. It takes at most 5 bytes and MUST be in the shortest form"
    def varint(self, high):
        value = shift = 0
        while True:
            byte = self.byte()
            value |= (byte & 127) << shift
            if byte < 128:
                need(byte or not shift, "a varint is not in its shortest form")
                return limited(value, high, "a varint")
            shift += 7
            need(shift < 35, "a varint of more than 5 bytes")

    # 7.1 Variable-length integers: "A zigzag integer v is the varint 2v for v ≥ 0 and −2v − 1 for v < 0."
    def zigzag(self, high):
        return unzigzag(self.varint(2 * high))


def unzigzag(code):
    return -(code >> 1) - 1 if code & 1 else code >> 1


MSGPACK_SIZED = {  # first byte: (kind, form of the size, least size that needs this form)
    0xC4: ("bin", "B", 0),
    0xC5: ("bin", "H", 1 << 8),
    0xC6: ("bin", "I", 1 << 16),
    0xD9: ("str", "B", 32),
    0xDA: ("str", "H", 1 << 8),
    0xDB: ("str", "I", 1 << 16),
    0xDC: ("list", "H", 16),
    0xDD: ("list", "I", 1 << 16),
    0xDE: ("map", "H", 16),
    0xDF: ("map", "I", 1 << 16),
}


# 4 Canonical msgpack: "Header and layer parameters are one msgpack value each, in the one form that this clause
# allows."
def unpack(data):
    reader = Reader(data)
    value = msgpack_value(reader, 0)
    need(not reader.left, "bytes follow a msgpack value")
    return value


# 4 Canonical msgpack: "nil, float 64, ext and timestamp MUST NOT occur. Lists and maps are nested at most 4 deep, the
# outermost counted."
def msgpack_value(reader, depth):
    kind, value = msgpack_head(reader)
    if kind == "number":
        return value
    return msgpack_items(reader, kind, value, depth)


# 4 Canonical msgpack: "the shortest of positive fixint, uint 8, 16, 32, 64" "the shortest of negative fixint, int 8,
# 16, 32, 64" "float 32, finite."
def msgpack_head(reader):
    """(kind, number of bytes or entries that follow), or ("number", value)."""
    b = reader.byte()
    if b < 0x80 or b >= 0xE0:
        return "number", b if b < 0x80 else b - 256
    if b < 0xC0:
        return ("map", b & 15) if b < 0x90 else ("list", b & 15) if b < 0xA0 else ("str", b & 31)
    if b in (0xC2, 0xC3):
        return "number", b == 0xC3
    if b == 0xCA:
        return "number", check_finite(reader.number(">f"))
    if 0xCC <= b <= 0xCF:  # the second number: the first value that needs this form
        form, least = (("B", 1 << 7), ("H", 1 << 8), ("I", 1 << 16), ("Q", 1 << 32))[b - 0xCC]
        return "number", shortest(reader.number(">" + form), least)
    if 0xD0 <= b <= 0xD3:
        form, least = (("b", 1 << 5), ("h", 1 << 7), ("i", 1 << 15), ("q", 1 << 31))[b - 0xD0]
        return "number", -1 - shortest(-1 - reader.number(">" + form), least)
    need(b in MSGPACK_SIZED, f"msgpack byte {b:#x}")
    kind, form, least = MSGPACK_SIZED[b]
    return kind, shortest(reader.number(">" + form), least)


def shortest(value, least):
    need(value >= least, f"msgpack {value} is not in its shortest form")
    return value


# 4 Canonical msgpack: "(well-formed UTF-8)" "keys are integers 0..2^32 − 1, ascending, each once"
def msgpack_items(reader, kind, size, depth):
    if kind == "bin":
        return bytes(reader.take(size))
    if kind == "str":
        data = reader.take(size)
        text = data.decode(errors="replace")
        need(text.encode() == data, "a string is not UTF-8")
        return text
    need(depth < 4, "msgpack nested deeper than 4")
    if kind == "list":
        return [msgpack_value(reader, depth + 1) for _ in range(size)]
    result, last = {}, None
    for _ in range(size):
        key = msgpack_value(reader, depth + 1)
        need(type(key) is int and 0 <= key < 1 << 32, f"map key {key!r}, expected an integer below 2^32")
        need(last is None or key > last, f"map key {key} after {last}, expected ascending keys")
        result[key], last = msgpack_value(reader, depth + 1), key
    return result


def check_finite(value):
    need(math.isfinite(value), "a value is not finite")
    return value


# 4 Canonical msgpack: "a key under 64 that this text does not define is an UnsupportedFeature; unknown keys from 64
# on MUST be ignored. A missing required key is Malformed"
def fields(value, known, required, what):
    need(type(value) is dict, f"{what} is not a map")
    unknown = [key for key in value if key not in known and key < 64]
    need(not unknown, f"{what}: unknown critical key {unknown}", "UnsupportedFeature")
    missing = [key for key in required if key not in value]
    need(not missing, f"{what}: keys {missing} are missing")
    return value


def a_list(value, what, count=None):
    need(type(value) is list and count in (None, len(value)), f"{what}: expected a list of {count or 'some'} entries")
    return value


def reals(value, what, count):
    return [real(v, what) for v in a_list(value, what, count)]


def real(value, what):
    need(type(value) is float, f"{what}: expected float 32")
    return value


# 5.1 Header map: "Steps and voxel size MUST be positive normal binary32 values."
def a_step(value):
    need(value >= 2.0**-126, f"step {value!r}, expected a normal binary32")
    return value


# 3.1 Preamble: "It checks the signature, then the major version, then H against its limit, then the CRC-32."
def read_preamble(data):
    need(SIGNATURE.startswith(data[:8]), "not a .pd4 file", "BadSignature")
    need(len(data) >= 20, "the file ends in the preamble", "Truncated")
    major, _, size, crc = struct.unpack_from("<HHII", data, 8)
    need(major == 3, f"major version {major}, expected 3", "UnsupportedVersion")
    limited(size, 1 << 14, "the header's length")
    need(len(data) >= 20 + size, "the file ends in the header", "Truncated")
    header = data[20 : 20 + size]
    need(zlib.crc32(data[:16] + header) == crc, "the header's CRC-32 differs", "ChecksumMismatch")
    return read_header(header), 20 + size


# 5.1 Header map: "The time at 1 MUST NOT precede the time at 0, the background MUST lie in 0..1, 0 ≤ near < far and
# unit ≥ 0 MUST hold." "coding mode: 0 ans, 1 lzma; others UnsupportedFeature"
# 5.2 Chunk list: "In mode lzma each of them occurs at most once."
# 5.5 Digest: "The first 16 bytes of the SHA-256 of the payloads of all critical chunks that were encoded together"
def read_header(data):
    header = fields(unpack(data), range(1, 16), (1, 2, *range(4, 12), 13, 14, 15), "header")
    steps, box, (start, end), background, (near, far), _ = (
        reals(header[key], f"header key {key}", count)
        for key, count in ((4, 3), (6, 6), (7, 2), (8, 3), (9, 2), (10, 3))
    )
    voxel_size, unit = (real(header[key], f"header key {key}") for key in (5, 11))
    for step in (*steps, voxel_size):
        a_step(step)
    need(all(a <= b for a, b in zip(box[:3], box[3:])), "a lower corner of the box above the upper one")
    need(start <= end, f"time range {start}..{end}, expected it to ascend")
    need(all(0 <= c <= 1 for c in background), f"background {background}, expected 0..1")
    need(0 <= near < far, f"near {near} and far {far}, expected 0 <= near < far")
    need(unit >= 0, f"unit {unit}, expected 0 or more")
    if 12 in header:
        read_camera(header[12])
    read_error_bounds(header[13])
    need(type(header[14]) is bytes and len(header[14]) == 16, "the digest of the layers is not 16 bytes")
    for value, least, most in zip(a_list(header[15], "the widths", 3), (1, 1, 0), (64, 16, 7)):
        limited(value, most, "a width", least)
    for centre in a_list(header[3], "the centres", channel_count(header)) if 3 in header else ():
        limited(centre, MAX_SYMBOL, "a centre", -MAX_SYMBOL)
    read_chunk_list(header[1])
    registered(header[2], (0, 1), "the coding mode")
    layers = [kind for kind, _ in header[1] if kind < 3]
    need(header[2] == 0 or len(layers) == len(set(layers)), "a layer in several slices in mode lzma")
    return header


# 5.1 Header map: "feature width D, 1..64, slots G, 1..16, and V, 0..7"
# 11.2 Attributes: "The D + 6 + 3·G channels are the scalars of an anchor: feature 0 .. D − 1, scaling_log 0..5,
# offset 0 .. 3·G − 1."
def attribute_channels(header):
    feature, slots, _ = header[15]
    return {"feature": feature, "scaling_log": 6, "offset": 3 * slots}


def channel_count(header):
    return sum(attribute_channels(header).values())


# 6.3 Planes and networks: the outputs by id, None for any
def network_outputs(number, header):
    feature, slots, _ = header[15]
    return (
        {0: slots, 1: 7 * slots, 2: 3 * slots},
        {0: None, 1: 3, 2: feature, 3: 3 * slots, 4: 6},
    )[number > 0]


# 5.3 Camera map: "fx and fy MUST be positive" "All four are required."
def read_camera(value):
    camera = fields(value, range(1, 5), range(1, 5), "camera")
    reals(camera[1], "camera matrix", 12)
    fx, fy, _, _ = reals(camera[2], "camera intrinsics", 4)
    need(fx > 0 and fy > 0, f"focal lengths {fx} and {fy}, expected both positive")
    for key in (3, 4):
        limited(camera[key], 65535, "camera size", 1)


# 5.4 Error bounds: "Each value is a real B ≥ 0 in the unit of the tensors." "Keys 0..3 are required in the map"
def read_error_bounds(value):
    bounds = fields(value, range(8), range(4), "error bounds")
    for key in set(bounds) & set(range(8)):
        need(real(bounds[key], f"error bound {key}") >= 0, f"error bound {key} is {bounds[key]}, expected 0 or more")


# 5.2 Chunk list: "The first type MUST be 0; the types of layers among all entries MUST NOT descend"
def read_chunk_list(rows):
    limited(len(a_list(rows, "chunk list")), 1024, "the number of chunks", 1)
    for row in rows:
        kind, size = a_list(row, "a chunk", 2)
        limited(kind, 65535, "a chunk type")
        limited(size, (1 << 31) - 1, "a payload's length")
    layers = [kind for kind, _ in rows if kind in range(3)]
    need(rows[0][0] == 0, f"the first chunk has type {rows[0][0]}, expected 0")
    need(layers == sorted(layers), f"layers {layers}, expected them to ascend")


# 3.3 Scene identity: "the header from the end of its chunk list (the value of key 1, the first entry of the map)"
def behind_chunk_list(header):
    reader = Reader(header)
    msgpack_head(reader)
    for _ in ("key 1", "the chunk list"):
        msgpack_value(reader, 1)
    return reader.take(reader.left)


# 3.2 Chunks: "Type and length MUST equal those in the chunk list. Checks come in this order: L against its limit, L
# against the list, presence of the whole chunk, CRC-32, reserved flags, type, scene id, flag bit 0 against the type"
def read_chunk(data, at, kind, size, scene_id):
    need(len(data) >= at + 16, "the file ends in a chunk's head", "Truncated")
    found_kind, flags, found_size, found_id = struct.unpack_from("<HHI8s", data, at)
    limited(found_size, (1 << 31) - 1, "a payload's length")
    need(found_size == size, f"payload of {found_size} bytes, expected {size} as listed")
    end = at + 16 + size
    need(len(data) >= end + 4, "the file ends in a chunk", "Truncated")
    crc = struct.unpack_from("<I", data, end)[0]
    need(zlib.crc32(data[at:end]) == crc, f"the CRC-32 of the chunk at {at} differs", "ChecksumMismatch")
    need(flags & 0b111100 == 0, f"flags {flags:#x}, expected reserved bits 0")
    need(flags & 1 == 0 or flags == 1, f"flags {flags:#x} of an ancillary chunk")
    need(found_kind == kind, f"chunk type {found_kind}, expected {kind} as listed")
    check_scene_id(found_id, scene_id)
    check_critical(kind, flags & 1)
    return data[at + 16 : end], flags, end + 4


# 3.3 Scene identity: "Every chunk of a file, ancillary ones included, MUST carry it"
def check_scene_id(found, expected):
    need(found == expected, "the scene id is not that of the header")


# 3.4 Critical and ancillary chunks: "The chunk types of layers are critical: flag bit 0 MUST be zero there." "A
# critical chunk that holds no layer is an UnsupportedFeature when a decoder reaches it"
def check_critical(kind, ancillary):
    need(kind < 3 or ancillary, f"critical chunk of type {kind}", "UnsupportedFeature")
    need(kind >= 3 or not ancillary, "a layer marked as ancillary")


# 3.6 Slices: "The slices of a layer are numbered from 0 in their order" "Bit 1 MUST be 1 if the next layer chunk in the
# list is of the same layer, and 0 if it is of another one."
def check_slice(flags, number, kind, following):
    """following: the layers of the chunks behind it."""
    need(flags >> 6 == number, f"slice {flags >> 6} of layer {kind}, expected {number}")
    need(not following or (flags >> 1 & 1) == (following[0] == kind), f"flags {flags:#x} before layers {following}")


# 8 Coded channels: "Three prior lists begin with the priors that the earlier slices of the layer have defined in the
# same list: those of section 0, of section 1 and of the channels of 11.2 in section 2."
SHARED = (POSITIONS, MASKS, ATTRIBUTE_SECTION)


class Layer:
    """What one slice of a layer says: symbols {name: [int]} in the order of clause 12.4, and what dequantisation
    needs."""

    def __init__(self, number, later, rows_before, below, header, known):
        self.number, self.later, self.rows_before, self.header = number, later, rows_before, header
        self.known = known  # the prior lists that later slices go on with, by section
        self.below = below  # the scales of the layers before it
        self.rises = 0 if later else rows_before
        self.slices = [self]  # those of its layer, if it is the first
        self.symbols = {}
        self.tensors = {}  # {name: [float]}, every one a binary32 value


# 6.1 Layout: "The lengths of the sections MUST sum to the rest exactly."
def read_layer(payload, number, later, before, below, header, known):
    layer = Layer(number, later, before[0], below, header, known)
    reader = Reader(payload)
    parameters = reader.take(limited(reader.number("<I"), 4096, "the parameters' length"))
    read_parameters(layer, unpack(parameters))
    parts = {section: reader.take(layer.sections[section]) for section in sorted(layer.sections)}
    need(not reader.left, f"{reader.left} bytes after the sections")
    check_sizes(layer, len(payload), before)
    read_sections(layer, parts)
    return layer


# 6.2 Layer parameters: "The first slice of layer 0 MUST have keys 3 and 5 and neither 4 nor 6." "keys 3, 4 and 5 if the
# layer has a deformation, and MAY then have key 6; otherwise it has none of the four." "Later slices have none"
def read_parameters(layer, value):
    parameters = fields(value, range(1, 7), (1, 2), "layer parameters")
    layer.rows = limited(parameters[1], (1 << 24) - layer.rows_before, "own rows")
    sections = fields(parameters[2], range(6), (), "sections")
    layer.sections = {s: limited(sections[s], (1 << 31) - 1, "a section", 1) for s in sections if s < 64}
    if 6 in parameters:
        need(layer.number and 5 in parameters and not layer.later, "a key instant without a deformation")
        limited(parameters[6], 65535, "the key instant")
    found = sorted({3, 4, 5} & set(parameters))
    wanted = [[]] if layer.later else [[3, 4, 5], []] if layer.number else [[3, 5]]
    need(found in wanted, f"layer {layer.number} has keys {found}, expected one of {wanted}")
    layer.networks = read_networks(layer.number, layer.header, parameters[5]) if 5 in parameters else {}
    layer.deformed = bool(layer.networks) and layer.number > 0
    steps = reals(parameters[3], "steps", 1 + layer.deformed) if layer.networks else []
    layer.steps = [a_step(step) for step in steps]
    layer.scales = read_scales(parameters[4], layer.below) if layer.deformed else []
    check_bounded(layer)


# 5.4 Error bounds: "A layer with a deformation is Malformed without its keys: 4 and 5 for layer 1, 6 and 7 for layer 2"
def check_bounded(layer):
    classes = {2 + 2 * layer.number, 3 + 2 * layer.number} if layer.deformed else set()
    need(classes <= set(layer.header[13]), "no error bound for a deformation")


# 6.3 Planes and networks: "channels 1..256, the same in every scale of the file, resolutions 1..4096 along x, y, z, t,
# and one predictor per plane (11.3)."
def read_scales(rows, below):
    limited(len(a_list(rows, "scales")), 8, "the number of scales", 1)
    for row in rows:
        a_list(row, "a scale", 11)
        limited(row[0], 256, "plane channels", 1)
        need(row[0] == (below or rows)[0][0], "scales have different numbers of channels")
        for side in row[1:5]:
            limited(side, 4096, "a plane's side", 1)
        for predictor in row[5:]:
            registered(predictor, (0, 1), "a predictor")
    return rows


# 6.3 Planes and networks: "Ids ascend, each occurs once." "The last width o_m MUST be the number of outputs in this
# table" "Layer 0 MUST have all three networks, a deformation its trunk and at least one head."
def read_networks(number, header, rows):
    networks, last, known = {}, -1, network_outputs(number, header)
    for row in a_list(rows, "networks"):
        need(a_list(row, "a network"), "an empty network")
        key = registered(row[0], known, "a network's id")
        need(key > last, f"network {key} after {last}, expected ascending ids")
        limited(len(row) - 1, 16, "linear layers", 1)
        for width in row[1:]:
            limited(width, 4096, "a network's width", 1)
        need(known[key] in (None, row[-1]), f"network {key} has {row[-1]} outputs, expected {known[key]}")
        networks[key], last = row[1:], key
    if number == 0:
        need(len(networks) == 3, f"layer 0 has networks {list(networks)}, expected three")
    else:
        need(0 in networks, "a deformation without a trunk")
        need(len(networks) > 1, "a deformation without a head")
    return networks


# 6.3 Planes and networks: "Plane ab is an array [C, H, W] with H the resolution along b and W that along a: its rows
# follow b, its columns a."
def plane_shapes(layer):
    return [
        (f"planes.{s}.{name}", predictor, (scale[0], scale[1 + b], scale[1 + a]))
        for s, scale in enumerate(layer.scales)
        for (name, a, b), predictor in zip(PLANES, scale[5:])
    ]


# 6.3 Planes and networks: "Linear layer i is a weight [o_i, o_{i−1}] and a bias [o_i]; o_0 is the network's input
# width." "The input width is D in layer 0, but D + 3 (feature D, view direction 3) for network i if bit i of V is set.
# A trunk reads the scales of the layers before it in the file, then those of its own layer"
def weight_shapes(layer):
    shapes, (feature, _, viewing) = [], layer.header[15]
    for key, widths in layer.networks.items():
        width = sum(s[0] for s in layer.below + layer.scales) if layer.number else feature + 3 * (viewing >> key & 1)
        if layer.number and key:
            width = layer.networks[0][-1]
        for i, outputs in enumerate(widths):
            shapes += [(f"network.{key}.weight.{i}", outputs * width), (f"network.{key}.bias.{i}", outputs)]
            width = outputs
    return shapes


# 6.5 Declared sizes: "let N, S and L be sums over this slice and all slices before it in the file" "c MUST NOT exceed
# 2^28, N MUST NOT exceed 2^13 + 2·L, and S MUST NOT exceed 2^22 + 256·L."
def check_sizes(layer, payload_bytes, before):
    """before: N, S and L of the slices before it. Sets those with it."""
    samples = sum(c * h * w for _, _, (c, h, w) in plane_shapes(layer))
    need(samples <= 1 << 28, f"{samples} plane samples, limit 2^28", "LimitExceeded")
    row = channel_count(layer.header) + 4 + (3 in layer.header)
    symbols = layer.rises + row * layer.rows + samples + sum(size for _, size in weight_shapes(layer))
    layer.declared = [a + b for a, b in zip(before, (layer.rows, symbols, payload_bytes))]
    rows, symbols, size = layer.declared
    need(rows <= (1 << 13) + 2 * size, f"{rows} rows", "LimitExceeded")
    need(symbols <= (1 << 22) + 256 * size, f"{symbols} symbols", "LimitExceeded")


# 6.4 Sections: "Section 0 MUST be present if and only if n > 0, any other if and only if it has at least one symbol to
# code. Mode ans uses sections 0..4, mode lzma 0 and 5."
def read_sections(layer, parts):
    def part(section, count):
        need(section in parts or not count, f"section {section} is missing")
        return parts.pop(section, b"") if count else b""

    planes, weights, known = plane_shapes(layer), weight_shapes(layer), layer.known
    counts = {MASKS: [layer.rises, layer.rows], ATTRIBUTE_SECTION: []}
    counts[ATTRIBUTE_SECTION] = [layer.rows] * (channel_count(layer.header) + (3 in layer.header))
    counts[PLANE_SECTION] = [h * w for _, _, (c, h, w) in planes for _ in range(c)]
    counts[WEIGHTS] = [size for _, size in weights]
    positions = decode_positions(part(POSITIONS, layer.rows), layer.rows, known[POSITIONS])
    channels = {}
    if layer.header[2] == 1:
        flat = [count for section in counts for count in counts[section]]
        decoded = decode_lzma_symbols(part(SYMBOLS, sum(flat)), flat)
        for section in counts:
            channels[section], decoded = decoded[: len(counts[section])], decoded[len(counts[section]) :]
        step_classes(channels[ATTRIBUTE_SECTION][0] if 3 in layer.header else [])
    else:
        for section, sizes in counts.items():
            data = part(section, sum(sizes))
            if section == ATTRIBUTE_SECTION and sum(sizes):
                channels[section] = decode_attributes(data, sizes, 3 in layer.header, known[section])
            elif section == PLANE_SECTION and sizes:
                channels[section] = decode_planes(data, [shape for _, _, shape in planes])
            else:
                channels[section] = decode_channels(data, sizes, known.get(section))
    need(not parts, f"sections {sorted(parts)} are present for 0 symbols")
    keep_symbols(layer, positions, channels, planes, weights)


# 11.1 Masks: "Layer ℓ codes a rise 0..255 for each earlier row and a code 3..255 for each own row."
# 11.2 Attributes: "Attribute symbols, plane samples (11.3) and weight symbols MUST lie in −2^23..2^23, else
# Malformed."
def keep_symbols(layer, positions, channels, planes, weights):
    rise, own = channels[MASKS]
    need(all(v >= 0 for v in rise), "a mask code decreases")  # that neither is over 255 follows in finish_last
    need(all(v >= 3 for v in own), "a mask code under 3")
    layer.symbols = {"anchor": [v for cell in positions for v in cell], "mask_rise": rise, "mask_own": own}
    first = 0
    if 3 in layer.header:
        layer.symbols["step_class"], first = channels[ATTRIBUTE_SECTION][0], 1
    for name, width in attribute_channels(layer.header).items():  # [width, n], channel by channel
        layer.symbols[name] = [k for channel in channels[ATTRIBUTE_SECTION][first : first + width] for k in channel]
        first += width
    residuals = iter(channels[PLANE_SECTION])
    for name, predictor, (c, h, w) in planes:
        layer.symbols[name] = [k for _ in range(c) for k in restore(next(residuals), predictor, h, w)]
    layer.symbols |= {name: channel for (name, _), channel in zip(weights, channels[WEIGHTS])}
    valued = [name for name in layer.symbols if name not in ("anchor", "mask_rise", "mask_own", "step_class")]
    need(all(abs(k) <= MAX_SYMBOL for name in valued for k in layer.symbols[name]), "a symbol over 2^23")


# 11.3 Planes: "in row 0 N and NW are taken equal to W, in column 0 W and NW are taken equal to N, and at (0, 0) all
# three are 0."
def restore(residuals, predictor, h, w):
    k = list(residuals)
    for at in range(len(k)):
        i, j = divmod(at, w)
        west, north = k[at - 1] if j else 0, k[at - w] if i else 0
        corner = k[at - w - 1] if i and j else 0
        if i == 0:
            north = corner = west
        elif j == 0:
            west = corner = north
        if predictor == 0:
            k[at] += north
        else:
            k[at] += max(min(west, north), min(max(west, north), west + north - corner))
    return k


# 7.3 NormTable: "T[i] = round(2^28 (Φ(i/32) − 1/2)) for i = 0..256, T[257] = T[256] = 2^27 M[j] = round(2^(31 −
# j/64)) for j = 0..63"
T = [round(2**27 * math.erf(i / (32 * math.sqrt(2)))) for i in range(257)]
T.append(T[-1])
M = [round(2 ** (31 - j / 64)) for j in range(64)]


# 7.3 NormTable: "C = 2^27 − v if t < 0, else 2^27 + v"
def norm_cdf(n, mu8, si):
    e, j = si >> 6, si & 63
    nb = max(0, e - 8)
    result = []
    for k in range(n - 1):
        t = 256 * k + 128 - mu8
        a = min(abs(t) >> nb, (1 << 21) - 1)
        z = min((a * M[j]) >> (23 + e - nb), 1 << 19)
        i, f = z >> 11, z & 2047
        v = T[i] + (((T[i + 1] - T[i]) * f) >> 11)
        result.append((1 << 27) - v if t < 0 else (1 << 27) + v)
    return result


# 7.3 NormTable: "and the table cum[q] = ((C(q−1) · (2^24 − 16·n)) >> 28) + 16·q for 0 < q < n."
def table_of(cdf):
    n = len(cdf) + 1
    inner = [((c * (TOTAL - 16 * n)) >> 28) + 16 * q for q, c in enumerate(cdf, 1)]
    return [0, *inner, TOTAL]


# 7.5 ANS streams: "A stream is a multiple of 4 bytes: u32 words in the order in which the decoder takes them. It may
# be empty; its first word MUST NOT be 0."
class Ans:
    def __init__(self, data):
        need(len(data) % 4 == 0, "an ANS stream is not a multiple of 4 bytes")
        self.words, self.at, self.x = struct.unpack(f"<{len(data) // 4}I", data), 0, 0
        need(not self.words or self.words[0], "an ANS stream begins with a zero word")
        while self.x < 1 << 32 and self.at < len(self.words):
            self.x = self.x << 32 | self.words[self.at]
            self.at += 1

    # 7.5 ANS streams: "x = (x >> 24)·(cum[s+1] − cum[s]) + q − cum[s] if x < 2^32 and words are left: x = x·2^32 +
    # next word"
    def take(self, count, cum):
        if len(cum) == 2:
            return [0] * count
        result = []
        for _ in range(count):
            q = self.x & 0xFFFFFF
            s = bisect_right(cum, q) - 1
            self.x = (self.x >> 24) * (cum[s + 1] - cum[s]) + q - cum[s]
            if self.x < 1 << 32 and self.at < len(self.words):
                self.x = self.x << 32 | self.words[self.at]
                self.at += 1
            result.append(s)
        return result

    # 7.5 ANS streams: "x MUST be 0 and no word left, else Malformed"
    def finish(self):
        need(self.x == 0 and self.at == len(self.words), "an ANS stream does not end in state 0")


class Prior:
    """kmin, n: the window of clause 8.2; cum: its table."""

    def __init__(self, kmin, n, cum):
        self.kmin, self.n, self.cum = kmin, n, cum
        self.end = kmin + n


# 8.1 Parameter block: "a new prior of this family"
# 8.2 Priors: "In a window, kmin + n − 1 MUST NOT exceed K, else Malformed." "u8 weight 1..255 of the second"
def read_prior(reader, family):
    need(family <= 2, f"prior family {family}", "UnsupportedFeature")
    kmin = reader.zigzag(K)
    if family == 0:
        return Prior(kmin, 1, [0, TOTAL])
    n = 2 + reader.varint((1 << 14) - 2)
    need(kmin + n - 1 <= K, "a window reaches beyond symbol K")
    cdf = norm_cdf(n, *read_normal(reader, n))
    if family == 2:
        second = norm_cdf(n, *read_normal(reader, n))
        w = reader.byte()
        need(w, "a mixture of weight 0")
        cdf = [((256 - w) * c1 + w * c2) >> 8 for c1, c2 in zip(cdf, second)]  # clause 7.4
    return Prior(kmin, n, table_of(cdf))


# 8.2 Priors: "Of a normal, mu8 = g + 128·(n − 1) and si = v − 640."
def read_normal(reader, n):
    return reader.zigzag(1 << 31) + 128 * (n - 1), reader.varint(1920) - 640


# 8.3 Exceptions: "the symbol is kmin − 1 − (c >> 1) if c is odd, else kmin + n + (c >> 1)." "There MUST NOT be
# more exceptions than symbols, the symbol MUST lie in −K..K and its position within the channel, else Malformed."
def read_exceptions(reader, count, prior):
    number = 1 + reader.varint(VARINT_MAX)
    most = min(count, reader.left // 2)
    need(number <= most, f"{number} exceptions, expected at most {most}")
    result, at = {}, -1
    for _ in range(number):
        at += 1 + reader.varint(VARINT_MAX)
        c = reader.varint(4 * K + 2)
        value = prior.kmin - 1 - (c >> 1) if c & 1 else prior.end + (c >> 1)
        need(at < count, f"an exception at symbol {at} of {count}")
        need(abs(value) <= K, f"an exception of value {value}, limit K")
        result[at] = value
    return result


# 8.1 Parameter block: "For each non-empty channel in order: a varint token, at most 2·(2^26 + 8); the parameters of a
# new prior (8.2), if any; its exceptions (8.3), if bit 0 of the token is set."
# 8 Coded channels: "A section of coded channels has a prior list: the priors that it has defined so far, in their
# order."
# 14 Limits: "entries of all windows that a section of coded channels defines" "one per symbol of its channels, plus
# 2^10 if its prior list begins with priors of earlier slices (8), else plus 2^18"
def decode_channels(data, counts, known=None):
    """known: the priors of the slices before, to which those defined here are added."""
    reader, defined, heads = Reader(data), [] if known is None else known, []
    entries, most = 0, sum(counts) + (MORE_ENTRIES if defined else FREE_ENTRIES)
    for count in counts:
        if count == 0:
            continue
        need(count <= MAX_COUNT, f"a channel of {count} symbols, limit {MAX_COUNT}", "LimitExceeded")
        token = reader.varint(2 * (MAX_COUNT + 8))
        if token >> 1 < 8:
            defined.append(read_prior(reader, token >> 1))
            entries = limited(entries + defined[-1].n, most, "the entries of a section's tables")
        back = max(token >> 1, 8) - 8
        need(back < len(defined), "a channel reuses a prior before the first")
        prior = defined[-1 - back]
        heads.append((prior, read_exceptions(reader, count, prior) if token & 1 else {}))
    stream, heads = Ans(reader.take(reader.left)), iter(heads)
    channels = [take_channel(stream, count, *next(heads)) if count else [] for count in counts]
    stream.finish()
    return channels


# 8.4 Symbols: "the entries s of the prior's table. The symbol is kmin + s. Exceptions are then put in their places."
def take_channel(stream, count, prior, exceptions):
    symbols = [prior.kmin + s for s in stream.take(count - len(exceptions), prior.cum)]
    if not exceptions:
        return symbols
    inside = iter(symbols)
    return [exceptions[at] if at in exceptions else next(inside) for at in range(count)]


# 8.5 The attributes section: "Without header key 3, section 2 is one section of coded channels: the channels of 11.2,
# of n symbols each." "to the end of section 2, the section of the channels of 11.2. Each of them is coded as seven
# channels: for each step class 0..6 in order, the symbols of the rows of that class, in row order."
def decode_attributes(data, sizes, graded, known):
    """The step classes if there are any, then the channels of 11.2; sizes: of all these."""
    if not graded:
        return decode_channels(data, sizes, known)
    reader = Reader(data)
    grades = decode_grades(reader, sizes[0])
    return [grades, *decode_classes(reader.take(reader.left), [grades] * (len(sizes) - 1), 7, known)]


# 8.5 The attributes section: "a varint, the length in bytes of the section of the step classes (11.2), at most the
# bytes left in section 2, the varint's own included; then this section, with one channel of n symbols."
def decode_grades(reader, n):
    (grades,) = decode_channels(reader.take(reader.varint(reader.left)), [n])
    return step_classes(grades)


# 8.5 The attributes section: "Each symbol MUST lie in 0..6, else Malformed"
def step_classes(symbols):
    need(all(0 <= c <= 6 for c in symbols), "a step class over 6")
    return symbols


# 8.6 The planes section: "one per class (8.7), ascending, each with the residuals of the cells of that class in
# row-major order."
# 8 Coded channels: "Channels of length 0 leave no trace."
def decode_classes(data, classes, class_count, known=None):
    """The channels of a section, given the class of each place of each."""
    parts = map(iter, decode_channels(data, [own.count(q) for own in classes for q in range(class_count)], known))
    channels = []
    for own in classes:
        of_class = [next(parts) for _ in range(class_count)]
        channels.append([next(of_class[q]) for q in own])
    return channels


# 8.6 The planes section: "Stage 0 codes the plane channels 0 and 1, stage s ≥ 1 the plane channels 2^s .. 2^(s+1) − 1,
# as far as they exist. A stage codes scale by scale and plane by plane (6.3), in each plane its plane channels,
# ascending. In stage 0 each plane channel is one channel, with its residuals row by row."
def decode_planes(data, shapes):
    """The residuals, one list per scale, plane and plane channel; shapes: (channels, height, width) of each plane."""
    reader, channels = Reader(data), shapes[0][0]
    planes = [[] for _ in shapes]
    for s, stage in enumerate(take_stages(reader, max(1, (channels - 1).bit_length()))):
        number = min(2 << s, channels) - len(planes[0])
        if s == 0:
            decoded = decode_channels(stage, [h * w for _, h, w in shapes for _ in range(number)])
        else:
            classes = [classes_by_activity(cell_activity(e, h, w)) for e, (_, h, w) in zip(planes, shapes)]
            decoded = decode_classes(stage, [own for own in classes for _ in range(number)], 8)
        for e in planes:
            e += decoded[:number]
            del decoded[:number]
    return [channel for e in planes for channel in e]


# 8.6 The planes section: "The activity of cell (i, j), row i and column j, is the sum, over the nine cells (clip(i + a,
# 0, H − 1), clip(j + b, 0, W − 1)) with a and b in −1..1, of their relative magnitudes (8.7) in the residuals of the
# plane's channels in the stages before."
def cell_activity(channels, h, w):
    magnitude = relative_magnitude(channels, h * w)
    rows = [[min(max(i + a, 0), h - 1) for a in (-1, 0, 1)] for i in range(h)]
    columns = [[min(max(j + b, 0), w - 1) for b in (-1, 0, 1)] for j in range(w)]
    return [sum(magnitude[i * w + j] for i in near_i for j in near_j) for near_i in rows for near_j in columns]


# 8.6 The planes section: "Lengths are varints, each the number of bytes of a stage 0 .. S − 2, at most the bytes left
# in the section, the varint's own included; their sum MUST NOT exceed the bytes that follow the last length, else
# Malformed. The last stage takes the rest."
def take_stages(reader, number):
    sizes = [reader.varint(reader.left) for _ in range(number - 1)]
    return [reader.take(size) for size in sizes] + [reader.take(reader.left)]


# 8.7 Classes by activity: "Σ over channels c of (|e_c[p]| · 256·N) // (1 + s_c), s_c the sum over cells q of |e_c[q]|"
def relative_magnitude(channels, n):
    """Of each of the n cells."""
    magnitude = [0] * n
    for e in channels:
        s = sum(abs(v) for v in e)
        magnitude = [m + abs(v) * 256 * n // (1 + s) for m, v in zip(magnitude, e)]
    return magnitude


# 8.7 Classes by activity: "Let A be the activities of the cells in ascending order. The bounds are A[(i·N) // 8] for i
# in 1 .. 7, and the class of a cell, 0..7, is the number of bounds that are at most its activity."
def classes_by_activity(activity):
    ascending = sorted(activity)
    bounds = [ascending[i * len(ascending) // 8] for i in range(1, 8)]
    return [bisect_right(bounds, value) for value in activity]


# 9.3 LZMA2: "A stream is a list of chunks, each behind its control byte, and ends with the control byte 0."
def unpack_lzma(data, size):
    need(size <= 1 << 31, f"{size} bytes uncompressed, limit 2^31", "LimitExceeded")
    reader, out, start, lzma = Reader(data), bytearray(), None, None
    while control := reader.byte():
        need(control <= 2 or control >= 0x80, f"LZMA2 control byte {control:#x}")
        if control == 1 or control >= 0xE0:
            start, lzma = len(out), None
        need(start is not None, "the first LZMA2 chunk does not reset the dictionary")
        stored = control < 0x80
        end = len(out) + 1 + (reader.number(">H") | (0 if stored else control & 31) << 16)
        need(end <= size, f"an LZMA stream of more than {size} bytes")
        if stored:
            out += reader.take(end - len(out))
            continue
        length = 1 + reader.number(">H")
        if control >= 0xC0:
            lzma = Lzma(reader.byte())
        need(lzma, "an LZMA2 chunk without properties")
        if control >= 0xA0:
            lzma.reset()
        lzma.unpack(reader.take(length), out, start, end)
    need(len(out) >= size, f"an LZMA stream of {len(out)} bytes, expected {size}")
    need(not reader.left, "bytes after the end of an LZMA stream")
    return bytes(out)


# 9.3 LZMA2: "Symbols, contexts and the range decoder are those of the LZMA specification"
class Lzma:
    def __init__(self, properties):
        need(properties <= 224, f"LZMA properties {properties}")
        self.lc, self.lp, self.pb = properties % 9, properties // 9 % 5, properties // 45
        need(self.lc + self.lp <= 4, f"LZMA properties lc {self.lc}, lp {self.lp}")

    def reset(self):
        self.probabilities, self.state, self.distances = {}, 0, [1] * 4

    # 9.3 LZMA2: "A match MUST NOT reach back over the dictionary's reset nor beyond its chunk." "Its first packed byte
    # MUST be 0. After its last symbol and the normalisation that follows, the code MUST be 0"
    def unpack(self, data, out, start, end):
        """Appends the bytes of a chunk to `out`, up to `end`; the dictionary begins at `start`."""
        self.reader = Reader(data)
        need(self.reader.byte() == 0, "an LZMA2 chunk does not begin with 0")
        self.code, self.range = self.reader.number(">I"), 0xFFFFFFFF
        while len(out) < end:
            place = len(out) - start
            length = self.take_symbol(out, place)
            need(len(out) + length <= end, "a match beyond its chunk")
            need(not length or self.distances[0] <= min(place, MAX_DICTIONARY), "a match before the dictionary")
            for _ in range(length):
                out.append(out[-self.distances[0]])
        need(self.code == 0, "an LZMA2 chunk does not end in code 0")
        need(not self.reader.left, "bytes left in an LZMA2 chunk")

    def take_symbol(self, out, place):
        """Length of the next match, whose distance is the first of `distances`, or 0 after a literal."""
        state, low = self.state, place & (1 << self.pb) - 1
        if not self.bit("match", state, low):
            self.take_literal(out, place)
            self.state = 0 if state < 4 else state - (3 if state < 10 else 6)
            return 0
        if not self.bit("repeated", state):
            self.state = 7 if state < 7 else 10
            length = self.take_length("new", low)
            self.distances = [self.take_distance(min(length - 2, 3)), *self.distances[:3]]
            return length
        if not self.bit("other", state):
            if not self.bit("long", state, low):
                self.state = 9 if state < 7 else 11
                return 1
        else:
            which = 1 if not self.bit("not 1", state) else 2 if not self.bit("not 2", state) else 3
            self.distances.insert(0, self.distances.pop(which))
        self.state = 8 if state < 7 else 11
        return self.take_length("repeated", low)

    def take_literal(self, out, place):
        before = out[-1] if place else 0
        context = (place & (1 << self.lp) - 1) << self.lc | before >> 8 - self.lc
        expected = out[-self.distances[0]] if self.state >= 7 else None
        symbol = 1
        while symbol < 256:
            if expected is None:
                bit = self.bit("literal", context, symbol)
            else:  # behind a match: given the byte that would have gone on with it, as long as it is that
                guess = expected >> 8 - symbol.bit_length() & 1
                bit = self.bit("literal", context, guess, symbol)
                expected = expected if bit == guess else None
            symbol = symbol << 1 | bit
        out.append(symbol & 255)

    def take_length(self, kind, low):
        if not self.bit(kind, "choice", 0):
            return 2 + self.take_tree(3, kind, 0, low)
        if not self.bit(kind, "choice", 1):
            return 10 + self.take_tree(3, kind, 1, low)
        return 18 + self.take_tree(8, kind, 2)

    def take_distance(self, length):
        slot = self.take_tree(6, "slot", length)
        if slot < 4:
            return 1 + slot
        bits, distance = (slot >> 1) - 1, 2 | slot & 1
        if slot < 14:
            return 1 + (distance << bits) + self.take_reverse(bits, "distance", slot)
        for _ in range(bits - 4):
            distance = distance << 1 | self.take_even_bit()
        return 1 + (distance << 4) + self.take_reverse(4, "align")

    def take_tree(self, bits, *context):
        symbol = 1
        for _ in range(bits):
            symbol = symbol << 1 | self.bit(*context, symbol)
        return symbol - (1 << bits)

    def take_reverse(self, bits, *context):
        symbol, value = 1, 0
        for place in range(bits):
            bit = self.bit(*context, symbol)
            symbol, value = symbol << 1 | bit, value | bit << place
        return value

    def bit(self, *context):
        p = self.probabilities.get(context, 1 << 10)
        bound = (self.range >> 11) * p
        if self.code < bound:
            self.range, bit = bound, 0
            self.probabilities[context] = p + ((1 << 11) - p >> 5)
        else:
            self.code, self.range, bit = self.code - bound, self.range - bound, 1
            self.probabilities[context] = p - (p >> 5)
        self.normalise()
        return bit

    def take_even_bit(self):
        self.range >>= 1
        bit = int(self.code >= self.range)
        self.code -= bit * self.range
        self.normalise()
        return bit

    def normalise(self):
        if self.range < 1 << 24:
            self.range, self.code = self.range << 8, self.code << 8 | self.reader.byte()


# 9.2 Byte planes: "With byte planes, each channel's data are all least significant bytes first, then the next, and so
# on."
def split_numbers(raw, forms, planar):
    arrays, at = [], 0
    for form, count in forms:
        width = struct.calcsize(form)
        part = raw[at : at + count * width]
        at += len(part)
        if planar:
            part = bytes(part[plane * count + i] for i in range(count) for plane in range(width))
        arrays.append(list(struct.unpack(f"<{count}{form}", part)))
    return arrays


# 9.1 Symbols: "the symbol is base + v, which MUST lie in −K..K."
def decode_lzma_symbols(data, counts):
    if not data:
        return [[] for _ in counts]
    reader = Reader(data)
    planar = reader.bits(1)
    bases, forms = [], []
    for count in counts:
        need(count <= MAX_COUNT, f"a channel of {count} symbols, limit {MAX_COUNT}", "LimitExceeded")
        code = reader.varint(8 * K + 3) if count else 0
        need(code & 3 < 3, "a channel of 8-byte symbols")
        bases.append(unzigzag(code >> 2))
        forms.append(("bhi"[code & 3], count))
    size = sum(count * struct.calcsize(form) for form, count in forms)
    arrays = split_numbers(unpack_lzma(reader.take(reader.left), size), forms, planar)
    channels = [[base + v for v in array] for base, array in zip(bases, arrays)]
    need(all(abs(k) <= K for channel in channels for k in channel), "a symbol over K")
    return channels


# 10.3 Channels: "an index into the ascending list of the bytes in which k bits are 1"
PATTERNS = [[byte for byte in range(256) if bin(byte).count("1") == k] for k in range(9)]


# 10.1 Payload: "three zigzag varints, the minimum of the voxel indices along x, y, z, each at most 2^20 in magnitude;
# then a u8, the depth R, 0..21"
# 10.2 Counts: "Then, if n > 1, six varints, at most 2^26 each: how many nodes of all levels have 2, 3, .. 7 children.
# Their sum MUST NOT exceed the number of nodes with more than one child, else Malformed."
def decode_positions(data, count, known=None):
    if count == 0:
        return []
    reader = Reader(data)
    low, depth = [reader.zigzag(MAX_VOXEL) for _ in range(3)], reader.byte(21)
    levels = read_levels(reader, depth, count)
    sizes = [reader.varint(MAX_COUNT) for _ in range(2, 8)] if count > 1 else []
    several = sum(nodes - single for nodes, single in levels)
    need(sum(sizes) <= several, f"{sum(sizes)} nodes with 2 to 7 children, expected at most {several}")
    channels = decode_channels(reader.take(reader.left), channel_lengths(levels, count) + sizes, known)
    nodes = grow(levels, iter(channels), count, sizes)
    for axis in range(3):
        need(min(node[axis] for node in nodes) == 0, "no anchor at the minimum")
    need(max(v for node in nodes for v in node).bit_length() == depth, "the offsets have another depth than declared")
    cells = [tuple(p + m for p, m in zip(node, low)) for node in nodes]
    need(all(v <= MAX_VOXEL for cell in cells for v in cell), "a voxel index over 2^20")
    return cells


# 10.2 Counts: "two varints, at most 2^26 each: s, the number of its nodes with one child, and e, the sum of (number of
# children − 2) over its other nodes" "s ≤ N, e ≤ 6·(N − s) and 2·N − s + e ≤ n MUST hold, and after level 1 there
# MUST be n nodes, else Malformed."
def read_levels(reader, depth, count):
    """Per level, from the root's on: (number of nodes, number of nodes with one child)."""
    levels, nodes = [], 1
    for _ in range(depth):
        if nodes == count:
            levels.append((nodes, nodes))
            continue
        single, more = reader.varint(MAX_COUNT), reader.varint(MAX_COUNT)
        need(
            single <= nodes and more <= 6 * (nodes - single), f"{nodes} nodes, {single} with one child, {more} further"
        )
        levels.append((nodes, single))
        nodes = 2 * nodes - single + more
        need(nodes <= count, f"{nodes} nodes, expected at most {count}")
    need(nodes == count, f"{nodes} nodes at the end, expected {count}")
    return levels


# 10.3 Channels: "if N < n, one channel of the numbers of children less 1 of the nodes whose parent has one child, then
# one channel of the same numbers of the other nodes, the root included" "the child c of each node with one child"
def channel_lengths(levels, count):
    lengths, only = [], 0
    for nodes, single in levels:
        lengths += [only, nodes - only, single] if nodes < count else [single]
        only = single
    return lengths


# 10.3 Channels: "Symbols of item 1 MUST lie in 0..7, indices within their list, else Malformed."
def within(channel, size):
    need(all(0 <= k < size for k in channel), f"a symbol of the octree outside 0..{size - 1}")
    return iter(channel)


# 10.3 Channels: "The numbers of children MUST agree with 10.2, else Malformed: at each level s of them are 1 and their
# sum is the number of nodes of the next level, and over all levels as many are 2, 3, .. 7 as stated."
def grow(levels, channels, count, sizes):
    """The offsets (x, y, z) of the anchors, in Morton order."""
    steps, only_child = [], [False]
    for (nodes, single), (after, _) in zip(levels, [*levels[1:], (count, 0)]):
        children = [1] * nodes
        if nodes < count:
            of_one, of_more = within(next(channels), 8), within(next(channels), 8)
            children = [1 + next(of_one if only else of_more) for only in only_child]
            need(children.count(1) == single, f"{children.count(1)} nodes with one child, expected {single}")
            need(sum(children) == after, f"{sum(children)} children, expected {after}")
        only_child = [k == 1 for k in children for _ in range(k)]
        steps.append((children, within(next(channels), 8)))
    numbers = [k for children, _ in steps for k in children]
    need(not sizes or sizes == [numbers.count(k) for k in range(2, 8)], "other numbers of children than stated")
    indices = {k: within(next(channels), len(PATTERNS[k])) for k in range(2, 8) if sizes}
    nodes = [(0, 0, 0)]
    for children, octants in steps:
        nodes = [
            tuple(2 * p + (child >> axis & 1) for axis, p in enumerate(node))
            for node, k in zip(nodes, children)
            for child in children_of(k, octants, indices)
        ]
    return nodes


# 10.3 Channels: "Eight children have one pattern and no symbol."
def children_of(k, octants, indices):
    if k == 1:
        return [next(octants)]
    byte = PATTERNS[k][next(indices[k])] if k < 8 else 255
    return [child for child in range(8) if byte >> child & 1]


# 11.5 Dequantisation: "x̂ = binary32(binary64(k) · binary64(Q)): the product is exact, and the one rounding is to
# nearest, ties to even."
def dequantise(symbols, step):
    products, form = [k * step for k in symbols], f"<{len(symbols)}f"
    # From half a unit in the last place above the largest finite binary32 on, the rounding gives infinity.
    need(all(abs(v) < 2.0**128 - 2.0**103 for v in products), "a reconstructed value is not finite")
    return list(struct.unpack(form, struct.pack(form, *products)))


# 11.5 Dequantisation: "For an attribute, k is replaced by m + k·2^c" "m + k·2^c MUST lie in −2^23..2^23, else
# Malformed." "An anchor's position is dequantised from its voxel index with the voxel size as Q."
def dequantise_layer(layer):
    attributes = attribute_channels(layer.header)
    steps = dict(zip(attributes, layer.header[4])) | {"anchor": layer.header[5]}
    classes = layer.symbols.get("step_class", [0] * layer.rows)
    centres = iter(layer.header.get(3, [0] * channel_count(layer.header)))
    for name, symbols in layer.symbols.items():
        if name in attributes:  # [width, n] -> [n, width]
            own = [next(centres) for _ in range(attributes[name])]
            rows = [symbols[row :: layer.rows] for row in range(layer.rows)]
            symbols = [m + (k << c) for row, c in zip(rows, classes) for m, k in zip(own, row)]
            need(all(abs(k) <= MAX_SYMBOL for k in symbols), "an attribute over 2^23 steps")
        if name != "step_class" and not name.startswith("mask"):
            step = steps.get(name) or layer.steps[0 if name.startswith("planes") else -1]
            layer.tensors[name] = dequantise(symbols, step)


# 12.2 Prefixes: "The rows of a layer are those of its decoded slices, sorted by the Morton code (10.1) of the voxel
# index less the minimum over these rows."
def add_slice(layer, part):
    """Makes `part` the last slice of `layer`."""
    cells = [cell for own in (layer, part) for cell in zip(*[iter(own.symbols["anchor"])] * 3)]
    low = [min((cell[axis] for cell in cells), default=0) for axis in range(3)]
    order = sorted(range(len(cells)), key=lambda row: morton_code([v - m for v, m in zip(cells[row], low)]))
    classes = [("step_class", 1)] if 3 in layer.header else []
    for name, width in (("mask_own", 1), *classes, *attribute_channels(layer.header).items()):
        channels = []
        for c in range(width):
            both = [k for own in (layer, part) for k in own.symbols[name][c * own.rows : (c + 1) * own.rows]]
            channels += [both[row] for row in order]
        layer.symbols[name] = channels
    layer.symbols["anchor"] = [v for row in order for v in cells[row]]
    layer.rows, layer.declared = len(cells), part.declared
    layer.slices.append(part)


# 10.1 Payload: "bit 3i of the code is bit i of x, 3i + 1 of y, 3i + 2 of z"
# 12.2 Prefixes: "These codes may take 66 bits."
def morton_code(offset):
    return sum((v >> i & 1) << 3 * i + axis for axis, v in enumerate(offset) for i in range(22))


# 12.1 Order: "For each layer chunk, check before the next chunk is read: parameters and their limits, sections, the
# ranges of 11.1 and 11.2, sums of mask codes, each voxel at most once over the slices so far, and dequantisation."
# 11.1 Masks: "its code in the layer before in the file plus its rise, and MUST NOT exceed 255."
def finish_last(layers):
    codes = []
    for layer in layers:
        codes = [code + rise for code, rise in zip(codes, layer.symbols["mask_rise"])] + layer.symbols["mask_own"]
        need(not codes or max(codes) <= 255, "a mask code over 255")
    anchors = [v for layer in layers for v in layer.symbols["anchor"]]
    need(len(set(zip(*[iter(anchors)] * 3))) == len(anchors) // 3, "a voxel holds more than one anchor")
    dequantise_layer(layers[-1])


# 12.1 Order: "Read preamble and header, then the chunks in order." "A decoder of prefix ℓ stops after the last chunk of
# a layer ≤ ℓ in the list and reads no further."
# 3.2 Chunks: "Bytes after the last chunk make the file Malformed."
def decode(data, max_layer=None):
    """The layers of a file's bytes, or of prefix max_layer, each with `symbols` and `tensors` by name, flat and in C
    order."""
    header, at = read_preamble(data)
    scene_id = hashlib.sha256(behind_chunk_list(data[20:at])).digest()[:8]
    layers, declared = [], (0, 0, 0)
    stop = len(header[1])
    if max_layer is not None:
        stop = 1 + max(i for i, (kind, _) in enumerate(header[1]) if kind <= min(max_layer, 2))
    for i, (kind, size) in enumerate(header[1][:stop]):
        payload, flags, at = read_chunk(data, at, kind, size, scene_id)
        if kind < 3:
            later = bool(layers) and layers[-1].number == kind
            number, following = len(layers[-1].slices) if later else 0, [k for k, _ in header[1][i + 1 :] if k < 3]
            check_slice(flags, number, kind, following)
            below = [scale for own in layers for scale in own.scales]
            known = layers[-1].known if later else {section: [] for section in SHARED}
            read = read_layer(payload, kind, later, declared, below, header, known)
            if later:
                add_slice(layers[-1], read)
            else:
                layers.append(read)
            finish_last(layers)
            declared = read.declared
    need(max_layer is not None or at == len(data), "bytes follow the last chunk")
    return layers


# 12.4 Hashes: "Conformance is tested with two SHA-256 digests per layer, of its decoded slices with the rows of 12.2,
# printed in hexadecimal as a JSON list of {"layer", "symbols", "tensors"}."
def hashes(data, max_layer=None):
    rows = []
    for layer in decode(data, max_layer):
        symbols, tensors = hashlib.sha256(), hashlib.sha256()
        for values in layer.symbols.values():
            symbols.update(struct.pack(f"<{len(values)}i", *values))
        for values in layer.tensors.values():
            tensors.update(struct.pack(f"<{len(values)}f", *values))
        rows.append({"layer": layer.number, "symbols": symbols.hexdigest(), "tensors": tensors.hexdigest()})
    return rows


def main(arguments):
    if len(arguments) != 1:
        print("usage: refdec.py FILE", file=sys.stderr)
        return 2
    try:
        with open(arguments[0], "rb") as stream:
            data = stream.read()
        print(json.dumps(hashes(data)))
    except (Fault, OSError) as error:
        print(f"refdec: {arguments[0]}: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
