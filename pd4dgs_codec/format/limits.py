"""Limits of the format (clause 14). A reader checks every declared count against them before it allocates."""

from __future__ import annotations

# File structure
MAX_HEADER = 1 << 14  #: bytes; the longest chunk list takes two thirds of it
MAX_PARAMETERS = 4096  #: bytes of a layer's parameters; msgpack takes up to 130 times its bytes in memory
MAX_CHUNKS = 1024  #: slices of layers and ancillary chunks; a slice's number takes ten bits
MAX_PAYLOAD = (1 << 31) - 1  #: bytes in one chunk; fits a signed 32-bit size on every platform
MAX_DEPTH = 4  #: nested maps and lists in canonical msgpack

# Scene
MAX_ANCHORS = 1 << 24  #: rows over all layers; 68 int32 columns of them are 4.6 GB

# Deformation
MAX_PLANE_SIDE = 4096  #: cells; eight times the paper's finest plane
MAX_PLANE_CHANNELS = 256
MAX_PLANE_SCALES = 8
MAX_PLANE_CELLS = 1 << 28  #: cells times channels over all planes of one chunk: 1 GiB of float32
MAX_NETWORK_WIDTH = 4096  #: inputs or outputs of one linear layer
MAX_NETWORK_LAYERS = 16
