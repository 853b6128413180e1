#!/usr/bin/env python3
"""The reference decoder of the `.pd4` format 5.0-draft, written from spec/format.md with the standard library alone.

    python -I -S spec/refdec.py FILE [BASE]

prints the hashes of clause 12.4 as JSON. BASE is the base of FILE (5.6), if it has one. Faults give one line, `name:
what`, and exit code 1. Above the functions stand the clauses they follow, in the specification's words. It is meant to
be read, not to be fast. One file, so that it can be carried alone. It yields tensors and knows no kinds (clause 13).
"""
# ruff: noqa: B905, B020  (lengths agree by construction; loops fill self.steps)

import hashlib
import json
import lzma
import math
import struct
import sys
import zlib
from bisect import bisect_right
from pathlib import Path

SIGNATURE = bytes.fromhex("89504434 0D0A1A0A")
K = 1 << 24  # clause 14: coded symbols
MAX_SYMBOL = 1 << 23  # clause 14: symbols of rows, plane samples, weights and biases
MAX_VOXEL = 1 << 20
MAX_LENGTH = (1 << 31) - 1
VARINT_MAX = (1 << 35) - 1  # clause 7.1: five bytes of seven bits
TOTAL = 1 << 24


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


# 15 Errors and security: "an integer of whatever size and sign that is not a registered mode, predictor"
def registered(value, what, count=2):
    need(type(value) is int, f"{what} is not an integer")
    need(0 <= value < count, f"{what} is {value}, which is not registered", "UnsupportedFeature")
    return value


# 4 Canonical msgpack: "A list whose length this text gives as a range is LimitExceeded if it is longer."
def a_list(value, what, least, most=None):
    need(type(value) is list, f"{what}: expected a list")
    if most is None:
        need(len(value) == least, f"{what}: {len(value)} entries, expected {least}")
    else:
        limited(len(value), most, f"the length of {what}", least)
    return value


def ranged(symbols, low, high, what):
    need(all(low <= k <= high for k in symbols), f"{what} outside {low}..{high}")
    return symbols


def integers(values, high, what, low=0):
    return [limited(value, high, what, low) for value in values]


def reals(values, count, what, low=-math.inf, high=math.inf):
    for value in a_list(values, what, count):
        need(type(value) is float and low <= value <= high, f"{what}: {value!r}, expected a real {low}..{high}")
    return values


# 5.1 Header map: "Steps and voxel size MUST be positive normal binary32 values."
def a_step(value):
    return reals([value], 1, "a step", 2.0**-126)[0]


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

    # 7.1 Variable-length integers: "It takes at most 5 bytes and MUST be in the shortest form"
    def varint(self, high):
        value = shift = 0
        while True:
            byte = self.number("B")
            value |= (byte & 127) << shift
            if byte < 128:
                need(byte or not shift, "a varint is not in its shortest form")
                return limited(value, high, "a varint")
            shift += 7
            need(shift < 35, "a varint of more than 5 bytes")

    # 7.1 Variable-length integers: "2v for v ≥ 0 and −2v − 1 for v < 0"
    def zigzag(self, high):
        return unzigzag(self.varint(2 * high))


def unzigzag(code):
    return -(code >> 1) - 1 if code & 1 else code >> 1


MSGPACK = {  # first byte: (kind, form of the number behind it, least bits of the numbers that need this form)
    first + i: (kind, form, least)
    for first, kind, forms, bits in (
        (0xC4, "bin", "BHI", (0, 9, 17)),
        (0xCC, "int", "BHIQ", (8, 9, 17, 33)),
        (0xD0, "int", "bhiq", (6, 8, 16, 32)),  # of -1 - the number
        (0xD9, "str", "BHI", (6, 9, 17)),
        (0xDC, "list", "HI", (5, 17)),
        (0xDE, "map", "HI", (5, 17)),
    )
    for i, (form, least) in enumerate(zip(forms, bits))
}


# 4 Canonical msgpack: "No nil, float 64, ext and timestamp may occur." "float 32, finite."
def msgpack(reader, depth=0):
    b = reader.number("B")
    if b < 0x80 or b >= 0xE0:
        return b if b < 0x80 else b - 256
    if b in (0xC2, 0xC3):
        return b == 0xC3
    if b == 0xCA:
        value = reader.number(">f")
        need(math.isfinite(value), "a value is not finite")
        return value
    if b < 0xC0:
        kind, size = ("map", b & 15) if b < 0x90 else ("list", b & 15) if b < 0xA0 else ("str", b & 31)
    else:
        need(b in MSGPACK, f"msgpack byte {b:#x}")
        kind, form, least = MSGPACK[b]
        size = reader.number(">" + form)
        need((size if form.isupper() else ~size) >= 1 << least >> 1, f"msgpack {size} is not in its shortest form")
    return size if kind == "int" else msgpack_items(reader, kind, size, depth)


# 4 Canonical msgpack: "Lists and maps are nested at most 4 deep, the outermost counted."
def msgpack_items(reader, kind, size, depth):
    if kind in ("bin", "str"):
        data = bytes(reader.take(size))
        need(kind == "bin" or data.decode(errors="replace").encode() == data, "a string is not UTF-8")
        return data if kind == "bin" else data.decode()
    need(depth < 4, "msgpack nested deeper than 4")
    if kind == "list":
        return [msgpack(reader, depth + 1) for _ in range(size)]
    result, last = {}, -1
    for _ in range(size):
        key = msgpack(reader, depth + 1)
        need(type(key) is int and last < key < 1 << 32, f"map key {key!r} after {last}")
        result[key], last = msgpack(reader, depth + 1), key
    return result


