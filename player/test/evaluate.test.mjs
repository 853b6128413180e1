// Drawing without a GPU: the evaluator's kernel in WebAssembly against plain JavaScript, lists, order, pace, cameras.

import assert from "node:assert/strict";
import { test } from "node:test";

import { fitted } from "../render/camera.js";
import { evaluate } from "../render/evaluate.js";
import { Arena } from "../render/kernel.js";
import { Pace, SCALES } from "../render/pace.js";
import { DepthSort, listGaussians } from "../render/sort.js";
import { readScaffold } from "../testing/vectors.mjs";

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
      const out = arena.take(rows * packed.stride + 4);
      arena.floats.set(numbers(rows * stride), x);
      arena.floats.fill(7, out, out + rows * packed.stride + 4);
      arena.linear(packed, rows, x, stride, out);
      return { arena, values: arena.floats.slice(out, out + rows * packed.stride + 4) };
    });
    assert.ok(fast.arena.fast && !plain.arena.fast);
    assert.ok(farthest(fast.values, plain.values) < 1e-6 * inputs);
    assert.deepEqual([...fast.values.slice(-4)], [7, 7, 7, 7]); // nothing behind the last row
  });
}

test("a spread enlarges the scales alone", () => {
  const scene = readScaffold("valid/layers-0-1-2");
  const wide = { ...scene, spread: scene.spread.map((spread) => 1.5 * spread) };
  for (const level of scene.layers) {
    const [before, after] = [scene, wide].map((own) => evaluate(own, level, 0.4, [0, 0, -3], new Arena()).records);
    assert.ok(before.length > 0);
    before.forEach((v, i) => {
      const wanted = i % 16 >= 4 && i % 16 < 7 ? 1.5 * v : v;
      assert.ok(Math.abs(after[i] - wanted) <= 1e-6 * Math.abs(wanted));
    });
  }
});

test("a value that is no number stays none", () => {
  for (const arena of [new Arena(), new Arena(false)]) {
    const layer = { inputs: 1, outputs: 1, weight: Float32Array.of(1), bias: Float32Array.of(0) };
    const packed = arena.pack(layer, true);
    const [x, out] = [arena.take(1), arena.take(16)];
    arena.floats[x] = NaN;
    arena.linear(packed, 1, x, 1, out);
    assert.ok(Number.isNaN(arena.floats[out]));
  }
});

test("both evaluate a scene alike, at every level", () => {
  const scene = readScaffold("valid/layers-0-1-2");
  for (const level of scene.layers) {
    const [fast, plain] = [true, false].map((wasm) => evaluate(scene, level, 0.4, [0, 0, -3], new Arena(wasm)));
    assert.ok(fast.count > 0);
    assert.deepEqual(fast.slot, plain.slot);
    const most = plain.records.reduce((largest, v) => Math.max(largest, Math.abs(v)), 1);
    assert.ok(farthest(fast.records, plain.records) < 1e-4 * most);
  }
});

for (const [name, key] of /** @type {[string, number][]} */ ([["least", 0], ["largest", 1]])) {
  test(`layer 1 changes nothing at its key instant, the ${name}`, () => {
    const file = readScaffold(`uncommon/key-instant-${name}`);
    const rows = file.rows.map(() => file.anchor.length / 3); // the levels have the same anchors
    const scene = { ...file, rows, mask: rows.map((count) => new Uint8Array(count).fill(255)) };
    const motion = scene.motion[1];
    for (const { data } of motion?.planes.flatMap((planes) => Object.values(planes)) ?? []) {
      data.set(numbers(data.length).map((v) => 1 + v)); // and layer 1 moves them
    }
    motion?.trunk[0].bias.fill(1);
    const [still, same, other] = [[0, 0.4], [1, key], [1, 0.4]].map(([level, t]) => {
      return evaluate(scene, level, t, [0, 0, -3]).records;
    });
    assert.ok(still.length > 0);
    assert.ok(farthest(same, still) < 1e-6);
    assert.ok(farthest(other, still) > 1e-3);
  });
}

