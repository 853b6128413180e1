import assert from "node:assert/strict";
import { test } from "node:test";
import { isDeepStrictEqual } from "node:util";

import { DecodeError, decode, decodeTensors, hashes, openStream } from "../decode/index.js";
import { endsOf, readScaffold, readVector, readVectors, same } from "../testing/vectors.mjs";
/** @import { Scene } from "../decode/index.js" */

const VECTORS = readVectors();

/** The DecodeError that a function raises, or null. @param {() => unknown} run */
function faultOf(run) {
  try {
    run();
  } catch (error) {
    assert.ok(error instanceof DecodeError, String(error));
    assert.ok(!error.message.includes("\n") && error.message.length < 500, error.message);
    return error;
  }
  return null;
}

test("there are vectors of every sort", () => {
  assert.ok(VECTORS.filter(({ error }) => error === null).length > 100);
  const kinds = new Set(VECTORS.map(({ error }) => error));
  assert.equal(kinds.size, 10, [...kinds].join());
});

/** What a fault is, and where. @param {DecodeError | null} fault */
const placed = (fault) => fault && [fault.kind, fault.chunk, fault.offset];

/** @typedef {(typeof VECTORS)[number]} Vector */

/** Runs a check on every vector of a folder and names those that fail. @param {string} folder
 * @param {(vector: Vector, index: number) => void} check */
function eachOf(folder, check) {
  /** @type {string[]} */
  const failures = [];
  VECTORS.forEach((vector, index) => {
    if (!vector.file.startsWith(folder)) return;
    try {
      check(vector, index);
    } catch (error) {
      failures.push(`${vector.file}: ${error instanceof Error ? error.message.slice(0, 300) : error}`);
    }
  });
  assert.equal(failures.length, 0, failures.join("\n"));
}

/** Bytes that a stream is fed at a time, one of them per vector. */
const PIECES = [1, 7, 1000];

for (const folder of new Set(VECTORS.map(({ file }) => file.split("/")[0]))) {
  test(`vectors of ${folder}: hashes, or the named error at its place`, () => {
    eachOf(folder, ({ bytes, base, error, chunk, offset, layers }) => {
      const fault = faultOf(() => assert.deepEqual(hashes(bytes, { base }), layers));
      assert.equal(fault?.kind ?? null, error, fault?.message);
      if (fault && error !== null) {
        assert.equal(fault.chunk, chunk);
        if (offset !== null) assert.equal(fault.offset, offset);
      }
      for (let i = 0; i + 1 < layers.length; i++) {
        assert.deepEqual(hashes(bytes, { base, maxLayer: layers[i].layer }), layers.slice(0, i + 1));
      }
    });
  });

  test(`vectors of ${folder}: a scene, or the error of tensors that are none`, () => {
    eachOf(folder, ({ bytes, base, error, scene }) => {
      if (error === null) assert.equal(faultOf(() => decode(bytes, { base }))?.kind ?? null, scene);
    });
  });

  test(`vectors of ${folder}: a stream of any pieces yields each layer, then the same error`, () => {
    eachOf(folder, ({ file, bytes, base, layers, slices }, index) => {
      // a second or three each to decode, without other code than the rest
      if (file.startsWith("worst-case/") || file === "valid/planes-products-over-2-53.pd4") return;
      const size = PIECES[index % PIECES.length];
      const stream = openStream({ base });
      /** @type {Scene[]} */
      const scenes = [];
      const fault = faultOf(() => {
        for (let at = 0; at < bytes.length; at += size) scenes.push(...stream.feed(bytes.subarray(at, at + size)));
        stream.finish();
      });
      const expected = placed(faultOf(() => decode(bytes, { base })));
      assert.deepEqual(placed(fault), expected);
      if (!isDeepStrictEqual(expected, placed(faultOf(() => hashes(bytes, { base }))))) return; // tensors that are no scene
      const seen = scenes.map((scene) => scene.layers.length);
      assert.deepEqual([...new Set(seen)], [...new Set(slices)].map((_, i) => i + 1));
      assert.deepEqual(seen, [...seen].sort());
      assert.ok(scenes.length <= slices.length);
      const whole = bytes.subarray(0, stream.consumed);
      if (scenes.length) assert.deepEqual(hashes(whole, { base, allowPartial: true }), layers);
      if (scenes.length && !expected) assert.ok(same(scenes[scenes.length - 1], decode(bytes, { base })));
    });
  });
}

