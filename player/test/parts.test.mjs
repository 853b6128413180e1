// Parts of the decoder against the specification's tables and against other implementations.

import assert from "node:assert/strict";
import { createHash } from "node:crypto";
import { readFileSync } from "node:fs";
import { test } from "node:test";
import { crc32 as zlibCrc32 } from "node:zlib";

import { AnsDecoder } from "../decode/ans.js";
import { crc32, hex, sha256 } from "../decode/digests.js";
import { M, Prior, T, normTable } from "../decode/tables.js";

const TEXT = readFileSync(new URL("../../spec/format.md", import.meta.url), "utf8");

/** Numbers in 0..1 that are the same in every run. @param {number} seed */
function random(seed) {
  return () => {
    seed = (Math.imul(seed, 1664525) + 1013904223) >>> 0;
    return seed / 2 ** 32;
  };
}

test("T and M are those of 7.3, far from where rounding could turn", () => {
  const stated = /** @type {RegExpExecArray} */ (/have\s+the\s+CRC-32\s+(\w{8}) and (\w{8})\./.exec(TEXT)).slice(1);
  const sums = [T, M].map((list) => crc32(new Uint8Array(Uint32Array.from(list).buffer)));
  assert.deepEqual(sums, stated.map((text) => parseInt(text, 16)));
  for (let j = 1; j < 64; j++) {
    const exact = 2 ** (31 - j / 64);
    assert.ok(Math.abs(exact - Math.floor(exact) - 0.5) > 1e-4, `M[${j}]`);
  }
});

test("NormTable gives the table of 7.3", () => {
  const [, numbers] = /** @type {RegExpExecArray} */ (
    /Check:\s+m = 7, mu8 = 832, si = 0 gives ([\d, ]+), 2\^24\./.exec(TEXT)
  );
  assert.deepEqual([...normTable(7, { mu8: 832, si: 0 })], [...numbers.split(", ").map(Number), 2 ** 24]);
});

test("tables ascend strictly from 0 to 2^24", () => {
  const draw = random(1);
  for (let round = 0; round < 200; round++) {
    const n = 2 + Math.floor(draw() * 400);
    const normal = () => ({
      mu8: Math.floor((draw() - 0.5) * 1e6),
      si: Math.floor(draw() * 1921) - 640,
    });
    const first = normal();
    const mixed = normTable(n, first, normal(), 1 + Math.floor(draw() * 255));
    for (const cum of [normTable(n, first), mixed]) {
      assert.equal(cum.length, n + 1);
      assert.equal(cum[0], 0);
      assert.equal(cum[n], 2 ** 24);
      for (let q = 0; q < n; q++) assert.ok(cum[q] < cum[q + 1]);
    }
  }
});

test("ANS decodes as the recurrence of 7.5 does in whole numbers", () => {
  const draw = random(2);
  for (let round = 0; round < 60; round++) {
    const words = Array.from({ length: Math.floor(draw() * 40) }, () => Math.floor(draw() * 2 ** 32));
    if (words.length) words[0] = Math.max(words[0], 1);
    const bytes = new Uint8Array(Uint32Array.from(words).buffer);
    const n = 2 + Math.floor(draw() * (round % 2 ? 4000 : 30));
    const cum = normTable(n, { mu8: 128 * n, si: Math.floor(draw() * 800) - 200 });
    const kmin = Math.floor(draw() * 100) - 50;
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
    stream.symbols(new Prior(kmin, cum), symbols, 0, count);
    for (const symbol of symbols) {
      const s = symbol - kmin;
      const q = Number(x & 0xffffffn);
      assert.ok(cum[s] <= q && q < cum[s + 1]);
      step(cum[s], cum[s + 1]);
    }
    const numbers = new Int32Array(10);
    stream.symbols(new Prior(0, Int32Array.from({ length: 33 }, (_, i) => i << 19)), numbers, 0, 10);
    for (const number of numbers) {
      assert.equal(number, Number(x & 0xffffffn) >> 19);
      step(number << 19, (number + 1) << 19);
    }
    if (x === 0n && at === words.length) stream.finish();
    else assert.throws(() => stream.finish(), { name: "DecodeError", kind: "Malformed" });
  }
});

test("CRC-32, in pieces too, and SHA-256 agree with Node's", () => {
  const draw = random(3);
  for (const length of [0, 1, 7, 8, 55, 56, 63, 64, 65, 127, 128, 1000, 4097]) {
    const bytes = Uint8Array.from({ length }, () => draw() * 256);
    const cut = Math.floor(draw() * (length + 1));
    if (zlibCrc32) assert.equal(crc32(bytes), zlibCrc32(bytes));
    assert.equal(crc32(bytes.subarray(cut), crc32(bytes.subarray(0, cut))), crc32(bytes));
    assert.equal(hex(sha256(bytes)), createHash("sha256").update(bytes).digest("hex"));
  }
  assert.equal(crc32(new TextEncoder().encode("123456789")), 0xcbf43926);
});
