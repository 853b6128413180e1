// Clauses 13.2 to 13.4 without a GPU: the Gaussians of a level at a time, as a camera meets them. It serves where there
// is no float rendering or only a slow one, and tests hold the evaluator on the GPU against it.

import { Arena } from "./kernel.js";
import { deformationUnit, levelOf, MIN_OPACITY, widthsOf } from "./level.js";
import { LENGTH_HEADS, sliceAt, SPATIAL, TEMPORAL } from "./planes.js";

/** @typedef {import("../decode/scene.js").Scene} Scene */
/** @typedef {import("../decode/scene.js").Network} Network */
/** @typedef {import("../decode/scene.js").Deformation} Deformation */

/**
 * Gaussians that are kept, in ascending order of their slot, anchor · slots + i. Opacity and scale are gated.
 *
 * @typedef {object} Gaussians
 * @property {number} count
 * @property {Uint32Array} slot [count]
 * @property {Float32Array} mean [count, 3], scene units
 * @property {Float32Array} opacity [count]
 * @property {Float32Array} scale [count, 3], scene units
 * @property {Float32Array} quaternion [count, 4], w x y z, unit
 * @property {Float32Array} color [count, 3]
 */

/** Rows that networks take at a time: what they pass on stays in the processor's cache. */
const BATCH = 256;

/** @param {number} x */
const sigmoid = (x) => 1 / (1 + Math.exp(-x));
/** @param {number} x */
const clip = (x) => Math.min(Math.max(x, 0), 1);

/**
 * Planes at one time. Cells lie before channels, so that one sample reads one run of memory.
 *
 * @typedef {object} Scale
 * @property {{data: Float32Array, width: number, height: number}[]} spatial
 * @property {{data: Float32Array, cells: number}[]} rows
 */

/** Spatial planes with their channels last, by deformation. @type {WeakMap<Deformation, Scale["spatial"][]>} */
const transposed = new WeakMap();

/** @param {Deformation} deformation @returns {Scale["spatial"][]} */
function spatialPlanes(deformation) {
  let scales = transposed.get(deformation);
  if (!scales) {
    scales = deformation.planes.map((planes) =>
      SPATIAL.map(([name]) => {
        const { data, channels, height, width } = planes[name];
        const out = new Float32Array(data.length);
        const cells = height * width;
        for (let c = 0; c < channels; c++) for (let i = 0; i < cells; i++) out[i * channels + c] = data[c * cells + i];
        return { data: out, width, height };
      }),
    );
    transposed.set(deformation, scales);
  }
  return scales;
}

/**
 * The rows of the planes xt, yt and zt at time t, [cells, channels] each.
 *
 * @param {Deformation} deformation @param {number} scale @param {number} t 0..1
 */
function rowsAt(deformation, scale, t) {
  return TEMPORAL.map(([name]) => {
    const plane = deformation.planes[scale][name];
    const { channels, width } = plane;
    const out = new Float32Array(width * channels);
    sliceAt(plane, t, (c, i, value) => (out[i * channels + c] = value));
    return { data: out, cells: width };
  });
}

/** A network in an arena, and room for what its layers give. */
class Chain {
  /** @param {Arena} arena @param {Network} network @param {boolean} [relu] whether ReLU follows the last layer too */
  constructor(arena, network, relu = false) {
    this._arena = arena;
    const last = network.length - 1;
    this._layers = network.map((layer, i) => arena.pack(layer, relu || i < last));
    this._outs = this._layers.map((layer) => arena.take(BATCH * Arena.stride(layer)));
    /** Where the rows of the result begin, and how far apart they are. */
    this.out = this._outs[last];
    this.stride = Arena.stride(this._layers[last]);
  }

  /** @param {number} rows at most BATCH @param {number} x where the first begins @param {number} stride */
  run(rows, x, stride) {
    this._layers.forEach((layer, i) => {
      this._arena.linear(layer, rows, x, stride, this._outs[i]);
      x = this._outs[i];
      stride = Arena.stride(layer);
    });
  }
}

/** A deformation in an arena. */
class Field {
  /** @param {Arena} arena @param {Deformation} deformation @param {Scene} scene */
  constructor(arena, deformation, scene) {
    this._arena = arena;
    this._deformation = deformation;
    this._box = scene.info.box;
    this._spatial = spatialPlanes(deformation);
    /** @type {Scale["rows"][]} */
    this._rows = [];
    this._channels = deformation.planes[0].xy.channels;
    this._corners = [new Corners(), new Corners(), new Corners()];
    this._ends = [new Ends(), new Ends(), new Ends()];
    this._place = new Float64Array(3);
    this._width = this._channels * this._spatial.length;
    this._features = arena.take(BATCH * this._width);
    const { trunk, ...heads } = deformation.networks;
    this._trunk = new Chain(arena, trunk, true);
    const unit = deformationUnit(scene);
    /** Heads by name, and what their outputs are to be multiplied by: scene units. @type {Record<string, Head>} */
    this.heads = {};
    for (const [name, network] of Object.entries(heads)) {
      this.heads[name] = { chain: new Chain(arena, network), unit: LENGTH_HEADS.includes(name) ? unit : 1 };
    }
  }

