"""Numbers of the bitstream and its limits (clause 14)."""

LAYERS = (0, 1, 2)  #: which are also the types of their chunks

# A reader checks every declared count against these before it allocates.

MAX_HEADER = 1 << 14  #: bytes; the longest chunk list takes two thirds of it
MAX_PARAMETERS = 4096  #: bytes of a slice's parameters; msgpack takes up to 130 times its bytes in memory
MAX_CHUNKS = 1024  #: slices of layers and ancillary chunks; a slice's number takes ten bits
MAX_PAYLOAD = (1 << 31) - 1  #: bytes in one chunk; fits a signed 32-bit size on every platform
MAX_DEPTH = 4  #: nested maps and lists in canonical msgpack
MAX_ANCHORS = 1 << 24  #: rows over all layers; 68 int32 columns of them are 4.6 GB
MAX_ID = 255  #: of a tensor
MAX_KIND = (1 << 16) - 1  #: each integer of a kind
MAX_KIND_LENGTH = 16
MAX_ROWS, MAX_ROWS_WIDTH = 32, 512  #: tensors of a row, and their channels
MAX_CHANNELS = 256  #: of one tensor of rows or one grid
MAX_GRIDS, MAX_AXES, MAX_SIDE = 16, 4, 4096
MAX_CELLS = 1 << 28  #: samples over all planes of a slice: 1 GiB of float32
MAX_CHAINS, MAX_CHAIN_LAYERS, MAX_WIDTH = 64, 16, 4096
