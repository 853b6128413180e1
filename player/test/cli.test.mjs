import assert from "node:assert/strict";
import { spawnSync } from "node:child_process";
import { readFileSync } from "node:fs";
import { test } from "node:test";
import { fileURLToPath } from "node:url";

import { readVectors } from "../testing/vectors.mjs";

const path = (/** @type {string} */ name) => fileURLToPath(new URL(name, import.meta.url));
const VECTOR = path("../../spec/vectors/valid/layers-0-1-2.pd4");
const DAMAGED = path("../../spec/vectors/faulty/crc-layer-1.pd4");

/** @param {string[]} args @param {Uint8Array} [input] */
function run(args, input) {
  const done = spawnSync(process.execPath, [path("../cli.mjs"), ...args], { input, encoding: "utf8" });
  return { code: done.status, out: done.stdout, err: done.stderr };
}

test("hashes prints those of the manifest, of a file and of stdin", () => {
  const expected = readVectors().find(({ file }) => file === "valid/layers-0-1-2.pd4")?.layers;
  for (const { code, out, err } of [run(["hashes", VECTOR]), run(["hashes", "-"], readFileSync(VECTOR))]) {
    assert.deepEqual([code, err], [0, ""]);
    assert.deepEqual(JSON.parse(out), expected);
  }
});

test("a bad file and a missing one are one line on stderr and exit 1", () => {
  const bad = run(["hashes", DAMAGED]);
  assert.deepEqual([bad.code, bad.out], [1, ""]);
  assert.match(bad.err, /^pd4-player: [^\n]*crc-layer-1\.pd4: ChecksumMismatch: [^\n]* \(chunk 1, offset \d+\)\n$/);
  const missing = run(["hashes", "nowhere.pd4"]);
  assert.deepEqual([missing.code, missing.out], [1, ""]);
  assert.match(missing.err, /^pd4-player: nowhere\.pd4: [^\n]+\n$/);
});

test("time prints its figures", () => {
  const { code, out } = run(["time", VECTOR, "-n", "3"]);
  assert.equal(code, 0);
  const figures = JSON.parse(out);
  assert.equal(figures.runs, 3);
  assert.ok(figures.median_wall_seconds > 0 && figures.median_cpu_seconds >= 0 && figures.first_wall_seconds > 0);
});

test("other arguments are a matter of usage", () => {
  for (const args of [[], ["hashes"], ["dance", VECTOR], ["time", VECTOR, "-n", "0"], ["hashes", VECTOR, "-n", "3"]]) {
    const { code, out, err } = run(args);
    assert.deepEqual([code, out], [2, ""]);
    assert.match(err, /^usage: /);
  }
  const help = run(["--help"]);
  assert.equal(help.code, 0);
  assert.match(help.out, /^usage: /);
});
