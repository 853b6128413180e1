/**
 * A decoder of `.pd4` files: bytes in, typed arrays out. It follows the specification clause by clause and trusts no
 * byte; every fault is a DecodeError with the name that clause 15 gives it. It decodes mode ans; mode lzma is
 * UnsupportedFeature (clause 16).
 *
 * @module
 */

import { checkKinds, sceneOf } from "../kinds/index.js";
import { readAll } from "./reader.js";
import { Stream } from "./stream.js";
/** @import { GivenBase } from "./reader.js" */

export { DecodeError } from "./errors.js";
export { hashes } from "./hashes.js";
export { Base } from "./reader.js";
export { Stream } from "./stream.js";

/** @typedef {import("../kinds/index.js").Scene} Scene */
/** @typedef {import("../kinds/index.js").Deformation} Deformation */
/** @typedef {import("./tensors.js").Tensors} Tensors */
/** @typedef {import("./tensors.js").Info} Info */
/** @typedef {import("./tensors.js").Camera} Camera */
/** @typedef {import("./tensors.js").Network} Network */
/** @typedef {import("./tensors.js").Plane} Plane */
/** @typedef {import("./errors.js").ErrorKind} ErrorKind */

/** maxLayer: bytes behind the layers up to it are not looked at. allowPartial: a cut file (else Truncated) gives
 * its longest prefix of complete slices, at least one, or its base alone. base: of a file that names one (clause 5.6),
 * the bytes, or a Base of them, which decodes it once for many files.
 * @typedef {{maxLayer?: number | null, allowPartial?: boolean, base?: GivenBase}} Options */

/** The scene of a file, or of a prefix. Raises DecodeError, also where a kind is unknown or its tensors break its rules
 * (clause 13.1). @param {Uint8Array | ArrayBuffer} bytes @param {Options} [options] @returns {Scene} */
export const decode = (bytes, options = {}) => sceneOf(readAll(bytes, options, checkKinds));

/** The tensors of a file, or of a prefix, whatever their kinds are. Raises DecodeError.
 * @param {Uint8Array | ArrayBuffer} bytes @param {Options} [options] @returns {Tensors} */
export const decodeTensors = (bytes, options = {}) => readAll(bytes, options, null);

/** A decoder that takes a file in pieces: `feed(bytes)` gives the newest scene of each layer that they complete a slice
 * of. @param {Omit<Options, "allowPartial">} [options] */
export const openStream = (options) => new Stream(options);