  /** @param {number} t 0..1 */
  setTime(t) {
    this._rows = this._spatial.map((_, s) => rowsAt(this._deformation, s, t));
  }

  /**
   * What all heads give at some points.
   *
   * @param {number} rows at most BATCH @param {ArrayLike<number>} points @param {number} at of the first point's x
   * @param {number} stride from one to the next
   */
  run(rows, points, at, stride) {
    const { floats } = this._arena;
    const C = this._channels;
    const u = this._place;
    const [low, high] = this._box;
    const [first, second, third] = this._corners;
    const [one, two, three] = this._ends;
    for (let r = 0, to = this._features; r < rows; r++, at += stride) {
      for (let k = 0; k < 3; k++) {
        const x = points[at + k];
        u[k] = !(x > low[k]) ? 0 : x >= high[k] ? 1 : (x - low[k]) / (high[k] - low[k]);
      }
      for (let s = 0; s < this._spatial.length; s++) {
        for (let p = 0; p < 3; p++) {
          this._corners[p].find(this._spatial[s][p], u[SPATIAL[p][1]], u[SPATIAL[p][2]], C);
          this._ends[p].find(this._rows[s][p], u[TEMPORAL[p][1]], C);
        }
        // one loop over channels for all six: a loop for each would store and load the product six times
        for (let c = 0; c < C; c++) {
          const space = first.sample(c) * second.sample(c) * third.sample(c);
          floats[to++] = space * one.sample(c) * two.sample(c) * three.sample(c);
        }
      }
    }
    this._trunk.run(rows, this._features, this._width);
    for (const name in this.heads) this.heads[name].chain.run(rows, this._trunk.out, this._trunk.stride);
  }

  /**
   * Adds what a head gave to values.
   *
   * @param {string} name @param {number} row @param {Float32Array} values @param {number} at @param {number} count
   * @returns {boolean} whether there is such a head
   */
  add(name, row, values, at, count) {
    const head = this.heads[name];
    if (!head) return false;
    const { floats } = this._arena;
    const from = head.chain.out + row * head.chain.stride;
    for (let k = 0; k < count; k++) values[at + k] += floats[from + k] * head.unit;
    return true;
  }
}

/** @typedef {{chain: Chain, unit: number}} Head */

/** Where a plane is sampled: four cells, and how far between them. */
class Corners {
  constructor() {
    /** @type {Float32Array} */
    this._data = new Float32Array(0);
    this._at = this._right = this._down = 0;
    this._fx = this._fy = 0.5; // no integers, so that engines see numbers from the start
  }

  /** @param {Scale["spatial"][number]} plane @param {number} u @param {number} v 0..1 @param {number} C channels */
  find({ data, width, height }, u, v, C) {
    const x = u * (width - 1);
    const y = v * (height - 1);
    const x0 = Math.floor(x);
    const y0 = Math.floor(y);
    this._data = data;
    this._fx = x - x0;
    this._fy = y - y0;
    this._at = (y0 * width + x0) * C;
    this._right = x0 + 1 < width ? C : 0;
    this._down = y0 + 1 < height ? width * C : 0;
  }

  /** @param {number} c channel */
  sample(c) {
    const { _data: data, _right: right, _down: down, _fx: fx } = this;
    const at = this._at + c;
    const top = data[at] + fx * (data[at + right] - data[at]);
    const bottom = data[at + down] + fx * (data[at + down + right] - data[at + down]);
    return top + this._fy * (bottom - top);
  }
}

/** The same of a row: two cells. */
class Ends {
  constructor() {
    /** @type {Float32Array} */
    this._data = new Float32Array(0);
    this._at = this._right = 0;
    this._f = 0.5;
  }

  /** @param {Scale["rows"][number]} row @param {number} u 0..1 @param {number} C channels */
  find({ data, cells }, u, C) {
    const x = u * (cells - 1);
    const x0 = Math.floor(x);
    this._data = data;
    this._f = x - x0;
    this._at = x0 * C;
    this._right = x0 + 1 < cells ? C : 0;
  }

  /** @param {number} c channel */
  sample(c) {
    const { _data: data, _at } = this;
    const at = _at + c;
    return data[at] + this._f * (data[at + this._right] - data[at]);
  }
}

