// Scenes that are cut in time: the index, and what is brought when.

import assert from "node:assert/strict";
import { test } from "node:test";

import { Segments } from "../render/segments.js";
import { parseIndex, segmentAt, segmentsAt, weightAt } from "../render/timeline.js";

const FILE = { file: "a.pd4", bytes: 9, base: 0, time_range: [0, 2] };
const INDEX = {
  segments_version: 1,
  bases: [{ file: "base.pd4", bytes: 5 }],
  segments: [FILE, { file: "b.pd4", bytes: 9, base: null, time_range: [1.5, 4] }],
};

test("an index is read", () => {
  const { bases, segments } = parseIndex(JSON.stringify(INDEX));
  assert.equal(bases[0].file, "base.pd4");
  assert.deepEqual(segments.map(({ range }) => range), [[0, 2], [1.5, 4]]); // prettier-ignore
  assert.deepEqual([-1, 0, 1.4, 1.5, 9].map((t) => segmentAt(segments, t)), [0, 0, 0, 1, 1]); // prettier-ignore
});

test("two segments show a time at which they overlap", () => {
  const { segments } = parseIndex(JSON.stringify(INDEX));
  assert.deepEqual([1.4, 1.5, 1.9, 2, 9].map((t) => segmentsAt(segments, t)), [[0], [1, 0], [1, 0], [1], [1]]); // prettier-ignore
  assert.deepEqual([1.5, 1.625, 2, 9].map((t) => weightAt(segments, 1, t)), [0, 0.25, 1, 1]); // prettier-ignore
});

for (const [name, change] of Object.entries({
  version: { segments_version: 2 },
  "no segments": { segments: [] },
  "no list": { bases: {} },
  "too many": { segments: Array(70_000).fill(FILE) },
  address: { bases: [{ file: "../base.pd4", bytes: 5 }] },
  origin: { bases: [{ file: "//other/base.pd4", bytes: 5 }] },
  bytes: { segments: [{ ...FILE, bytes: 0.5 }] },
  base: { segments: [{ ...FILE, base: 1 }] },
  times: { segments: [FILE, FILE] },
  "a gap": { segments: [FILE, { ...FILE, file: "b.pd4", time_range: [3, 4] }] },
  "three at a time": { segments: [FILE, { ...FILE, time_range: [1, 3] }, { ...FILE, time_range: [1.5, 4] }] },
  "no time": { segments: [{ ...FILE, time_range: ["0", 2] }] },
})) {
  test(`an index with a fault is refused: ${name}`, () => {
    assert.throws(() => parseIndex(JSON.stringify({ ...INDEX, ...change })), /the index of segments is invalid/);
  });
}

/** A server of the index that has no other file. @param {string[]} asked gets the names of files */
const without = (asked) => async (/** @type {any} */ url) => {
  asked.push(new URL(url).pathname.slice(1));
  const there = asked.at(-1) === "segments.json";
  return new Response(there ? JSON.stringify(INDEX) : "", { status: there ? 200 : 404 });
};

test("what is missing is told of, and the next segment is asked for", async () => {
  /** @type {string[]} */
  const asked = [];
  /** @type {import("../render/segments.js").Part[]} */
  const told = [];
  const segments = new Segments("http://x/segments.json", without(asked), (part) => told.push(part), () => {});
  assert.ok(await segments.load({ time: 0 }));
  assert.deepEqual(asked, ["segments.json", "base.pd4", "b.pd4"]);
  assert.deepEqual(told.map(({ part }) => part), [0, 1]); // prettier-ignore
  assert.ok(told.every(({ problem }, i) => problem?.includes("404") && problem.includes(i ? "b.pd4" : "a.pd4")));
  await segments.load({ time: 3 });
  assert.deepEqual(asked.slice(3), ["b.pd4"]);
  await segments.load({ time: 1.75 }); // of both
  assert.deepEqual(asked.slice(4), ["b.pd4", "base.pd4"]);
});

test("the next segment waits for a budget that it fits in", async () => {
  /** @type {string[]} */
  const asked = [];
  const segments = new Segments("http://x/segments.json", without(asked), () => {}, () => {});
  await segments.load({ time: 0, bytes: 22 });
  assert.deepEqual(asked, ["segments.json", "base.pd4"]);
  await segments.load({ time: 0, bytes: 23 });
  assert.deepEqual(asked.slice(2), ["base.pd4", "b.pd4"]);
});

test("a later call takes the place of an earlier one", async () => {
  /** @type {string[]} */
  const asked = [];
  const segments = new Segments("http://x/segments.json", without(asked), () => {}, () => {});
  const first = segments.load({ time: 0 });
  assert.deepEqual([await segments.load({ time: 3 }), await first], [true, false]);
});
