// Parts of the decoder against worked checks of the specification, and against other implementations.

import assert from "node:assert/strict";
import { createHash } from "node:crypto";
import { readFileSync } from "node:fs";
import { test } from "node:test";
import { crc32 as zlibCrc32 } from "node:zlib";

import { AnsDecoder } from "../decode/ans.js";
import { ByteReader, MAX_VARINT } from "../decode/bytes.js";
import { Sha256, crc32, hex } from "../decode/digests.js";
import { DecodeError } from "../decode/errors.js";
import { dequantise, transposed } from "../decode/layer.js";
import { Real, unpack } from "../decode/msgpack.js";
import { activityBounds, addRelativeMagnitudes, classesByActivity, groupByClass } from "../decode/stages.js";
import { M, T, Table, histogramTable, mixtureTable, normTable } from "../decode/tables.js";
import { VoxelTable } from "../decode/voxels.js";

const TEXT = readFileSync(new URL("../../spec/format.md", import.meta.url), "utf8");

/** The numbers of a table of appendix B. @param {string} heading */
function printed(heading) {
  const block = TEXT.split(`### ${heading}\n`)[1].split("```")[1];
  return block.trim().split(/\s+/).map(Number);
}

/** @param {() => unknown} run */
function kindOf(run) {
  try {
    run();
  } catch (error) {
    if (error instanceof DecodeError) return error.kind;
    throw error;
  }
  return null;
}

/** Numbers in 0..1 that are the same in every run. @param {number} seed */
function random(seed) {
  return () => {
    seed = (Math.imul(seed, 1664525) + 1013904223) >>> 0;
    return seed / 2 ** 32;
  };
}

test("T and M are those of appendix B, far from where rounding could turn", () => {
  assert.deepEqual([...T], printed("B.1 T"));
  assert.deepEqual([...M], printed("B.2 M"));
  for (let j = 1; j < 64; j++) {
    const exact = 2 ** (31 - j / 64);
    assert.ok(Math.abs(exact - Math.floor(exact) - 0.5) > 1e-4, `M[${j}]`);
  }
});

test("NormTable gives the table of 7.3", () => {
  const [, numbers] = /** @type {RegExpExecArray} */ (
    /Check: n = 7, mu8 = 832, si = 0, fl = 1 gives ([\d, ]+), 2\^24\./.exec(TEXT)
  );
  assert.deepEqual([...normTable(7, 832, 0, 1)], [...numbers.split(", ").map(Number), 2 ** 24]);
});

test("tables ascend strictly from 0 to 2^24", () => {
  const draw = random(1);
  for (let round = 0; round < 200; round++) {
    const n = 2 + Math.floor(draw() * 400);
    const normal = () => ({
      mu8: Math.floor((draw() - 0.5) * 1e6),
      si: Math.floor(draw() * 1921) - 640,
      floor: draw() < 0.5 ? 1 : 16,
    });
    const first = normal();
    const top = 1 + Math.floor(draw() * 31);
    const classes = Int32Array.from({ length: n }, () => Math.floor(draw() * (top + 1)));
    classes[0] = 1;
    for (const cum of [
      normTable(n, first.mu8, first.si, first.floor),
      mixtureTable(n, first, normal(), 1 + Math.floor(draw() * 255)),
      histogramTable(classes, top, 64),
    ]) {
      assert.equal(cum.length, n + 1);
      assert.equal(cum[0], 0);
      assert.equal(cum[n], 2 ** 24);
      for (let q = 0; q < n; q++) assert.ok(cum[q] < cum[q + 1]);
    }
  }
});

