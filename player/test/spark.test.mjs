// The adapter to Spark, with real workers in threads, and doubles for what it uses of Spark and three.js.

import assert from "node:assert/strict";
import { test } from "node:test";

import "../testing/threads.mjs";
import { decode } from "../decode/index.js";
import { evaluate } from "../render/evaluate.js";
import { Pd4Splats } from "../spark.js";
import { addressOf, readScaffold, readVector } from "../testing/vectors.mjs";

const BYTES = readVector("valid/layers-0-1-2");
const ADDRESS = addressOf(BYTES);

class Vector {
  applyMatrix4 = () => this;

  /** @param {ArrayLike<number>} array @param {number} at */
  fromArray(array, at) {
    const [x, y, z] = Array.from(array).slice(at, at + 3);
    return Object.assign(this, { x, y, z, r: x, g: y, b: z });
  }

  /** @param {number} x @param {number} y @param {number} z @param {number} w */
  set(x, y, z, w) {
    Object.assign(this, { x, y, z, w });
  }

  /** @param {{eye: number[]}} matrix */
  setFromMatrixPosition({ eye }) {
    return this.fromArray(eye, 0);
  }

  /** @param {any[]} values */
  setRGB(...values) {
    return Object.assign(this, { values });
  }
}

/** The identity. */
class Matrix4 {
  copy = () => this;
  invert = () => this;
}

const THREE = { Vector3: Vector, Quaternion: Vector, Color: Vector, Matrix4, SRGBColorSpace: "srgb" };

/** A version of Spark's that stores splats in some other way: arrays of whole rows of 2,048, which grow at least twofold;
 * textures that are made anew with them. */
class OtherSplats {
  constructor() {
    this.maxSplats = this.numSplats = 0;
    this.extArrays = [new Uint32Array(0), new Uint32Array(0)];
    /** @type {any[]} */
    this.textures = [{ needsUpdate: false }, { needsUpdate: false }];
    /** @type {any[]} */
    this.stored = [];
    this.made = 0;
  }

  /** @param {number} count */
  ensureSplats(count) {
    if (count <= this.maxSplats) return;
    this.maxSplats = 2048 * Math.ceil(Math.max(count, 2 * this.maxSplats) / 2048);
    this.extArrays = [new Uint32Array(4 * this.maxSplats), new Uint32Array(4 * this.maxSplats)];
  }

  /** @param {number} index @param {any[]} values centre, scales, quaternion, opacity, colour */
  setSplat(index, ...[c, s, q, opacity, { r, g, b }]) {
    assert.ok(index < this.maxSplats);
    this.numSplats = Math.max(this.numSplats, index + 1);
    this.stored[index] = [c.x, c.y, c.z, s.x, s.y, s.z, q.w, q.x, q.y, q.z, opacity, r, g, b];
  }

  /** @param {{extArrays: Uint32Array[], numSplats: number}} options */
  reinitialize({ extArrays, numSplats }) {
    this.made++;
    assert.equal(extArrays[0].length, 4 * this.maxSplats);
    this.numSplats = numSplats;
    this.textures = [{ needsUpdate: false }, { needsUpdate: false }];
  }

  get content() {
    return this.stored.slice(0, this.numSplats);
  }
}

/** @param {number} bits of a 16-bit float */
function ofHalf(bits) {
  const [sign, exponent, rest] = [bits >> 15, (bits >> 10) & 31, bits & 1023];
  return (sign ? -1 : 1) * (exponent ? (1 + rest / 1024) * 2 ** (exponent - 15) : rest * 2 ** -24);
}

/** Spark's 2.2, which gives textures their new arrays as bytes. */
class ExtSplats extends OtherSplats {
  /** @param {{extArrays: Uint32Array[], numSplats: number}} [options] */
  constructor(options) {
    super();
    this.textures = /** @type {any[]} */ (this.extArrays.map((data) => ({ needsUpdate: false, image: { data } })));
    if (options) this.reinitialize(options);
  }

  /** @param {{extArrays: Uint32Array[], numSplats: number}} options */
  reinitialize({ extArrays, numSplats }) {
    assert.ok(extArrays.every(({ length }) => length % 8192 === 0 && length >= 4 * numSplats));
    Object.assign(this, { extArrays, numSplats });
    extArrays.forEach(({ buffer }, i) => {
      this.textures[i].image = { data: new Uint8Array(buffer) };
      this.textures[i].needsUpdate = true;
    });
  }