test("a scene has the arrays that kinds/ describes", () => {
  const scene = readScaffold("valid/layers-0-1-2");
  const n = scene.rows[scene.rows.length - 1];
  const { feature, slots, views } = scene.widths;
  assert.deepEqual(scene.layers, [0, 1, 2]);
  assert.ok(n > 0);
  assert.deepEqual(
    [scene.anchorQ, scene.anchor, scene.feature, scene.scalingLog, scene.offset].map(({ length }) => length / n),
    [3, 3, feature, 6, 3 * slots],
  );
  assert.deepEqual(scene.mask.map(({ length }) => length), scene.rows);
  assert.deepEqual(scene.fill, scene.layers.map(() => scene.info.background));
  assert.ok(scene.anchorQ instanceof Int32Array && scene.mask[0] instanceof Uint8Array);
  scene.anchor.forEach((x, i) => assert.equal(x, Math.fround(scene.anchorQ[i] * scene.info.voxelSize)));
  /** @param {import("../decode/index.js").Network} network @param {number} first @param {number} last */
  const check = (network, first, last) => {
    assert.equal(network[0].inputs, first);
    assert.equal(network[network.length - 1].outputs, last);
    for (const { weight, bias, inputs, outputs } of network) {
      assert.equal(weight.length, inputs * outputs);
      assert.equal(bias.length, outputs);
    }
  };
  const { opacity, covariance, color } = scene.networks;
  [opacity, covariance, color].forEach((network, i) => {
    check(network, feature + (views & (1 << i) ? 3 : 0), [1, 7, 3][i] * slots);
  });
  const [still, ...motions] = scene.motion;
  assert.equal(still, null);
  for (const motion of motions) {
    assert.ok(motion);
    const inner = motion.trunk[motion.trunk.length - 1].outputs;
    check(motion.trunk, motion.planes.length * motion.planes[0].xy.channels, inner);
    assert.equal(motion.heads.length, 4);
    motion.heads.forEach((head, i) => head && check(head, inner, [3, feature, 6, 3 * slots][i]));
    for (const scale of motion.planes) {
      assert.deepEqual(Object.keys(scale), ["xy", "xz", "xt", "yz", "yt", "zt"]);
      /** @type {Record<string, number>} */
      const sides = {};
      for (const [[a, b], { data, channels, height, width }] of Object.entries(scale)) {
        assert.equal(data.length, channels * height * width);
        assert.equal(width, (sides[a] ??= width));
        assert.equal(height, (sides[b] ??= height));
      }
    }
  }
  assert.ok((motions[1]?.planes.length ?? 0) > (motions[0]?.planes.length ?? 0), "layer 2 reads the planes of layer 1");
});

test("what is no scene has tensors all the same, and says of what kind it is", () => {
  const unknown = VECTORS.find(({ scene }) => scene === "UnsupportedFeature");
  assert.ok(unknown);
  const { header, layers, rows } = decodeTensors(unknown.bytes);
  const n = layers[layers.length - 1].codes.length;
  assert.deepEqual(rows.map(({ length }) => length), header.rows.map(({ channels }) => channels * n));
  assert.match(faultOf(() => decode(unknown.bytes))?.message ?? "", / of kind \d+, expected 0 \((scaffold|hexplane)\)/);
});

test("a cut file raises Truncated, or gives its longest prefix if asked", () => {
  const bytes = readVector("faulty/cut-layer-2-payload-middle");
  assert.equal(faultOf(() => decode(bytes))?.kind, "Truncated");
  assert.deepEqual(decode(bytes, { allowPartial: true }).layers, [0, 1]);
  assert.equal(faultOf(() => decode(bytes.subarray(0, 300), { allowPartial: true }))?.kind, "Truncated");
  const damaged = readVector("faulty/crc-layer-2");
  assert.equal(faultOf(() => decode(damaged, { allowPartial: true }))?.kind, "ChecksumMismatch");
});

test("decode takes an ArrayBuffer, and bytes at odd addresses", () => {
  const bytes = readVector("valid/layers-0-1-2");
  const whole = decode(bytes);
  assert.ok(same(decode(bytes.slice().buffer), whole));
  const moved = new Uint8Array(bytes.length + 1);
  moved.set(bytes, 1);
  assert.ok(same(decode(moved.subarray(1)), whole));
});

test("maxLayer is a number of 0 or more", () => {
  for (const maxLayer of [-1, 0.5, NaN]) {
    assert.throws(() => decode(readVector("valid/one-anchor"), { maxLayer }), RangeError);
    assert.throws(() => openStream({ maxLayer }), RangeError);
  }
});

test("a stream raises its fault again at every call, and continues after rewind", () => {
  const bytes = readVector("valid/layers-0-1-2");
  const stream = openStream();
  const ends = endsOf(bytes);
  assert.deepEqual(ends.map(({ layer }) => layer), [0, 1, 2]);
  assert.equal(ends[2].end, bytes.length);
  const damaged = bytes.slice();
  damaged[ends[1].end - 10] ^= 1;
  assert.deepEqual(stream.feed(damaged).map(({ layers }) => layers), [[0]]);
  for (let i = 0; i < 2; i++) assert.equal(faultOf(() => stream.feed(new Uint8Array(0)))?.kind, "ChecksumMismatch");
  assert.equal(faultOf(() => stream.finish())?.kind, "ChecksumMismatch");
  assert.equal(stream.consumed, ends[0].end);
  stream.rewind();
  const rest = stream.feed(bytes.subarray(stream.consumed));
  assert.deepEqual(rest.map(({ layers }) => layers), [[0, 1], [0, 1, 2]]);
  assert.ok(same(rest[1], decode(bytes)));
  stream.finish();
});

test("earlier scenes do not change as later layers arrive", () => {
  const bytes = readVector("valid/layers-0-1-2");
  const [{ end }] = endsOf(bytes);
  const stream = openStream();
  const [first] = stream.feed(bytes.subarray(0, end));
  const kept = structuredClone(first);
  stream.feed(bytes.subarray(end));
  assert.ok(same(first, kept));
});

test("bytes behind the last requested layer are not read", () => {
  const bytes = readVector("valid/layers-0-1-2");
  const end = endsOf(bytes)[0].end;
  const damaged = bytes.slice();
  damaged.fill(255, end);
  assert.ok(same(decode(damaged, { maxLayer: 0 }), decode(bytes, { maxLayer: 0 })));
  const stream = openStream({ maxLayer: 0 });
  assert.equal(stream.feed(damaged).length, 1);
  assert.ok(stream.complete);
  assert.deepEqual(stream.feed(damaged), []);
  stream.finish();
});

test("a file that is cut before its first slice shows its base over its own background", () => {
  const [base, bytes] = [readVector("valid/base"), readVector("valid/adds-header")];
  const cut = decode(bytes.subarray(0, -30), { base, allowPartial: true });
  assert.notDeepEqual(cut.info.background, decode(base).info.background);
  assert.deepEqual(cut.fill, [cut.info.background]);
});