# 4 Canonical msgpack: "Any other form, and bytes behind the value, are Malformed."
def unpack(data):
    reader = Reader(data)
    value = msgpack(reader)
    need(not reader.left, "bytes follow a msgpack value")
    return value


# 4 Canonical msgpack: "a key under 64 that this text does not define is an UnsupportedFeature"
def fields(value, known, required, what):
    need(type(value) is dict, f"the {what} is not a map")
    unknown = [key for key in value if key not in known and key < 64]
    need(not unknown, f"{what}: unknown critical key {unknown}", "UnsupportedFeature")
    missing = [key for key in required if key not in value]
    need(not missing, f"{what}: keys {missing} are missing")
    return value


# 3.1 Preamble: "It checks the signature as far as it goes, that 20 bytes are there, the major version, H against its
# limit, that H bytes follow, and the CRC-32, in this order."
# 3.3 Scene identity: "the first 8 bytes of the SHA-256 of the header from the end of its chunk list"
def read_preamble(data):
    need(SIGNATURE.startswith(data[:8]), "not a .pd4 file", "BadSignature")
    need(len(data) >= 20, "the file ends in the preamble", "Truncated")
    major, _, size, crc = struct.unpack_from("<HHII", data, 8)
    need(major == 5, f"major version {major}, expected 5", "UnsupportedVersion")
    limited(size, 1 << 14, "the header's length")
    need(len(data) >= 20 + size, "the file ends in the header", "Truncated")
    header = data[20 : 20 + size]
    need(zlib.crc32(data[:16] + header) == crc, "the header's CRC-32 differs", "ChecksumMismatch")
    fields_of, reader = read_header(header), Reader(header)
    reader.take({0xDE: 3, 0xDF: 5}.get(header[0], 1))  # the head of the map
    for _ in ("key 1", "the chunk list"):
        msgpack(reader, 1)
    fields_of["identity"] = reader.take(reader.left)
    return fields_of, hashlib.sha256(fields_of["identity"]).digest()[:8], 20 + size


# 5.5 Digest: "The first 16 bytes of the SHA-256 of the payloads"
# 5.1 Header map: "The time at 1 MUST NOT precede the time at 0, the background MUST lie in 0..1"
def read_header(data):
    header = fields(unpack(data), range(1, 16), (1, 2, 3, 4, *range(6, 13), 14), "header")
    read_chunk_list(header[1], registered(header[2], "the coding mode"))
    read_kind(header[3])
    read_scalars(header)
    a_step(header[6])
    x0, y0, z0, x1, y1, z1 = reals(header[7], 6, "the box")
    (start, end), (near, far) = reals(header[8], 2, "the times"), reals(header[10], 2, "near and far", 0)
    for low, high in ((x0, x1), (y0, y1), (z0, z1), (start, end)):
        need(low <= high, f"the box or the times: {low} above {high}")
    need(near < far, f"near {near} and far {far}, expected near < far")
    reals(header[9], 3, "the background", 0, 1)
    reals(header[11], 3, "up")
    reals([header[12]], 1, "the unit", 0)
    if 13 in header:
        read_camera(header[13])
    need(type(header[14]) is bytes and len(header[14]) == 16, "the digest of the layers is not 16 bytes")
    if 15 in header:
        read_reference(header[15])
    return header


# 5.6 Base: "The key holds the base's scene id (3.3), its digest, the number b of its rows, 0..2^24, and the number P"
def read_reference(value):
    *names, rows, size = a_list(value, "the base", 4)
    need([type(v) is bytes and len(v) for v in names] == [8, 32], "not a scene id of 8 and a digest of 32 bytes")
    limited(rows, 1 << 24, "the base's rows")
    limited(size, MAX_LENGTH, "the base's bytes", 1)


# 5.2 Chunk list: "The first type MUST be 0; the types of layers among all entries MUST NOT descend."
def read_chunk_list(rows, mode):
    for kind, size in (a_list(row, "a chunk", 2) for row in a_list(rows, "the chunk list", 1, 1024)):
        limited(kind, 65535, "a chunk type")
        limited(size, MAX_LENGTH, "a payload's length")
    layers = [kind for kind, _ in rows if kind < 3]
    need(rows[0][0] == 0, f"the first chunk has type {rows[0][0]}, expected 0")
    need(layers == sorted(layers), f"layers {layers}, expected them to ascend")
    need(mode == 0 or len(layers) == len(set(layers)), "a layer in several slices in mode lzma")


# 13.1 Kinds: "A decoder of tensors checks this form and nothing else of a kind."
def read_kind(value):
    integers(a_list(value, "a kind", 1, 16), 65535, "a number of a kind")


# 5.4 Rows: "ids ascend strictly"
# 6.3 Grids and chains: "Ids of grids ascend strictly, and so do those of chains."
def table(tensors, what, *lengths):
    """Yields the tensors, lists of these lengths that begin with an id."""
    last = -1
    for tensor in tensors:
        identity = limited(a_list(tensor, what, *lengths)[0], 255, "an id")
        need(identity > last, f"id {identity} after {last}, expected ascending ids")
        last = identity
        yield tensor