  /** @param {number} index */
  getSplat(index) {
    const [[...first], [...second]] = this.extArrays.map((array) => array.subarray(4 * index, 4 * index + 4));
    const [x, y, z] = new Float32Array(Uint32Array.from(first).buffer);
    const [r, g, b, sx, sy, sz] = second.slice(0, 3).flatMap((two) => [ofHalf(two & 0xffff), ofHalf(two >>> 16)]);
    const [u, v] = [second[3] & 1023, (second[3] >>> 10) & 1023].map((k) => (2 * k) / 1023 - 1);
    const w = 1 - Math.abs(u) - Math.abs(v);
    const axis = w < 0 ? [(1 - Math.abs(v)) * Math.sign(u), (1 - Math.abs(u)) * Math.sign(v), w] : [u, v, w];
    const angle = ((second[3] >>> 20) / 4095) * Math.PI;
    const [qx, qy, qz] = axis.map((k) => (k / Math.hypot(...axis)) * Math.sin(angle / 2));
    return {
      center: { x, y, z },
      opacity: ofHalf(first[3]),
      color: { r, g, b },
      scales: { x: Math.exp(sx), y: Math.exp(sy), z: Math.exp(sz) },
      quaternion: { w: Math.cos(angle / 2), x: qx, y: qy, z: qz },
    };
  }

  get content() {
    return Array.from({ length: this.numSplats }, (_, i) => {
      const { center: c, scales: s, quaternion: q, opacity, color: { r, g, b } } = this.getSplat(i);
      return [c.x, c.y, c.z, s.x, s.y, s.z, q.w, q.x, q.y, q.z, opacity, r, g, b];
    });
  }
}

class SplatMesh {
  /** @param {{extSplats: ExtSplats}} options */
  constructor({ extSplats }) {
    this.extSplats = extSplats;
    this.matrixWorld = {};
    this.mappings = 0;
    this.disposed = false;
  }

  updateWorldMatrix() {}

  updateMappingVersion() {
    this.mappings++;
  }

  dispose() {
    this.disposed = true;
  }
}

/** @param {number[]} eye */
const cameraAt = (eye) => ({ matrixWorld: { eye }, updateWorldMatrix() {} });
const modules = /** @type {any} */ ({ THREE, spark: { ExtSplats, SplatMesh } });

/** @param {Pd4Splats} splats @param {any} camera */
async function settle(splats, camera) {
  splats.update(camera);
  while (!splats.settled) await new Promise((resolve) => setTimeout(resolve, 2));
}

/** @param {EventTarget} target @param {string} name @returns {Promise<any>} */
const detailOf = (target, name) =>
  new Promise((resolve) => target.addEventListener(name, (event) => resolve(/** @type {any} */ (event).detail)));

/** What the mesh must hold. @param {number} level @param {number} t @param {number[]} eye */
function expected(level, t, eye) {
  const { count, records } = evaluate(readScaffold("valid/layers-0-1-2"), level, t, eye);
  return Array.from({ length: count }, (_, i) => {
    const g = Array.from(records.subarray(16 * i, 16 * i + 16));
    return [...g.slice(0, 3), ...g.slice(4, 7), ...g.slice(8, 12), g[3], ...g.slice(12, 15)];
  });
}