test("ANS decodes as the recurrence of 7.7 does in whole numbers", () => {
  const draw = random(2);
  for (let round = 0; round < 60; round++) {
    const words = Array.from({ length: Math.floor(draw() * 40) }, () => Math.floor(draw() * 2 ** 32));
    if (words.length) words[0] = Math.max(words[0], 1);
    const bytes = new Uint8Array(Uint32Array.from(words).buffer);
    const n = 2 + Math.floor(draw() * (round % 2 ? 4000 : 30));
    const cum = normTable(n, 128 * n, Math.floor(draw() * 800) - 200, 1);
    let x = 0n;
    let at = 0;
    const refill = () => {
      while (x < 2n ** 32n && at < words.length) x = x * 2n ** 32n + BigInt(words[at++]);
    };
    refill();
    const step = (/** @type {number} */ low, /** @type {number} */ high) => {
      x = (x >> 24n) * BigInt(high - low) + (x & 0xffffffn) - BigInt(low);
      refill();
    };
    const stream = new AnsDecoder(bytes);
    const count = 50 + words.length * 2;
    const symbols = new Int32Array(count);
    stream.symbols(new Table(cum), symbols, 0, count);
    for (const s of symbols) {
      const q = Number(x & 0xffffffn);
      assert.ok(cum[s] <= q && q < cum[s + 1]);
      step(cum[s], cum[s + 1]);
    }
    const numbers = new Int32Array(10);
    stream.addUniform(5, numbers, 0, 10);
    for (const number of numbers) {
      assert.equal(number, Number(x & 0xffffffn) >> 19);
      step(number << 19, (number + 1) << 19);
    }
    assert.equal(kindOf(() => stream.finish()), x === 0n && at === words.length ? null : "Malformed");
  }
});

test("relative magnitudes and classes are those of 8.9", () => {
  const sums = new Float64Array(4);
  addRelativeMagnitudes(Int32Array.of(3, -1, 0, 4), sums);
  assert.deepEqual([...sums], [341, 113, 0, 455]);
  const activity = Float64Array.of(5, 1, 5, 9, 1, 7);
  const bounds = activityBounds(activity, 3);
  assert.deepEqual(bounds, [5, 7]);
  const classes = classesByActivity(activity, bounds);
  assert.deepEqual([...classes], [1, 0, 1, 2, 0, 2]);
  const { order, sizes } = groupByClass(classes, 3);
  assert.deepEqual([...order], [1, 4, 0, 2, 3, 5]);
  assert.deepEqual([...sizes], [2, 2, 2]);
});

test("relative magnitudes are exact where products pass 2^53", () => {
  const n = 1 << 22; // 2^24 times 256 n is 2^54
  const residuals = new Int32Array(n);
  residuals.set([2 ** 24 - 1, -(2 ** 24 - 3), 5, 1]);
  const sums = new Float64Array(n);
  addRelativeMagnitudes(residuals, sums);
  const total = residuals.reduce((sum, e) => sum + Math.abs(e), 1);
  for (let p = 0; p < 6; p++) {
    const exact = (BigInt(Math.abs(residuals[p])) * BigInt(256 * n)) / BigInt(total);
    assert.equal(BigInt(sums[p]), exact);
  }
});

test("values are the product rounded once to binary32, by rows where symbols come by columns", () => {
  const step = Math.fround(0.1);
  const symbols = Int32Array.of(-(2 ** 23), 2 ** 23, 1, -1, 0, 12345677);
  assert.deepEqual([...dequantise(symbols, step)], [...symbols].map((k) => Math.fround(k * step)));
  assert.deepEqual([...transposed(Int32Array.of(1, 2, 3, 4, 5, 6), 3, 2, 1, null)], [1, 4, 2, 5, 3, 6]);
  assert.equal(kindOf(() => dequantise(Int32Array.of(2), 3e38)), "Malformed");
  assert.deepEqual([...dequantise(Int32Array.of(1, -1), Math.fround(3e38))], [3e38, -3e38].map(Math.fround));
  assert.equal(dequantise(Int32Array.of(3), 2 ** -126)[0], 3 * 2 ** -126);
});

test("with step classes a value is its centre plus the symbol times 2^class, and that lies in its range", () => {
  const symbols = Int32Array.of(3, -1, 0, 5, -7, 2); // two columns of three rows
  const grading = { centres: [10, -4], stepClasses: Int32Array.of(0, 6, 2) };
  assert.deepEqual([...transposed(symbols, 3, 2, 0.5, grading)], [13, 1, -54, -452, 10, 4].map((level) => level / 2));
  /** @param {number} symbol @param {number} centre @param {number} stepClass */
  const kind = (symbol, centre, stepClass) =>
    kindOf(() => transposed(Int32Array.of(symbol), 1, 1, 1, { centres: [centre], stepClasses: Int32Array.of(stepClass) }));
  assert.equal(kind(2 ** 17 - 1, 64, 6), null);
  assert.equal(kind(2 ** 17 - 1, 65, 6), "Malformed");
  assert.equal(kind(-(2 ** 17), 0, 6), null);
  assert.equal(kind(-(2 ** 17), -1, 6), "Malformed");
  assert.equal(kind(2 ** 23, 2 ** 23, 6), "Malformed");
});