# 5.4 Rows: "Each tensor is [id, C, Q, p] with an id 0..255, C = 1..256 channels, a step Q and a predictor p"
# 6.2 Layer parameters: "tensors that only this layer has, with the rules and limits of 5.4 but no centres"
def read_rows(value, form):
    """[(name, channels, step, predictor)] and the number of all channels."""
    result = []
    for tensor in table(a_list(value, "the rows", 1, 32), "a tensor of rows", 4):
        channels = limited(tensor[1], 256, "the number of channels", 1)
        result.append((f"{form}.{tensor[0]}", channels, a_step(tensor[2]), registered(tensor[3], "a predictor", 3)))
    return result, limited(sum(row[1] for row in result), 512, "the number of channels of all rows")


# 5.4 Rows: "If key 5 is there, the anchors have step classes (11.2), and the key gives each channel a centre"
def read_scalars(header):
    header["rows"], width = read_rows(header[4], "row")
    header["graded"] = 5 in header
    header["centres"] = a_list(header.get(5, [0] * width), "the centres", width)
    integers(header["centres"], MAX_SYMBOL, "a centre", -MAX_SYMBOL)


# 5.3 Camera map: "fx and fy MUST be positive" "All four are required."
def read_camera(value):
    camera = fields(value, range(1, 5), range(1, 5), "camera")
    reals(camera[1], 12, "the camera's matrix")
    fx, fy, _, _ = reals(camera[2], 4, "the camera's intrinsics")
    need(fx > 0 and fy > 0, f"focal lengths {fx} and {fy}, expected both positive")
    integers([camera[3], camera[4]], 65535, "a side of the camera's image", 1)


# 3.2 Chunks: "Type and length MUST equal those in the chunk list."
# 3.3 Scene identity: "Every chunk of a file, ancillary ones included, MUST carry it."
# 3.4 Critical and ancillary chunks: "The chunk types of layers are critical: flag bit 0 MUST be zero there."
def read_chunk(data, at, kind, size, scene_id):
    need(len(data) >= at + 16, "the file ends in a chunk's head", "Truncated")
    found_kind, flags, found_size, found_id = struct.unpack_from("<HHI8s", data, at)
    limited(found_size, MAX_LENGTH, "a payload's length")
    need(found_size == size, f"payload of {found_size} bytes, expected {size} as listed")
    end = at + 16 + size
    need(len(data) >= end + 4, "the file ends in a chunk", "Truncated")
    crc = struct.unpack_from("<I", data, end)[0]
    need(zlib.crc32(data[at:end]) == crc, f"the CRC-32 of the chunk at {at} differs", "ChecksumMismatch")
    need(flags & (0xFFFE if flags & 1 else 0x3C) == 0, f"flags {flags:#x}, expected reserved bits 0")
    need(found_kind == kind, f"chunk type {found_kind}, expected {kind} as listed")
    need(found_id == scene_id, "the scene id is not that of the header")
    need(kind < 3 or flags & 1, f"critical chunk of type {kind}", "UnsupportedFeature")
    need(kind >= 3 or not flags & 1, "a layer marked as ancillary")
    return data[at + 16 : end], flags, end + 4


