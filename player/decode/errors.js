// Clause 15: the one kind of error that a decoder of `.pd4` files raises.

/** The names of clause 15. @typedef {"BadSignature" | "UnsupportedVersion" | "Truncated" | "ChecksumMismatch"
 *   | "LimitExceeded" | "UnsupportedFeature" | "BaseMissing" | "BaseMismatch" | "Malformed"} ErrorKind */

/**
 * Bytes that are not a valid `.pd4` file, or one that this decoder does not support.
 *
 * `kind` is the name of clause 15; `offset` the byte offset in the file where the fault was found, `chunk` the index of
 * the chunk at fault in file order, null where they are unknown or the fault lies in no chunk. `reason` is the message
 * without the place; `message` is one line with it. `needs`: of Truncated, how many bytes of the file the step takes
 * that found too few.
 */
export class DecodeError extends Error {
  /** @param {ErrorKind} kind @param {string} reason what was found, what was expected
   * @param {{offset?: number | null, chunk?: number | null, needs?: number}} [place] */
  constructor(kind, reason, { offset = null, chunk = null, needs = 0 } = {}) {
    const where = [...(chunk === null ? [] : [`chunk ${chunk}`]), ...(offset === null ? [] : [`offset ${offset}`])];
    super(reason + (where.length ? ` (${where.join(", ")})` : ""));
    this.name = "DecodeError";
    this.kind = kind;
    this.reason = reason;
    this.offset = offset;
    this.chunk = chunk;
    this.needs = needs;
  }
}

/** @param {ErrorKind} kind @returns {(reason: string, offset?: number) => DecodeError} */
const fault = (kind) => (reason, offset) => new DecodeError(kind, reason, { offset });

export const malformed = fault("Malformed");
export const limitExceeded = fault("LimitExceeded");
export const unsupported = fault("UnsupportedFeature");