test("CRC-32 and SHA-256 agree with Node's, in pieces too", () => {
  const draw = random(3);
  for (const length of [0, 1, 7, 8, 55, 56, 63, 64, 65, 127, 128, 1000, 4097]) {
    const bytes = Uint8Array.from({ length }, () => draw() * 256);
    const cut = Math.floor(draw() * (length + 1));
    if (zlibCrc32) assert.equal(crc32(bytes), zlibCrc32(bytes));
    assert.equal(crc32(bytes.subarray(cut), crc32(bytes.subarray(0, cut))), crc32(bytes));
    const expected = createHash("sha256").update(bytes).digest("hex");
    assert.equal(hex(new Sha256().update(bytes).digest()), expected);
    assert.equal(hex(new Sha256().update(bytes.subarray(0, cut)).update(bytes.subarray(cut)).digest()), expected);
  }
  assert.equal(crc32(new TextEncoder().encode("123456789")), 0xcbf43926);
});

test("varints and zigzag integers of 7.1", () => {
  const read = (/** @type {number[]} */ bytes, limit = MAX_VARINT) => new ByteReader(Uint8Array.from(bytes)).varint(limit, "it");
  assert.equal(read([0]), 0);
  assert.equal(read([0xac, 2]), 300);
  assert.equal(read([255, 255, 255, 255, 127]), 2 ** 35 - 1);
  assert.equal(kindOf(() => read([0x80, 0])), "Malformed");
  assert.equal(kindOf(() => read([0x80])), "Malformed");
  assert.equal(kindOf(() => read([128, 128, 128, 128, 128, 1])), "Malformed");
  assert.equal(kindOf(() => read([11], 10)), "LimitExceeded");
  const zigzag = (/** @type {number[]} */ bytes) => new ByteReader(Uint8Array.from(bytes)).zigzag(2 ** 31, "it");
  assert.deepEqual([[0], [1], [2], [3]].map(zigzag), [0, -1, 1, -2]);
  assert.equal(zigzag([255, 255, 255, 255, 15]), -(2 ** 31));
  assert.equal(kindOf(() => zigzag([129, 128, 128, 128, 16])), "LimitExceeded");
});

test("msgpack keeps integers, reals, booleans, texts and bytes apart", () => {
  const of = (/** @type {number[]} */ ...bytes) => unpack(Uint8Array.from(bytes), "it").value;
  assert.deepEqual(of(0x94, 1, 0xca, 0x3f, 0x80, 0, 0, 0xc3, 0xa1, 65), [1, new Real(1), true, "A"]);
  assert.deepEqual(of(0xcf, 0, 0, 0, 1, 0, 0, 0, 2), 2 ** 32 + 2);
  assert.deepEqual(of(0xd3, 255, 255, 255, 255, 127, 255, 255, 255), -(2 ** 31) - 1);
  assert.deepEqual(of(0xc4, 2, 1, 2), Uint8Array.of(1, 2));
  assert.equal(unpack(Uint8Array.of(0x82, 1, 2, 3, 4), "it").firstEntryEnd, 3);
  assert.equal(kindOf(() => of(0x81, 0xca, 0, 0, 0, 0, 1)), "Malformed");
  assert.equal(kindOf(() => of(0xdd, 255, 255, 255, 255)), "Malformed");
});

test("a table of voxels finds what was added and nothing else", () => {
  const draw = random(4);
  const table = new VoxelTable();
  const known = new Set();
  for (let round = 0; round < 40; round++) {
    /** @type {number[][]} */
    const added = [];
    for (let i = 0; i < 1 + 20 * (round % 3); i++) {
      const voxel = [0, 1, 2].map(() => Math.floor(draw() * 9) - 4);
      assert.equal(table.has(voxel[0], voxel[1], voxel[2]), known.has(`${voxel}`) && !added.map(String).includes(`${voxel}`));
      if (!known.has(`${voxel}`)) added.push(voxel);
      known.add(`${voxel}`);
    }
    table.add(Int32Array.from(added.flat()));
    assert.ok(added.every(([x, y, z]) => table.has(x, y, z)));
  }
  assert.ok(known.size > 300 && !table.has(99, 0, 0));
});