# 6.1 Layout: "u32: length P of the layer parameters, ≤ 4096" "A slice MUST use up its side information"
class Layer:
    """One slice; the first becomes the whole layer (add_slice). cells: [(x, y, z)] of its rows; symbols: {name:
    [channel]} in the order of clause 12.4; tensors: {name: [float]}, every one a binary32 value."""

    def __init__(self, number, payload, header, before, first, earlier):
        """before: N, S and B (6.5) of the slices before; first: the first slice of its layer, if it is a later one;
        earlier: else the step classes of the earlier rows."""
        self.number, self.header, self.later, self.slices = number, header, first is not None, 1
        self.earlier, self.layer_rows = earlier, first.layer_rows if first else ([], 0)
        self.planes, self.weights, self.steps = [], [], {}
        self.priors = first.priors if first else []
        reader = Reader(payload)
        parameters = reader.take(limited(reader.number("<I"), 4096, "the parameters' length"))
        codes = self.read_parameters(parameters, before[0])
        self.check_sizes(len(payload), before)
        codes, stream = Reader(reader.take(codes)), reader.take(reader.left)
        self.cells, channels = (self.decode_lzma if header[2] else self.decode_ans)(codes, stream)
        need(not codes.left, f"{codes.left} bytes after the last channel")
        self.name_channels(iter(channels))

    @property
    def classes(self):
        """The step class of each own row."""
        return self.symbols["class"][0] if self.header["graded"] else [0] * self.rows

    # 6.2 Layer parameters: "Later slices have none of keys 4 to 7, else Malformed."
    # 5.6 Base: "Layer 0 of a file with a base has none of layer keys 4 to 7, else Malformed"
    def read_parameters(self, data, rows_before):
        """The length of the side information."""
        parameters = fields(unpack(data), range(1, 8), (1, 2), "layer parameters")
        self.rows = limited(parameters[1], (1 << 24) - rows_before, "own rows")
        length = limited(parameters[2], MAX_LENGTH, "the length of the side information")
        if 3 in parameters:
            integers(a_list(parameters[3], "the fill", 3, 4), 255, "a number of the fill")
        bare = self.later or (self.number == 0 and 15 in self.header)
        need(not (bare and {4, 5, 6, 7} & set(parameters)), "tables or a kind in a later slice, or over a base")
        for key, read in ((4, self.read_grids), (5, self.read_chains), (6, read_kind)):
            if key in parameters:
                read(parameters[key])
        if 7 in parameters:
            self.layer_rows = read_rows(parameters[7], "layerrow")
        return length

    # 6.3 Grids and chains: "one plane for each pair (i, j), i < j, in lexicographic order" "its columns follow side i"
    def read_grids(self, value):
        step, *grids = a_list(value, "the grids", 2, 17)
        for grid in table(grids, "a grid", 4):
            limited(grid[1], 256, "the number of channels", 1)
            sides = integers(a_list(grid[2], "the sides", 1, 4), 4096, "a side", 1)
            shapes = [(h, w) for i, w in enumerate(sides) for h in sides[i + 1 :]] or [(1, sides[0])]
            for i, predictor in enumerate(a_list(grid[3], "the predictors", len(shapes))):
                registered(predictor, "a predictor")
                self.planes.append((f"plane.{grid[0]}.{i}", predictor, (grid[1], *shapes[i]), a_step(step)))

    # 6.3 Grids and chains: "Linear layer i, 1..m, has a weight [o_i, o_{i−1}] and a bias [o_i]."
    def read_chains(self, value):
        step, *chains = a_list(value, "the chains", 2, 65)
        for chain in table(chains, "a chain", 3, 18):
            widths = integers(chain[1:], 4096, "a width", 1)
            for i, (inputs, outputs) in enumerate(zip(widths, widths[1:])):
                sizes = {f"weight.{chain[0]}.{i}": outputs * inputs, f"bias.{chain[0]}.{i}": outputs}
                self.weights += [(name, size, a_step(step)) for name, size in sizes.items()]

    # 6.5 Declared sizes: "c MUST NOT exceed 2^28, N MUST NOT exceed 2^13 + 2·B, and S MUST NOT exceed 2^22 + 256·B."
    def check_sizes(self, payload_bytes, before):
        samples = sum(c * h * w for _, _, (c, h, w), _ in self.planes)
        need(samples <= 1 << 28, f"{samples} plane samples, limit 2^28", "LimitExceeded")
        samples_and_weights = samples + sum(size for _, size, _ in self.weights)
        row, e = len(self.header["centres"]) + 4 + self.header["graded"], len(self.earlier)
        count = e + row * self.rows + self.layer_rows[1] * (e + self.rows) + samples_and_weights
        self.declared = [a + b for a, b in zip(before, (self.rows, count, payload_bytes))]
        rows, symbols, size = self.declared
        need(rows <= (1 << 13) + 2 * size, f"{rows} rows", "LimitExceeded")
        need(symbols <= (1 << 22) + 256 * size, f"{symbols} symbols", "LimitExceeded")

    # 6.4 Channels: "In mode ans a slice codes the channels in this order:"
    # 8.5 Rows by step class: "each channel of the layer rows has two parts, first the base's rows, then all others"
    # 11.2 Rows: "A step class MUST lie in 0..6"
    def decode_ans(self, codes, stream):
        """The voxels and the channels of items 2 to 8, none split."""
        n, graded = self.rows, self.header["graded"]
        coder = Coder(codes, stream, self.priors, self.declared[1] + (1 << 18))
        cells = coder.decode_positions(n) if n else []
        channels = [coder.channel(size) for size in (len(self.earlier), n, *[n] * graded)]
        classes = ranged(channels[2], 0, 6, "a step class") if graded else [0] * n
        base_rows = self.header[15][2] if 15 in self.header and not self.later else 0
        groups = [c + 7 * (row >= base_rows) for row, c in enumerate(self.earlier + classes)]
        for rows, width in ((classes, len(self.header["centres"])), (groups, self.layer_rows[1])):
            channels += [coder.split(rows, 14) for _ in range(width)]
        channels += coder.decode_grids([shape for _, _, shape, _ in self.planes])
        channels += [coder.channel(size) for _, size, _ in self.weights]
        coder.stream.finish()
        return cells, channels

    # 9.1 Channels and side information: "the symbol is base + v, which MUST lie in −K..K, else Malformed"
    def decode_lzma(self, codes, stream):
        """As decode_ans."""
        n, e, graded = self.rows, len(self.earlier), self.header["graded"]
        counts = [n, n, n, e] + [n] * (1 + graded + len(self.header["centres"])) + [e + n] * self.layer_rows[1]
        counts += [h * w for _, _, (c, h, w), _ in self.planes for _ in range(c)]
        counts += [size for _, size, _ in self.weights]
        heads = [(codes.varint(8 * K + 3) if count else 0, count) for count in counts]
        need(all(code & 3 < 3 for code, _ in heads), "a channel of 8-byte symbols")
        size = sum(count << (code & 3) for code, count in heads)
        need(size or not stream, "an LZMA stream of no channel")
        reader = Reader(unpack_lzma(stream, size) if size else b"")
        channels = [
            ranged(take_numbers(reader, count, code & 3, unzigzag(code >> 2)), -K, K, "a symbol")
            for code, count in heads
        ]
        return voxels_in_order(zip(*channels[:3])), channels[3:]

    # 11.1 Masks: "Layer ℓ codes a rise 0..255 for each earlier row and a code 3..255 for each own row."
    # 5.6 Base: "There a rise MUST be 0 or 1, else Malformed"
    # 11.2 Rows: "Symbols of rows and layer rows, plane samples (11.3), weights and biases MUST lie in −2^23..2^23"
    def name_channels(self, channels):
        """The symbols: of rows their v (11.2), of planes their samples (11.3)."""
        ranges = (("rise", 0, 255 if self.number else 1), ("own", 3, 255), ("class", 0, 6))[: 2 + self.header["graded"]]
        self.symbols = {name: [ranged(next(channels), low, high, name)] for name, low, high in ranges}
        centres = iter(self.header["centres"])
        for tables, classes in ((self.header["rows"], self.classes), (self.layer_rows[0], self.earlier + self.classes)):
            for name, width, self.steps[name], predictor in tables:
                self.symbols[name] = [
                    row_values(next(channels), classes, next(centres, 0), predictor) for _ in range(width)
                ]
        for name, predictor, (c, _, w), self.steps[name] in self.planes:
            self.symbols[name] = [restore(next(channels), predictor, w) for _ in range(c)]
        for name, _, self.steps[name] in self.weights:
            self.symbols[name] = [next(channels)]
        for name, *_ in self.planes + self.weights:
            ranged((k for channel in self.symbols[name] for k in channel), -MAX_SYMBOL, MAX_SYMBOL, "a symbol")

    # 11.5 Dequantisation: "An anchor's position is dequantised from its voxel index with the voxel size as Q."
    def dequantise(self):
        self.tensors = {"position": dequantise([v for cell in self.cells for v in cell], self.header[6])}
        rows = {name for name, *_ in self.header["rows"] + self.layer_rows[0]}
        for name, step in self.steps.items():
            channels = zip(*self.symbols[name]) if name in rows else self.symbols[name]  # [C, n] -> [n, C]
            self.tensors[name] = dequantise([v for channel in channels for v in channel], step)

    # 12.2 Prefixes: "sorted by the Morton code (10.1) of the voxel index less the minimum over these rows"
    def add_slice(self, part):
        """Makes `part` its last slice."""
        cells = self.cells + part.cells
        codes = [morton_code(cell) for cell in less_minimum(cells)]
        order = sorted(range(len(cells)), key=codes.__getitem__)
        for name in part.symbols.keys() - {"rise"}:
            e = len(self.earlier) if name.startswith("layerrow") else 0
            both = [(a[:e], a[e:] + b) for a, b in zip(self.symbols[name], part.symbols[name])]
            self.symbols[name] = [of_earlier + [own[row] for row in order] for of_earlier, own in both]
        self.cells, self.rows, self.slices = [cells[row] for row in order], len(cells), self.slices + 1


