// What a page and a decoder in a Worker say to each other, and the Worker's side of it.

import { DecodeError } from "./errors.js";
import { Stream } from "./stream.js";

/** @typedef {import("./scene.js").Scene} Scene */

/**
 * A Worker, its global scope, or a MessagePort.
 *
 * @typedef {object} Port
 * @property {(message: any, transfer: Transferable[]) => void} postMessage
 * @property {((event: any) => void) | null} onmessage
 */

/** open makes a stream, the only one of its Worker. id: of the answer.
 *
 * @typedef {{id: number, open: {maxLayer?: number | null}} | {id: number, feed: Uint8Array} | {id: number, rewind: true}
 *   | {id: number, finish: true}} Question
 */

/** @typedef {{consumed: number, complete: boolean, layerEnds: {layer: number, end: number}[]}} State */

/** @typedef {{kind: import("./errors.js").ErrorKind, reason: string, offset: number | null, chunk: number | null}} Fault */

/** crash: an exception that is no DecodeError.
 *
 * @typedef {{id: number, scenes: Scene[], state: State, fault?: Fault, crash?: string}} Answer
 */

/** Answers the questions that come through `port`. @param {Port} port */
export function serve(port) {
  let stream = new Stream();
  port.onmessage = ({ data }) => {
    /** @type {Question} */
    const question = data;
    /** @type {Answer} */
    const answer = { id: question.id, scenes: [], state: { consumed: 0, complete: false, layerEnds: [] } };
    try {
      if ("open" in question) stream = new Stream(question.open);
      else if ("feed" in question) answer.scenes = stream.feed(question.feed);
      else if ("rewind" in question) stream.rewind();
      else stream.finish();
    } catch (error) {
      if (error instanceof DecodeError) {
        const { kind, reason, offset, chunk } = error;
        answer.fault = { kind, reason, offset, chunk };
      } else answer.crash = error instanceof Error ? error.message : String(error);
    }
    const { consumed, complete, layerEnds } = stream;
    answer.state = { consumed, complete, layerEnds };
    // The stream goes on with the arrays that it gave out, and scenes share them: what leaves is a copy until the last.
    answer.scenes = answer.scenes.map((scene, i) =>
      complete && i + 1 === answer.scenes.length ? scene : /** @type {Scene} */ (copied(scene)),
    );
    /** @type {Set<ArrayBuffer>} */
    const buffers = new Set();
    collect(answer.scenes, buffers);
    port.postMessage(answer, [...buffers]);
  };
}

/** @param {unknown} value @returns {unknown} */
function copied(value) {
  if (ArrayBuffer.isView(value)) return /** @type {Float32Array} */ (value).slice();
  if (Array.isArray(value)) return value.map(copied);
  if (value === null || typeof value !== "object") return value;
  return Object.fromEntries(Object.entries(value).map(([key, item]) => [key, copied(item)]));
}

/** @param {unknown} value @param {Set<ArrayBuffer>} buffers */
function collect(value, buffers) {
  if (ArrayBuffer.isView(value)) buffers.add(/** @type {ArrayBuffer} */ (value.buffer));
  else if (value !== null && typeof value === "object") for (const item of Object.values(value)) collect(item, buffers);
}