/** Columns of a record: mean 3, opacity, scale 3, quaternion 4, colour 3. */
const RECORD = 14;

/** @param {Float32Array} q normalised in place from `at` on; the identity if 0 @param {number} at */
function normaliseQuaternion(q, at) {
  const norm = Math.hypot(q[at], q[at + 1], q[at + 2], q[at + 3]);
  for (let k = 0; k < 4; k++) q[at + k] = norm > 0 ? q[at + k] / norm : k === 0 ? 1 : 0;
}

/** The networks of a scene in an arena. */
class Networks {
  /** @param {Scene} scene @param {Arena} arena whose content is replaced */
  constructor(scene, arena) {
    arena.reset();
    this.arena = arena;
    const { opacity, covariance, color } = scene.networks;
    this.opacity = new Chain(arena, opacity);
    this.covariance = new Chain(arena, covariance);
    this.color = new Chain(arena, color);
    this.global = scene.globalDeformation && new Field(arena, scene.globalDeformation, scene);
    this.local = scene.localDeformation && new Field(arena, scene.localDeformation, scene);
    /** Inputs of the first three: where rows begin, and how far apart they are. */
    this.stride = widthsOf(scene).feature + 3;
    this.inputs = arena.take(BATCH * this.stride);
  }
}

/** Those of the last scene: what is evaluated next is mostly the same one at another time.
 * @type {{scene: Scene, networks: Networks} | null} */
let current = null;

/** @param {Scene} scene @param {Arena} [arena] another one than the last scene's */
function networksOf(scene, arena) {
  if (!arena && current?.scene === scene) return current.networks;
  const room = arena ?? current?.networks.arena ?? new Arena();
  current = null; // what it held is gone, even if there is no room for the new one
  const networks = new Networks(scene, room);
  current = { scene, networks };
  return networks;
}

/**
 * The Gaussians of a level.
 *
 * @param {Scene} scene @param {number} level 0, 1 or 2 @param {number} t normalised time
 * @param {number[]} eye the camera's centre, scene units
 * @param {Arena} [arena] to work in, which is then the thread's; by default one is made
 * @returns {Gaussians}
 */
export function evaluate(scene, level, t, eye, arena) {
  const { rows, codes, global, local } = levelOf(scene, level);
  const networks = networksOf(scene, arena);
  const moved = global && networks.global;
  moved?.setTime(t);
  const kept = new Records(rows);
  const anchors = new Uint32Array(BATCH);
  for (let a = 0; a < rows; ) {
    let count = 0;
    for (; a < rows && count < BATCH; a++) if (codes[a]) anchors[count++] = a;
    keep(scene, networks, moved, anchors.subarray(0, count), codes, eye, kept);
  }
  if (local && networks.local) {
    networks.local.setTime(t);
    kept.deform(networks.local);
  }
  kept.gate(codes, widthsOf(scene).slots);
  return kept.columns();
}

/**
 * Steps 1 to 4 for at most BATCH anchors: their Gaussians that show.
 *
 * @param {Scene} scene @param {Networks} networks @param {Field | null} moved the global deformation, at its time
 * @param {Uint32Array} anchors @param {Uint8Array} codes @param {number[]} eye @param {Records} kept takes them
 */