# 11.2 Rows: "v = s[c] + k·2^c, then s changes" "v MUST lie in −2^23..2^23, else Malformed." "s[j] = v for every j ≥ c"
def row_values(symbols, classes, centre, predictor):
    last, result = [centre] * 7, []
    for k, c in zip(ranged(symbols, -MAX_SYMBOL, MAX_SYMBOL, "a symbol of a row"), classes):
        c = 0 if predictor == 2 else c
        result.append(last[c] + (k << c))
        if predictor:
            last[c:] = result[-1:] * (7 - c)
    return ranged(result, -MAX_SYMBOL, MAX_SYMBOL, "a value of a row")


# 11.3 Planes: "in row 0 N and NW are taken equal to W, in column 0 W and NW are taken equal to N"
def restore(residuals, predictor, w):
    k = list(residuals)
    for at in range(len(k)):
        i, j = divmod(at, w)
        west = k[at - 1] if j else k[at - w] if i else 0
        north = k[at - w] if i else west
        corner = k[at - w - 1] if i and j else north
        k[at] += max(min(west, north), min(max(west, north), west + north - corner)) if predictor else north
    return k


# 7.3 NormTable: "T[257] = T[256] = 2^27 M[j] = round(2^(31 − j/64)) for j = 0..63"
T = [round(2**27 * math.erf(min(i, 256) / (32 * math.sqrt(2)))) for i in range(258)]
M = [round(2 ** (31 - j / 64)) for j in range(64)]


# 7.3 NormTable: "C = 2^27 − v if t < 0, else 2^27 + v"
def norm_cdf(m, mu8, si):
    e, j = si >> 6, si & 63
    nb = max(0, e - 8)
    result = []
    for k in range(m - 1):
        t = 256 * k + 128 - mu8
        a = min(abs(t) >> nb, (1 << 21) - 1)
        z = min((a * M[j]) >> (23 + e - nb), 1 << 19)
        i, f = z >> 11, z & 2047
        v = T[i] + (((T[i + 1] - T[i]) * f) >> 11)
        result.append((1 << 27) - v if t < 0 else (1 << 27) + v)
    return result


# 7.3 NormTable: "the table cum[q] = ((C(q−1) · (2^24 − 16·m)) >> 28) + 16·q for 0 < q < m"
def table_of(cdf):
    m = len(cdf) + 1
    return [0, *(((c * (TOTAL - 16 * m)) >> 28) + 16 * q for q, c in enumerate(cdf, 1)), TOTAL]


# 7.5 ANS streams: "A stream is a multiple of 4 bytes" "its first word MUST NOT be 0"
class Ans:
    def __init__(self, data):
        need(len(data) % 4 == 0, "the ANS stream is not a multiple of 4 bytes")
        self.words, self.at, self.x = struct.unpack(f"<{len(data) // 4}I", data), 0, 0
        need(not self.words or self.words[0], "the ANS stream begins with a zero word")
        self.refill()
        self.refill()

    def refill(self):
        if self.x < 1 << 32 and self.at < len(self.words):
            self.x = self.x << 32 | self.words[self.at]
            self.at += 1

    # 7.5 ANS streams: "x = (x >> 24)·(cum[s+1] − cum[s]) + q − cum[s]"
    def take(self, count, cum):
        result = [0] * count
        for i in range(count if len(cum) > 2 else 0):
            q = self.x & 0xFFFFFF
            s = bisect_right(cum, q) - 1
            self.x = (self.x >> 24) * (cum[s + 1] - cum[s]) + q - cum[s]
            self.refill()
            result[i] = s
        return result

    # 7.5 ANS streams: "x MUST be 0 and no word left, else Malformed"
    def finish(self):
        need(self.x == 0 and self.at == len(self.words), "the ANS stream does not end in state 0")


