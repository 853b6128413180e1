// Evaluating without a GPU: the kernel in WebAssembly against its reference in JavaScript.

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { test } from "node:test";

import { decode } from "../decode/index.js";
import { evaluate } from "../render/evaluate.js";
import { Arena } from "../render/kernel.js";

/** Numbers in -1..1 that are the same in every run. @param {number} count */
function numbers(count) {
  let state = 1;
  return Float32Array.from({ length: count }, () => (state = (state * 48271) % 2147483647) / 1073741824 - 1);
}

/** @param {ArrayLike<number>} a @param {ArrayLike<number>} b */
function farthest(a, b) {
  assert.equal(a.length, b.length);
  return Array.from(a).reduce((most, value, i) => Math.max(most, Math.abs(value - b[i])), 0);
}

for (const [inputs, outputs, rows, relu] of /** @type {[number, number, number, boolean][]} */ ([
  [1, 1, 1, false],
  [35, 32, 256, true],
  [3, 70, 5, false],
  [64, 16, 2, true],
  [300, 33, 3, false],
  [4, 4, 0, false],
])) {
  test(`${rows} rows of ${inputs} to ${outputs}${relu ? ", ReLU" : ""}`, () => {
    const layer = { inputs, outputs, weight: numbers(inputs * outputs), bias: numbers(outputs) };
    const stride = inputs + 3; // rows may lie further apart than they are long
    const [fast, plain] = [new Arena(), new Arena(false)].map((arena) => {
      arena.take(20_000); // more than a page of memory
      const packed = arena.pack(layer, relu);
      const x = arena.take(rows * stride);
      const out = arena.take(rows * Arena.stride(packed) + 4);
      arena.floats.set(numbers(rows * stride), x);
      arena.floats.fill(7, out, out + rows * Arena.stride(packed) + 4);
      arena.linear(packed, rows, x, stride, out);
      return { arena, values: arena.floats.slice(out, out + rows * Arena.stride(packed) + 4) };
    });
    assert.ok(fast.arena.fast && !plain.arena.fast);
    assert.ok(farthest(fast.values, plain.values) < 1e-6 * inputs);
    assert.deepEqual([...fast.values.slice(-4)], [7, 7, 7, 7]); // nothing behind the last row
  });
}

test("a value that is no number stays none", () => {
  for (const arena of [new Arena(), new Arena(false)]) {
    const packed = arena.pack({ inputs: 1, outputs: 1, weight: new Float32Array([1]), bias: new Float32Array([0]) }, true);
    const [x, out] = [arena.take(1), arena.take(16)];
    arena.floats[x] = NaN;
    arena.linear(packed, 1, x, 1, out);
    assert.ok(Number.isNaN(arena.floats[out]));
  }
});

test("both evaluate a scene alike, at every level", () => {
  const scene = decode(readFileSync(new URL("../../spec/vectors/valid/layers-0-1-2.pd4", import.meta.url)));
  for (const level of scene.layers) {
    const [fast, plain] = [true, false].map((wasm) => evaluate(scene, level, 0.4, [0, 0, -3], new Arena(wasm)));
    assert.ok(fast.count > 0);
    assert.deepEqual(fast.slot, plain.slot);
    for (const name of /** @type {const} */ (["mean", "opacity", "scale", "quaternion", "color"])) {
      const size = plain[name].reduce((most, value) => Math.max(most, Math.abs(value)), 1e-3);
      assert.ok(farthest(fast[name], plain[name]) < 1e-4 * size, name);
    }
  }
});
