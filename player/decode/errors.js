// Clause 15: the one kind of error that a decoder of `.pd4` files raises.

/**
 * The names of clause 15.
 *
 * @typedef {"BadSignature" | "UnsupportedVersion" | "Truncated" | "ChecksumMismatch" | "LimitExceeded"
 *   | "UnsupportedFeature" | "BaseMissing" | "BaseMismatch" | "Malformed"} ErrorKind
 */

/**
 * Bytes that are not a valid `.pd4` file, or one that this decoder does not support.
 *
 * `kind` is the name of clause 15; `offset` the byte offset in the file where the fault was found, `chunk` the index of
 * the chunk at fault in file order, null where they are unknown or the fault lies in no chunk. `reason` is the message
 * without the place; `message` is one line with it.
 */
export class DecodeError extends Error {
  /**
   * @param {ErrorKind} kind
   * @param {string} reason what was found, what was expected
   * @param {{offset?: number | null, chunk?: number | null, needs?: number}} [place] needs: of Truncated, so many bytes
   * of the file the step takes that found too few
   */
  constructor(kind, reason, { offset = null, chunk = null, needs = 0 } = {}) {
    const where = [];
    if (chunk !== null) where.push(`chunk ${chunk}`);
    if (offset !== null) where.push(`offset ${offset}`);
    super(reason + (where.length ? ` (${where.join(", ")})` : ""));
    this.name = "DecodeError";
    this.kind = kind;
    this.reason = reason;
    this.offset = offset;
    this.chunk = chunk;
    this.needs = needs;
  }
}

/** @param {string} reason @returns {DecodeError} */
export const malformed = (reason) => new DecodeError("Malformed", reason);

/** @param {string} reason @returns {DecodeError} */
export const limitExceeded = (reason) => new DecodeError("LimitExceeded", reason);

/** @param {string} reason @returns {DecodeError} */
export const unsupported = (reason) => new DecodeError("UnsupportedFeature", reason);
