// Limits of what a file declares (clause 14), where several modules need one; all others stand where they are checked.

/** Bytes of a payload. */
export const MAX_PAYLOAD = 2 ** 31 - 1;
/** The format's is 2^24, the least 2^20: a page allocates about a gigabyte at most. */
export const MAX_ROWS = 2 ** 21;
/** The largest symbol of a row, plane sample or weight. */
export const MAX_SYMBOL = 2 ** 23;
/** Channels of a tensor of rows or of a grid. */
export const MAX_CHANNELS = 256;