# 8.2 Priors: "kmin + m − 1 MUST NOT exceed K, else Malformed." "mu8 = g + 128·(m − 1) and si = v − 640"
# 8.1 Tokens: "a new prior of this family"
# 7.4 Mixture tables: "C(k) = ((256 − w)·C1(k) + w·C2(k)) >> 8"
def read_prior(codes, family):
    """(kmin, m, cum) of clause 8.2."""
    need(family <= 2, f"prior family {family}", "UnsupportedFeature")
    kmin = codes.zigzag(K)
    if family == 0:
        return kmin, 1, [0, TOTAL]
    m = 2 + codes.varint((1 << 14) - 2)
    need(kmin + m - 1 <= K, "a window reaches beyond symbol K")
    cdfs = [norm_cdf(m, codes.zigzag(1 << 31) + 128 * (m - 1), codes.varint(1920) - 640) for _ in range(family)]
    if family == 2:
        w = codes.number("B")
        need(w, "a mixture of weight 0")
        cdfs = [[((256 - w) * c1 + w * c2) >> 8 for c1, c2 in zip(*cdfs)]]
    return kmin, m, table_of(cdfs[0])


# 8.3 Exceptions: "the symbol is kmin − 1 − (c >> 1) if c is odd, else kmin + m + (c >> 1)"
def read_exceptions(codes, count, kmin, m):
    number = 1 + codes.varint(VARINT_MAX)
    most = min(count, codes.left // 2)
    need(number <= most, f"{number} exceptions, expected at most {most}")
    result, at = {}, -1
    for _ in range(number):
        at += 1 + codes.varint(VARINT_MAX)
        c = codes.varint(4 * K + 2)
        value = kmin - 1 - (c >> 1) if c & 1 else kmin + m + (c >> 1)
        need(at < count, f"an exception at symbol {at} of {count}")
        need(abs(value) <= K, f"an exception of value {value}, limit K")
        result[at] = value
    return result


# 10.2 Octree: "an index into the ascending list of the bytes in which as many bits are 1"
PATTERNS = [[byte for byte in range(256) if bin(byte).count("1") == k] for k in range(1, 9)]


# 8 Coded channels: "Mode ans reads a slice with two cursors, one in the side information and one in the ANS stream."
class Coder:
    """The two cursors of a slice, codes in its side information and stream; priors: the prior list of its layer."""

    def __init__(self, codes, stream, priors, most_entries):
        self.codes, self.stream, self.priors, self.most_entries = codes, Ans(stream), priors, most_entries

    # 8 Coded channels: "Channels of length 0 leave no trace."
    # 8.1 Tokens: "the prior F − 8 entries before the last one of the prior list"
    # 8.2 Priors: "the sum of m over the prior list MUST NOT exceed S (6.5) at this slice plus 2^18"
    # 8.4 Symbols: "The symbol is kmin + s. Exceptions are then put in their places."
    def channel(self, count):
        if count == 0:
            return []
        token = self.codes.varint(2 * ((1 << 26) + 8))
        if token >> 1 < 8:
            self.priors.append(read_prior(self.codes, token >> 1))
            need(sum(m for _, m, _ in self.priors) <= self.most_entries, "too many entries", "LimitExceeded")
        back = max(token >> 1, 8) - 8
        need(back < len(self.priors), "a channel reuses a prior before the first")
        kmin, m, cum = self.priors[-1 - back]
        exceptions = read_exceptions(self.codes, count, kmin, m) if token & 1 else {}
        inside = iter(self.stream.take(count - len(exceptions), cum))
        return [exceptions[at] if at in exceptions else kmin + next(inside) for at in range(count)]

    # 8.5 Rows by step class: "split by the step class of each row, 0..6, into seven coded channels"
    # 8.6 Grids in stages: "one per class (8.7), ascending, each with the residuals of the cells of that class"
    def split(self, classes, class_count):
        parts = [iter(self.channel(classes.count(q))) for q in range(class_count)]
        return [next(parts[q]) for q in classes]

    # 8.6 Grids in stages: "Stage 0 codes the channels 0 and 1 of each plane, stage s ≥ 1 the channels"
    def decode_grids(self, shapes):
        """The residuals, one list per plane and channel; shapes: (channels, height, width) of each plane."""
        planes, first, end = [[] for _ in shapes], 0, 2
        while any(c > first for c, _, _ in shapes):
            for e, (c, h, w) in zip(planes, shapes):
                classes = classes_by_activity(cell_activity(e, h, w)) if 0 < first < c else []
                e += [self.split(classes, 8) if first else self.channel(h * w) for _ in range(first, min(end, c))]
            first, end = end, 2 * end
        return [channel for e in planes for channel in e]

    # 10.1 Head: "The smallest relative index along each axis MUST be 0, the largest of all three axes MUST have R bits"
    def decode_positions(self, count):
        codes = self.codes
        low, depth = [codes.zigzag(MAX_VOXEL) for _ in range(3)], limited(codes.number("B"), 21, "the depth")
        nodes = self.grow(depth, count)
        need(nodes == less_minimum(nodes), "no anchor at the minimum")
        need(max(v for node in nodes for v in node).bit_length() == depth, "another depth than declared")
        cells = [tuple(p + m for p, m in zip(node, low)) for node in nodes]
        need(all(v <= MAX_VOXEL for cell in cells for v in cell), "a voxel index over 2^20")
        return cells

    # 10.2 Octree: "From a level of n nodes on, every node has one child, so no more numbers are coded."
    def grow(self, depth, count):
        """The relative indices (x, y, z) of the anchors, in Morton order."""
        levels, size = [], 1
        for _ in range(depth):
            coded = self.channel(size) if size < count else [0] * size
            levels.append(ranged(coded, 0, 7, "a number of children less 1"))
            size += sum(coded)
            need(size <= count, f"{size} nodes, expected at most {count}")
        need(size == count, f"{size} nodes at the end, expected {count}")
        nodes = [(0, 0, 0)]
        for further in levels:
            indices = self.split(further, 8)
            need(all(0 <= i < len(PATTERNS[k]) for i, k in zip(indices, further)), "an index out of its list")
            patterns = [PATTERNS[k][i] for i, k in zip(indices, further)]
            nodes = [
                tuple(2 * v + (child >> axis & 1) for axis, v in enumerate(node))
                for node, pattern in zip(nodes, patterns)
                for child in range(8)
                if pattern >> child & 1
            ]
        return nodes


# 8.6 Grids in stages: "over the nine cells (clip(i + a, 0, H − 1), clip(j + b, 0, W − 1)) with a and b in −1..1"
def cell_activity(channels, h, w):
    magnitude = relative_magnitude(channels, h * w)
    rows = [[min(max(i + a, 0), h - 1) for a in (-1, 0, 1)] for i in range(h)]
    columns = [[min(max(j + b, 0), w - 1) for b in (-1, 0, 1)] for j in range(w)]
    return [sum(magnitude[i * w + j] for i in near_i for j in near_j) for near_i in rows for near_j in columns]


# 8.7 Classes by activity: "(|e_c[p]| · 256·H·W) // (1 + s_c), s_c the sum over cells q of |e_c[q]|"
def relative_magnitude(channels, n):
    """Of each of the n cells."""
    magnitude = [0] * n
    for e in channels:
        s = sum(abs(v) for v in e)
        magnitude = [m + abs(v) * 256 * n // (1 + s) for m, v in zip(magnitude, e)]
    return magnitude


# 8.7 Classes by activity: "the class of a cell, 0..7, is the number of bounds that are at most its activity"
def classes_by_activity(activity):
    ascending = sorted(activity)
    bounds = [ascending[i * len(ascending) // 8] for i in range(1, 8)]
    return [bisect_right(bounds, value) for value in activity]


# 9.2 Byte planes: "Each channel's data are all least significant bytes first, then the next, and so on."
def take_numbers(reader, count, w, base):
    data = reader.take(count << w)
    planes = [data[plane * count : (plane + 1) * count] for plane in range(1 << w)]
    return [base + int.from_bytes(bytes(number), "little", signed=True) for number in zip(*planes)]


# 9.4 Voxels: "the own rows MUST be in strictly ascending Morton order (10.1), else Malformed"
def voxels_in_order(differences):
    cells, at = [], (0, 0, 0)
    for difference in differences:
        at = tuple(a + b for a, b in zip(at, difference))
        need(max(map(abs, at)) <= MAX_VOXEL, "a voxel index over 2^20")
        cells.append(at)
    relative = less_minimum(cells)
    need(all(max(cell) < 1 << 21 for cell in relative), "voxel indices that differ by more than 2^21 - 1")
    codes = [morton_code(cell) for cell in relative]
    need(all(a < b for a, b in zip(codes, codes[1:])), "voxels out of Morton order")
    return cells


def less_minimum(cells):
    low = [min((cell[axis] for cell in cells), default=0) for axis in range(3)]
    return [tuple(v - m for v, m in zip(cell, low)) for cell in cells]


# 10.1 Head: "bit 3i of the code is bit i of x, 3i + 1 of y, 3i + 2 of z"
def morton_code(offset):
    return sum((v >> i & 1) << 3 * i + axis for axis, v in enumerate(offset) for i in range(22))


# 9.3 LZMA2: "It MUST unpack to exactly the bytes of all channels, at most 2^31, else LimitExceeded"
def unpack_lzma(data, size):
    need(size <= 1 << 31, f"{size} bytes uncompressed, limit 2^31", "LimitExceeded")
    decoder = lzma.LZMADecompressor(lzma.FORMAT_RAW, filters=[{"id": lzma.FILTER_LZMA2, "dict_size": 1 << 26}])
    try:
        out = decoder.decompress(data, max_length=size + 1)
    except lzma.LZMAError as error:
        raise Fault("Malformed", f"LZMA: {error}") from None
    ends = decoder.eof and not decoder.unused_data
    need(ends and len(out) == size, f"an LZMA stream of {len(out)} bytes or more, expected {size} and the end")
    return out


# 11.5 Dequantisation: "the product is exact, and the one rounding is to nearest, ties to even"
def dequantise(symbols, step):
    products = [k * step for k in symbols]
    # From half a unit in the last place above the largest finite binary32 on, the rounding gives infinity.
    need(all(abs(v) < 2.0**128 - 2.0**103 for v in products), "a reconstructed value is not finite")
    return list(struct.unpack(f"<{len(products)}f", struct.pack(f"<{len(products)}f", *products)))


# 11.1 Masks: "its code in the layer before in the file plus its rise, and MUST NOT exceed 255 nor be 1 or 2"
# 5.6 Base: "with 0 the row's mask code in layer 0 is that in the base, with 1 it is 0"
# 12.1 Order: "each voxel at most once over the base and all slices of all layers so far, and dequantisation"
def finish_last(layers):
    codes = []
    for layer in layers:
        pairs = zip(codes, layer.symbols["rise"][0])
        codes = [code + rise if layer.number else code * (1 - rise) for code, rise in pairs] + layer.symbols["own"][0]
        need(not codes or max(codes) <= 255, "a mask code over 255")
    need(not {1, 2} & set(codes), "a mask code of 1 or 2")
    need(len({cell for layer in layers for cell in layer.cells}) == len(codes), "a voxel holds more than one anchor")
    layers[-1].dequantise()


# 5.6 Base: "The digest is the SHA-256 of the SHA-256s, one behind the other, of the header from the end of its chunk
# list and of each chunk of layer 0, its 20 + L bytes from type to CRC-32." "layer 0 decodes, and has no layer rows"
# 15 Errors and security: "the file has a base (5.6), and none or another one is given"
def read_base(data, header):
    """The layer 0 of the base, as a layer before layer 0."""
    need(data is not None, "the file has a base", "BaseMissing")
    try:
        base, scene_id, at = read_preamble(data)
        need(15 not in base, "a base that has a base")
        (layer,) = decode(data, 0)
    except Fault as fault:
        raise Fault("BaseMismatch" if fault.name == "Truncated" else fault.name, fault) from None
    need(not layer.layer_rows[0], "a base with layer rows")
    parts = [base["identity"]]
    for kind, size in base[1]:
        at += 20 + size
        parts += [data[at - 20 - size : at]] * (kind == 0)
    digest = hashlib.sha256(b"".join(hashlib.sha256(part).digest() for part in parts)).digest()
    need([scene_id, digest] == header[15][:2], "another base", "BaseMismatch")
    need([layer.rows, sum(map(len, parts))] == header[15][2:], "other rows or bytes than the base's")
    need(all(base.get(key) == header.get(key) for key in (3, 4, 5, 6)), "another kind, rows or voxel size")
    layer.number = -1
    return layer


# 3.2 Chunks: "Bytes after the last chunk make the file Malformed."
# 5.6 Base: "N from b, S from (C_r + 4)·b, with header key 5 (C_r + 5)·b, and B from P"
# 3.6 Slices: "Bit 1 MUST be 1 if the next layer chunk in the list is of the same layer, and 0 if it is of another one."
# 12.1 Order: "A decoder of prefix ℓ stops after the last chunk of a layer ≤ ℓ in the list."
def decode(data, max_layer=None, base=None):
    """The layers of a file's bytes, or of prefix max_layer, with cells, symbols and tensors. base: its base's bytes."""
    header, scene_id, at = read_preamble(data)
    layers, declared, chunks = [], (0, 0, 0), header[1]
    if 15 in header:
        layers, (_, _, rows, size) = [read_base(base, header)], header[15]
        declared = (rows, (len(header["centres"]) + 4 + header["graded"]) * rows, size)
    stop = len(chunks)
    if max_layer is not None:
        stop = 1 + max(i for i, (kind, _) in enumerate(chunks) if kind <= min(max_layer, 2))
    for i, (kind, size) in enumerate(chunks[:stop]):
        payload, flags, at = read_chunk(data, at, kind, size, scene_id)
        if kind < 3:
            first = layers[-1] if layers and layers[-1].number == kind else None
            number, after = first.slices if first else 0, [k for k, _ in chunks[i + 1 :] if k < 3]
            need(flags >> 6 == number, f"slice {flags >> 6} of layer {kind}, expected {number}")
            need(not after or (flags >> 1 & 1) == (after[0] == kind), f"flags {flags:#x} before layers {after}")
            earlier = [] if first else [c for layer in layers for c in layer.classes]
            read = Layer(kind, payload, header, declared, first, earlier)
            if first:
                first.add_slice(read)
            else:
                layers.append(read)
            finish_last(layers)
            declared = read.declared
    need(max_layer is not None or at == len(data), "bytes follow the last chunk")
    return [layer for layer in layers if layer.number >= 0]


# 12.4 Hashes: "two SHA-256 digests per layer, of its decoded slices, with n rows of its own in the order of 12.2"
def hashes(data, max_layer=None, base=None):
    rows = []
    for layer in decode(data, max_layer, base):
        symbols, tensors = hashlib.sha256(), hashlib.sha256()
        for values in (*layer.cells, *(channel for own in layer.symbols.values() for channel in own)):
            symbols.update(struct.pack(f"<{len(values)}i", *values))
        for values in layer.tensors.values():
            tensors.update(struct.pack(f"<{len(values)}f", *values))
        rows.append({"layer": layer.number, "symbols": symbols.hexdigest(), "tensors": tensors.hexdigest()})
    return rows


def main(arguments):
    if len(arguments) not in (1, 2):
        return "usage: refdec.py FILE [BASE]"
    try:
        file, base = [*(Path(path).read_bytes() for path in arguments), None][:2]
        print(json.dumps(hashes(file, base=base)))
    except (Fault, OSError) as error:
        return f"refdec: {arguments[0]}: {error}"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
