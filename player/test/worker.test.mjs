// The decoder in a worker.

import assert from "node:assert/strict";
import { test } from "node:test";

import "../testing/threads.mjs";
import { DecodeError, decode, openStream } from "../decode/index.js";
import { WorkerDecoder } from "../decode/worker-decoder.js";
import { readVector, same } from "../testing/vectors.mjs";

const BYTES = readVector("valid/layers-0-1-2");

test("it returns the scenes of a stream", async () => {
  const decoder = new WorkerDecoder();
  const stream = openStream();
  /** @type {import("../decode/index.js").Scene[]} */
  const scenes = [];
  for (let at = 0; at < BYTES.length; at += 100) {
    const block = BYTES.slice(at, at + 100);
    const expected = stream.feed(block);
    const found = await decoder.feed(block, { transfer: true });
    assert.equal(block.length, 0, "the block was transferred");
    assert.ok(same(found, expected));
    assert.equal(decoder.consumed, stream.consumed);
    assert.deepEqual(decoder.layerEnds, stream.layerEnds);
    scenes.push(...found);
  }
  assert.equal(scenes.length, 3);
  assert.ok(decoder.complete);
  await decoder.finish();
  assert.ok(same(scenes[0], decode(BYTES, { maxLayer: 0 })), "later layers do not change the first scene");
  decoder.close();
});

test("several layers in one block, which stays with its owner", async () => {
  const decoder = new WorkerDecoder();
  const scenes = await decoder.feed(BYTES);
  assert.ok(BYTES.length > 0);
  assert.deepEqual(scenes.map(({ layers }) => layers.length), [1, 2, 3]);
  assert.ok(same(scenes[2], decode(BYTES)));
  decoder.close();
});

test("faults keep kind and place, and rewind continues after the last valid layer", async () => {
  const decoder = new WorkerDecoder();
  const damaged = readVector("faulty/crc-layer-1");
  assert.equal((await decoder.feed(damaged)).length, 1);
  /** @type {any} */
  const fault = await decoder.feed(new Uint8Array(0)).catch((error) => error);
  assert.ok(fault instanceof DecodeError);
  assert.deepEqual([fault.kind, fault.chunk], ["ChecksumMismatch", 1]);
  assert.match(fault.message, /^[^\n]*\(chunk 1, offset \d+\)$/);
  await decoder.rewind();
  await assert.rejects(decoder.finish(), { kind: "Truncated" });
  decoder.close();
});

test("maxLayer is passed on; an invalid one rejects the first call", async () => {
  const first = new WorkerDecoder({ maxLayer: 0 });
  assert.equal((await first.feed(BYTES)).length, 1);
  assert.ok(first.complete);
  first.close();
  const wrong = new WorkerDecoder({ maxLayer: -1 });
  await assert.rejects(wrong.feed(BYTES), /maxLayer is -1/);
  wrong.close();
});

test("unanswered and later calls reject once the decoder is closed", async () => {
  const decoder = new WorkerDecoder();
  const waiting = decoder.feed(BYTES);
  decoder.close();
  await assert.rejects(waiting, /closed/);
  await assert.rejects(decoder.feed(BYTES), /closed/);
});
