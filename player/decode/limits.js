// Clause 14: limits of what a file declares. Two are lower than the format's, so that a page allocates about a gigabyte
// at most, and higher than the least that the clause demands of a decoder.

/** Bytes of a header. */
export const MAX_HEADER = 2 ** 14;
/** Bytes of a slice's parameters. */
export const MAX_FIELDS = 4096;
export const MAX_CHUNKS = 1024;
/** Bytes of a payload. */
export const MAX_PAYLOAD = 2 ** 31 - 1;
export const MAX_NESTING = 4;
/** The format's is 2^24, the least 2^20. */
export const MAX_ROWS = 2 ** 21;
export const MAX_VOXEL = 2 ** 20;
/** K: the largest coded symbol. */
export const MAX_CODED = 2 ** 24;
/** The largest symbol of a row, plane sample or weight. */
export const MAX_SYMBOL = 2 ** 23;
/** Symbols of one channel. */
export const MAX_COUNT = 2 ** 26;
export const MAX_WINDOW = 2 ** 14;
/** Numbers of a kind. */
export const MAX_KIND = 16;
export const MAX_ID = 255;
export const MAX_ROW_TENSORS = 32;
/** Channels of a tensor of rows or of a grid. */
export const MAX_CHANNELS = 256;
/** W: channels of all tensors of rows. */
export const MAX_ROW_CHANNELS = 512;
export const MAX_GRIDS = 16;
export const MAX_AXES = 4;
export const MAX_SIDE = 4096;
export const MAX_CHAINS = 64;
export const MAX_LINEAR_LAYERS = 16;
export const MAX_WIDTH = 4096;
/** The format's is 2^28, the least 2^25. */
export const MAX_PLANE_CELLS = 2 ** 26;