function keep(scene, { arena, opacity, covariance, color, inputs, stride }, moved, anchors, codes, eye, kept) {
  const { floats } = arena;
  const { feature: F, slots: S } = widthsOf(scene);
  const count = anchors.length;
  const positions = new Float32Array(3 * count);
  for (let r = 0; r < count; r++) for (let k = 0; k < 3; k++) positions[3 * r + k] = scene.anchor[3 * anchors[r] + k];
  moved?.run(count, positions, 0, 3);
  for (let r = 0; r < count; r++) {
    moved?.add("position", r, positions, 3 * r, 3);
    const at = inputs + r * stride;
    floats.set(scene.feature.subarray(F * anchors[r], F * anchors[r] + F), at);
    moved?.add("feature", r, floats, at, F);
    const x = positions[3 * r] - eye[0];
    const y = positions[3 * r + 1] - eye[1];
    const z = positions[3 * r + 2] - eye[2];
    const distance = Math.hypot(x, y, z) || 1; // at the camera's centre itself there is no direction
    floats[at + F] = x / distance;
    floats[at + F + 1] = y / distance;
    floats[at + F + 2] = z / distance;
  }

  opacity.run(count, inputs, stride);
  const opacities = new Float32Array(count * S);
  /** @param {number} r @param {number} i */
  const shows = (r, i) => opacities[r * S + i] * (codes[anchors[r]] / 255) >= MIN_OPACITY;
  const alive = [];
  for (let r = 0; r < count; r++) {
    let any = false;
    for (let i = 0; i < S; i++) {
      opacities[r * S + i] = Math.tanh(floats[opacity.out + r * opacity.stride + i]);
      any ||= shows(r, i);
    }
    if (!any) continue;
    const to = inputs + alive.length * stride;
    floats.copyWithin(to, inputs + r * stride, inputs + (r + 1) * stride);
    alive.push(r);
  }

  covariance.run(alive.length, inputs, stride);
  color.run(alive.length, inputs, stride);
  const spread = new Float32Array(6);
  const offsets = new Float32Array(3 * S);
  const record = new Float32Array(RECORD);
  alive.forEach((r, row) => {
    const a = anchors[r];
    spread.set(scene.scalingLog.subarray(6 * a, 6 * a + 6));
    moved?.add("scaling", r, spread, 0, 6);
    for (let k = 0; k < 6; k++) spread[k] = Math.exp(spread[k]);
    offsets.set(scene.offset.subarray(3 * S * a, 3 * S * (a + 1)));
    moved?.add("offset", r, offsets, 0, 3 * S);
    for (let i = 0; i < S; i++) {
      if (!shows(r, i)) continue;
      const v = covariance.out + row * covariance.stride + 7 * i;
      const w = color.out + row * color.stride + 3 * i;
      for (let k = 0; k < 3; k++) {
        record[k] = positions[3 * r + k] + offsets[3 * i + k] * spread[k];
        record[4 + k] = spread[3 + k] * sigmoid(floats[v + k]);
        record[11 + k] = sigmoid(floats[w + k]);
      }
      record[3] = opacities[r * S + i];
      for (let k = 0; k < 4; k++) record[7 + k] = floats[v + 3 + k];
      normaliseQuaternion(record, 7);
      kept.add(S * a + i, record);
    }
  });
}

/** A growing list of Gaussians. */
class Records {
  /** @param {number} expected */
  constructor(expected) {
    this._count = 0;
    this._slots = new Uint32Array(Math.max(expected, 16));
    this._data = new Float32Array(this._slots.length * RECORD);
  }

  /** @param {number} slot @param {Float32Array} record */
  add(slot, record) {
    if (this._count === this._slots.length) {
      const slots = new Uint32Array(2 * this._count);
      slots.set(this._slots);
      const data = new Float32Array(2 * this._data.length);
      data.set(this._data);
      this._slots = slots;
      this._data = data;
    }
    this._slots[this._count] = slot;
    this._data.set(record, this._count++ * RECORD);
  }

  /** Step 5: the local deformation. @param {Field} field */
  deform(field) {
    const data = this._data;
    for (let start = 0; start < this._count; start += BATCH) {
      const rows = Math.min(BATCH, this._count - start);
      field.run(rows, data, start * RECORD, RECORD);
      for (let r = 0, at = start * RECORD; r < rows; r++, at += RECORD) {
        field.add("mean", r, data, at, 3);
        if (field.add("opacity", r, data, at + 3, 1)) data[at + 3] = clip(data[at + 3]);
        if (field.add("scale", r, data, at + 4, 3)) for (let k = 4; k < 7; k++) data[at + k] = Math.max(data[at + k], 0);
        if (field.add("quat", r, data, at + 7, 4)) normaliseQuaternion(data, at + 7);
        if (field.add("color", r, data, at + 11, 3)) for (let k = 11; k < 14; k++) data[at + k] = clip(data[at + k]);
      }
    }
  }

  /** Step 6: opacity and scale by their anchors' codes, and without those that no longer show.
   * @param {Uint8Array} codes @param {number} slots of an anchor */
  gate(codes, slots) {
    const data = this._data;
    let kept = 0;
    for (let i = 0; i < this._count; i++) {
      const at = i * RECORD;
      const gate = codes[Math.floor(this._slots[i] / slots)] / 255;
      for (let k = 3; k < 7; k++) data[at + k] *= gate;
      if (!(data[at + 3] >= MIN_OPACITY)) continue;
      data.copyWithin(kept * RECORD, at, at + RECORD);
      this._slots[kept++] = this._slots[i];
    }
    this._count = kept;
  }

  /** @returns {Gaussians} */
  columns() {
    const n = this._count;
    /** @param {number} start @param {number} width */
    const column = (start, width) => {
      const out = new Float32Array(n * width);
      for (let i = 0; i < n; i++) {
        const at = i * RECORD + start;
        for (let k = 0; k < width; k++) out[i * width + k] = this._data[at + k];
      }
      return out;
    };
    return {
      count: n,
      slot: this._slots.slice(0, n),
      mean: column(0, 3),
      opacity: column(3, 1),
      scale: column(4, 3),
      quaternion: column(7, 4),
      color: column(11, 3),
    };
  }
}
