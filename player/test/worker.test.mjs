import assert from "node:assert/strict";
import { test } from "node:test";
import { MessageChannel, Worker } from "node:worker_threads";

import { DecodeError, decode, openStream } from "../decode/index.js";
import { WorkerDecoder } from "../decode/worker-decoder.js";
import { serve } from "../decode/worker-protocol.js";
import { readVector, same } from "../testing/vectors.mjs";

const BYTES = readVector("valid/layers-0-1-2");

/** A decoder that a thread of its own serves. @param {{maxLayer?: number}} [options] */
function inThread(options) {
  const { port1, port2 } = new MessageChannel();
  const url = new URL("../decode/worker-protocol.js", import.meta.url).href;
  const code = `require("node:worker_threads").parentPort.once("message", async (port) => (await import("${url}")).serve(port))`;
  const thread = new Worker(code, { eval: true });
  thread.postMessage(port2, [port2]);
  const decoder = new WorkerDecoder({ ...options, port: /** @type {any} */ (port1) });
  return { decoder, end: () => (decoder.close(), thread.terminate()) };
}

test("a decoder in a thread gives the scenes that a stream gives", async () => {
  const { decoder, end } = inThread();
  const stream = openStream();
  /** @type {import("../decode/index.js").Scene[]} */
  const scenes = [];
  for (let at = 0; at < BYTES.length; at += 100) {
    const block = BYTES.slice(at, at + 100);
    const expected = stream.feed(block);
    const found = await decoder.feed(block, { transfer: true });
    assert.equal(block.length, 0, "the block was given away");
    assert.ok(same(found, expected));
    assert.equal(decoder.consumed, stream.consumed);
    assert.deepEqual(decoder.layerEnds, stream.layerEnds);
    scenes.push(...found);
  }
  assert.equal(scenes.length, 3);
  assert.ok(decoder.complete);
  await decoder.finish();
  assert.ok(same(scenes[0], decode(BYTES, { maxLayer: 0 })), "later layers left the first scene alone");
  await end();
});

test("all layers in one block, and the block stays with its owner unless it is given away", async () => {
  const { decoder, end } = inThread();
  const scenes = await decoder.feed(BYTES);
  assert.equal(BYTES.length > 0, true);
  assert.deepEqual(scenes.map(({ layers }) => layers.length), [1, 2, 3]);
  assert.ok(same(scenes[2], decode(BYTES)));
  await end();
});

test("faults come across with kind and place, and rewind goes on behind the last good layer", async () => {
  const { decoder, end } = inThread();
  const damaged = readVector("faulty/crc-layer-1");
  assert.equal((await decoder.feed(damaged)).length, 1);
  /** @type {any} */
  const fault = await decoder.feed(new Uint8Array(0)).catch((error) => error);
  assert.ok(fault instanceof DecodeError);
  assert.deepEqual([fault.kind, fault.chunk], ["ChecksumMismatch", 1]);
  assert.match(fault.message, /^[^\n]*\(chunk 1, offset \d+\)$/);
  await decoder.rewind();
  await assert.rejects(decoder.finish(), { kind: "Truncated" });
  await end();
});

test("maxLayer is passed on, a wrong one shows at the first call", async () => {
  const first = inThread({ maxLayer: 0 });
  assert.equal((await first.decoder.feed(BYTES)).length, 1);
  assert.ok(first.decoder.complete);
  await first.end();
  const wrong = inThread({ maxLayer: -1 });
  await assert.rejects(wrong.decoder.feed(BYTES), /maxLayer is -1/);
  await wrong.end();
});

test("calls that wait reject when the decoder is closed, and later ones too", async () => {
  const { decoder, end } = inThread();
  const waiting = decoder.feed(BYTES);
  decoder.close();
  await assert.rejects(waiting, /closed/);
  await assert.rejects(decoder.feed(BYTES), /closed/);
  await end();
});

test("nothing is transferred twice where scenes share arrays", () => {
  /** @type {any[]} */
  const sent = [];
  const port = { postMessage: (/** @type {any} */ ...message) => void sent.push(message), onmessage: /** @type {any} */ (null) };
  serve(port);
  port.onmessage({ data: { id: 0, open: {} } });
  port.onmessage({ data: { id: 1, feed: BYTES } });
  const [answer, buffers] = sent[1];
  assert.equal(answer.scenes.length, 3);
  assert.equal(new Set(buffers).size, buffers.length);
  structuredClone(answer, { transfer: buffers });
  assert.equal(answer.scenes[0].feature.length, 0, "the arrays were given away");
});