test("Gaussians are sorted back to front; of equal depths the later ones come first", () => {
  const means = numbers(2000).map((v, i) => (i % 4 === 2 ? Math.round(10 * v) / 10 : v));
  const order = [...new DepthSort().sort(means, [0, 0, 1, 0.5], 0.1)];
  const depth = (/** @type {number} */ i) => Math.fround(means[4 * i + 2] + 0.5);
  const shown = Array.from({ length: 500 }, (_, i) => i).filter((i) => depth(i) > 0.1 && means[4 * i + 3] >= 0);
  assert.deepEqual(order.slice().sort((a, b) => a - b), shown);
  for (let i = 1; i < order.length; i++) {
    const [a, b] = [order[i - 1], order[i]];
    assert.ok(depth(a) > depth(b) || (depth(a) === depth(b) && a > b));
  }
});

test("a list holds the visible Gaussians slot by slot, and those of the list before", () => {
  const opacities = new Float32Array(3 * 40 * 4);
  for (const [anchor, slot] of [[3, 0], [5, 0], [39, 9]]) opacities[((slot >> 2) * 40 + anchor) * 4 + (slot & 3)] = 0.5;
  /** @param {Float32Array} from @param {import("../render/sort.js").List | null} previous */
  const list = (from, previous) => listGaussians(from, 10, 40, previous);
  const entries = (/** @type {import("../render/sort.js").List | null} */ found) =>
    [...(found?.entries ?? [])].filter((e) => e !== 0xffffffff).map((e) => [e >>> 24, e & 0xffffff]);
  const first = list(opacities, null);
  assert.deepEqual(entries(first), [[0, 3], [0, 5], [9, 39]]);
  first?.entries.forEach((e, i) => assert.ok(e === 0xffffffff || i / first.width >= first.starts[e >>> 24]));
  assert.equal(list(opacities, first), null);
  const other = new Float32Array(opacities.length);
  other[4 * 7] = 1;
  assert.deepEqual(entries(list(other, first)), [[0, 3], [0, 5], [0, 7], [9, 39]]);
});

test("the picture gets smaller where drawing is slow, and recovers", () => {
  const pace = new Pace();
  const scales = Array.from({ length: 120 }, (_, i) => (pace.drew(i < 40 ? 200 : 2), pace.scale));
  assert.equal(scales[0], 1);
  assert.equal(scales[119], 1);
  assert.ok(scales.includes(SCALES[SCALES.length - 1]));
  for (let i = 1; i < 40; i++) assert.ok(scales[i] <= scales[i - 1]);
  for (const _ of SCALES) pace.drew(2000);
  assert.equal(pace.scale, SCALES[SCALES.length - 1], "a very slow machine is not tried long");
});

/** @param {number} width @param {number} height */
const camera = (width, height) => ({
  viewmat: new Float32Array(16), K: new Float32Array([500, 0, width / 2, 0, 500, height / 2, 0, 0, 1]), width, height,
});

/** @typedef {import("../render/camera.js").Fit} Fit */
for (const [name, capture, window, seen, fit] of /** @type {[string, number[], number[], number[], Fit?][]} */ ([
  ["a wide one shows all of a wide capture", [640, 360], [1200, 600], [720, 360]],
  ["a squarer one shows all of it", [640, 360], [400, 300], [640, 480]],
  ["an upright one shows all of a wide capture", [640, 360], [360, 720], [640, 1280]],
  ["an upright one that is covered shows nothing above and below it", [640, 360], [360, 720], [180, 360], "cover"],
  ["one that is covered shows nothing beside an upright capture", [360, 640], [500, 600], [360, 432], "cover"],
  ["one of the capture's shape shows the capture", [360, 640], [180, 320], [360, 640]],
])) {
  test(`windows: ${name}`, () => {
    const { K } = fitted(camera(capture[0], capture[1]), window[0], window[1], fit);
    [0, 1].forEach((axis) => assert.ok(Math.abs((500 / K[4 * axis]) * window[axis] - seen[axis]) < 1e-3));
    assert.deepEqual([K[2], K[5]], window.map((side) => side / 2));
  });
}
