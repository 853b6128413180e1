// The worker that fetches and decodes.

import assert from "node:assert/strict";
import { test } from "node:test";

import "../testing/threads.mjs";
import { decode } from "../decode/index.js";
import { startLoader } from "../render/loader.js";
import { addressOf, readVector, same } from "../testing/vectors.mjs";
/** @import { News } from "../render/loader-worker.js" */

/** Loads a file. @param {Uint8Array} bytes @param {object} [budget] @param {News[]} [told] gets what is told */
async function load(bytes, budget = {}, told = []) {
  const loader = startLoader((news) => told.push(news));
  try {
    await loader.call("open", [addressOf(bytes)]);
    return { told, ...(await loader.call("load", [budget])) };
  } finally {
    loader.close();
  }
}

/** @param {News[]} told */
const newest = (told) => told.flatMap(({ scene }) => scene ?? []).at(-1);

test("the newest scene is told last, of the layers that were asked for", async () => {
  const bytes = readVector("valid/layers-0-1-2");
  const all = await load(bytes);
  assert.ok(same(newest(all.told), decode(bytes)));
  assert.deepEqual([all.bytes, all.complete], [bytes.length, true]);
  const first = await load(bytes, { maxLayer: 0 });
  assert.ok(same(newest(first.told), decode(bytes, { maxLayer: 0 })));
  assert.ok(!first.complete);
});

/** The typed arrays in a scene. @param {unknown} value @returns {ArrayBufferView[]} */
function arraysIn(value) {
  if (ArrayBuffer.isView(value)) return [value];
  return typeof value === "object" && value ? Object.values(value).flatMap(arraysIn) : [];
}

for (const [name, maxLayer] of /** @type {[string, number][]} */ ([["layers-0-1-2", 0], ["tracks-slices", 1]])) {
  test(`a scene is told with its own rows alone, however much room for others they were read into: ${name}`, async () => {
    const bytes = readVector(`valid/${name}`);
    const scene = newest((await load(bytes, { maxLayer })).told);
    const decoded = decode(bytes, { maxLayer });
    assert.ok(same(scene, decoded));
    const room = (/** @type {unknown} */ of) => arraysIn(of).filter((v) => v.buffer.byteLength > v.byteLength).length;
    assert.ok(room(decoded) > 0);
    assert.equal(room(scene), 0);
  });
}

test("faults of a file without a validator keep their kind and place, and what was read before is told", async () => {
  const bytes = readVector("faulty/crc-layer-1");
  /** @type {News[]} */
  const told = [];
  await assert.rejects(load(bytes, {}, told), { kind: "ChecksumMismatch", chunk: 1 });
  assert.deepEqual(newest(told)?.layers, [0]);
});

test("unanswered and later calls reject once the worker is closed", async () => {
  const loader = startLoader(() => {});
  const waiting = loader.call("open", ["data:,"]);
  loader.close();
  await assert.rejects(waiting, /closed/);
  await assert.rejects(loader.call("load", [{}]), /closed/);
});