for (const Stored of [ExtSplats, OtherSplats]) {
  test(`the mesh holds the Gaussians of a level, a time and a camera: ${Stored.name}`, async () => {
    const splats = await Pd4Splats.open(ADDRESS, { ...modules, spark: { SplatMesh, ExtSplats: Stored } });
    /** @type {any[]} */
    const upgrades = [];
    splats.addEventListener("upgrade", (event) => upgrades.push(/** @type {any} */ (event).detail));
    const { bytes, complete } = await detailOf(splats, "loaded");
    assert.ok(complete && bytes === BYTES.length);
    const { info, levels, mesh } = splats;
    assert.deepEqual(levels, [0, 1, 2]);
    assert.deepEqual(splats.background.values, [...info.background, "srgb"]);
    const [start, end] = info.timeRange;
    let seen = 0;
    for (const [level, share, eye] of /** @type {[number, number, number[]][]} */ ([
      [0, 0, [0, 0, -4]],
      [1, 0.5, [0, 0, -4]],
      [2, 1, [1, 2, -3]],
    ])) {
      splats.level = level;
      splats.time = start + share * (end - start);
      await settle(splats, cameraAt(eye));
      const wanted = expected(level, level ? share : 0, eye);
      assert.ok(wanted.length > 0);
      const { content } = mesh.extSplats;
      assert.equal(content.length, wanted.length);
      const most = Stored === ExtSplats ? 4e-3 : 0; // of 16-bit floats, and of 10 bits for an axis
      wanted.forEach((row, i) => {
        const [q, p] = [row, content[i]].map((values) => values.slice(6, 10));
        const turned = Math.sign(q.reduce((/** @type {number} */ sum, /** @type {number} */ value, /** @type {number} */ k) => sum + value * p[k], 0)); // q and -q are one rotation
        row.forEach((value, k) => {
          const found = k >= 6 && k < 10 ? turned * content[i][k] : content[i][k];
          assert.ok(Math.abs(found - value) <= most * Math.max(1, Math.abs(value)), `${i} ${k}: ${found}, not ${value}`);
        });
      });
      assert.equal(mesh.mappings, ++seen);
      await settle(splats, cameraAt(eye));
      assert.equal(mesh.mappings, seen, "nothing is evaluated in vain");
    }
    if (Stored === ExtSplats) {
      assert.deepEqual(mesh.extSplats.textures.map((/** @type {any} */ { image }) => image.data), mesh.extSplats.extArrays);
    } else {
      assert.equal(mesh.extSplats.made, 1);
      assert.ok(mesh.extSplats.textures.every((/** @type {any} */ texture) => texture.needsUpdate));
    }
    assert.deepEqual(upgrades.map(({ level }) => level), [0, 1, 2]);
    splats.close();
    assert.ok(mesh.disposed);
    assert.throws(() => splats.update(cameraAt([0, 0, 0])), /closed/);
  });
}

test("time advances while the mesh plays, and loops or stops at the end", async () => {
  const splats = await Pd4Splats.open(ADDRESS, { ...modules, time: 1e9, level: 0 });
  const [start, end] = splats.info.timeRange;
  assert.deepEqual([splats.time, splats.levels], [end, [0]]);
  const camera = cameraAt([0, 0, -4]);
  const now = performance.now;
  let clock = 1;
  performance.now = () => clock;
  try {
    splats.play();
    splats.update(camera);
    assert.equal(splats.time, start);
    clock += 500 * (end - start);
    splats.update(camera);
    assert.ok(Math.abs(splats.time - (start + end) / 2) < 1e-9);
    clock += 1000 * (end - start);
    splats.update(camera);
    assert.ok(Math.abs(splats.time - (start + end) / 2) < 1e-9 && !splats.paused);
    splats.loop = false;
    clock += 1000 * (end - start);
    splats.update(camera);
    assert.ok(splats.time === end && splats.paused);
  } finally {
    performance.now = now;
    splats.close();
  }
});

test("a scene that plays before it has arrived begins at its start time", async () => {
  const [start, end] = decode(BYTES).info.timeRange;
  const splats = new Pd4Splats({ ...modules, time: (start + end) / 2 });
  splats.play();
  await splats.load(ADDRESS, {});
  assert.ok(splats.time === (start + end) / 2 && !splats.paused);
  splats.close();
});

test("a file of another type is refused, a damaged one keeps its valid layers", async () => {
  await assert.rejects(Pd4Splats.open(addressOf(new Uint8Array(64)), modules), { kind: "BadSignature" });
  const damaged = BYTES.slice();
  damaged[damaged.length - 20] ^= 4;
  const splats = await Pd4Splats.open(addressOf(damaged), modules);
  const { kind, message } = await detailOf(splats, "error");
  assert.equal(kind, "ChecksumMismatch");
  assert.ok(message && !message.includes("\n"));
  await settle(splats, cameraAt([0, 0, -4]));
  assert.deepEqual(splats.levels, [0, 1]);
  splats.close();
});
