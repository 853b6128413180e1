// Clauses 13.2 to 13.4 without a GPU: the Gaussians of a level at a time, for a camera's centre. For Spark, for
// machines whose GPU is missing or slow, and the reference of the evaluator on the GPU.

import { GAUSSIAN_COLUMNS, LOCAL_HEADS, anchorColumns, columnsOf, globalHeads } from "../decode/heads.js";
import { Arena } from "./kernel.js";
import { deformationUnit, eachAttribute, levelOf, MIN_OPACITY, SPATIAL, sliceAt, TEMPORAL, widthsOf } from "./level.js";
/** @import { Head } from "../decode/heads.js" */
/** @import { Deformation, Network, Scene } from "../decode/scene.js" */

/**
 * The visible Gaussians in ascending order of their slot, anchor · slots + i. records: [count, 16], mean and opacity,
 * (scale, 0), quaternion, (colour, 0); lengths in scene units. Opacity and scale include the anchor's gate.
 *
 * @typedef {{count: number, slot: Uint32Array, records: Float32Array}} Gaussians
 */

/** Rows that networks process at a time: their intermediate values stay in the processor's cache. */
const BATCH = 256;
const COLUMNS = GAUSSIAN_COLUMNS;

/** @param {number} x */
const sigmoid = (x) => 1 / (1 + Math.exp(-x));

/** A network in an arena, with room for the outputs of its layers. */
class Chain {
  /** @param {Arena} arena @param {Network} network @param {boolean} [relu] whether ReLU follows the last layer too */
  constructor(arena, network, relu = false) {
    this._arena = arena;
    const last = network.length - 1;
    this._layers = network.map((layer, i) => arena.pack(layer, relu || i < last));
    this._outs = this._layers.map((layer) => arena.take(BATCH * Arena.stride(layer)));
    /** Where the rows of the result begin, and their distance. */
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

/** A spatial plane, or a temporal one at a time, of height 1. data: [height, width, channels]. */
class Sampler {
  /** @param {Float32Array} data @param {number} width @param {number} height @param {number} channels */
  constructor(data, width, height, channels) {
    this.data = data;
    this._width = width;
    this._height = height;
    this._channels = channels;
    this._at = this._right = this._down = 0;
    this._fx = this._fy = 0.5; // no integers, so that engines see numbers from the start
  }

  /** Finds the four cells around a point. @param {number} u @param {number} v 0..1 */
  find(u, v) {
    const C = this._channels;
    const x = u * (this._width - 1);
    const y = v * (this._height - 1);
    const x0 = Math.floor(x);
    const y0 = Math.floor(y);
    this._fx = x - x0;
    this._fy = y - y0;
    this._at = (y0 * this._width + x0) * C;
    this._right = x0 + 1 < this._width ? C : 0;
    this._down = y0 + 1 < this._height ? this._width * C : 0;
  }

  /** Between the cells of the row. @param {number} c channel */
  line(c) {
    const { data } = this;
    const at = this._at + c;
    return data[at] + this._fx * (data[at + this._right] - data[at]);
  }

  /** Between all four. @param {number} c channel */
  area(c) {
    const { data, _right: right, _down: down, _fx: fx } = this;
    const at = this._at + c;
    const top = data[at] + fx * (data[at + right] - data[at]);
    const bottom = data[at + down] + fx * (data[at + down + right] - data[at + down]);
    return top + this._fy * (bottom - top);
  }
}

/** Spatial planes with their channels last, by deformation. @type {WeakMap<Deformation, Sampler[][]>} */
const transposed = new WeakMap();

/** @param {Deformation} deformation @returns {Sampler[][]} by scale */
function spatialPlanes(deformation) {
  let scales = transposed.get(deformation);
  if (!scales) {
    scales = deformation.planes.map((planes) =>
      SPATIAL.map(([name]) => {
        const { data, channels, height, width } = planes[name];
        const out = new Float32Array(data.length);
        const cells = height * width;
        for (let c = 0; c < channels; c++) for (let i = 0; i < cells; i++) out[i * channels + c] = data[c * cells + i];
        return new Sampler(out, width, height, channels);
      }),
    );
    transposed.set(deformation, scales);
  }
  return scales;
}

/** A deformation in an arena: HexPlane, trunk, and heads that add to records. */
class Field {
  /** @param {Arena} arena @param {Deformation} deformation @param {Scene} scene @param {Head[]} heads */
  constructor(arena, deformation, scene, heads) {
    this._arena = arena;
    this._deformation = deformation;
    this._box = scene.info.box;
    this._spatial = spatialPlanes(deformation);
    /** @type {Sampler[][]} */
    this._temporal = [];
    this._channels = deformation.planes[0].xy.channels;
    this._width = this._channels * this._spatial.length;
    this._features = arena.take(BATCH * this._width);
    const { networks } = deformation;
    this._trunk = new Chain(arena, networks.trunk, true);
    const unit = deformationUnit(scene);
    this._heads = heads
      .filter(({ name }) => networks[name])
      .map((head) => ({
        chain: new Chain(arena, networks[head.name]),
        columns: Int32Array.from(columnsOf(head)),
        unit: head.length ? unit : 1,
        head,
      }));
  }

  /** @param {number} t 0..1 */
  setTime(t) {
    this._temporal = this._deformation.planes.map((planes) =>
      TEMPORAL.map(([name]) => {
        const { channels, width } = planes[name];
        const out = new Float32Array(width * channels);
        sliceAt(planes[name], t, (c, i, value) => (out[i * channels + c] = value));
        return new Sampler(out, width, 1, channels);
      }),
    );
  }

  /**
   * Adds F(x, t) to records.
   *
   * @param {Float32Array} records @param {number} first @param {number} rows at most BATCH @param {number} stride
   * @param {Float32Array} [points] x, [rows, 3]; default: the first three columns of the records
   */
  deform(records, first, rows, stride, points) {
    if (points) this._sample(points, 0, rows, 3);
    else this._sample(records, first * stride, rows, stride);
    this._trunk.run(rows, this._features, this._width);
    const { floats } = this._arena;
    for (const { chain, columns, unit, head } of this._heads) {
      chain.run(rows, this._trunk.out, this._trunk.stride);
      for (let r = 0; r < rows; r++) {
        const from = chain.out + r * chain.stride;
        const to = (first + r) * stride;
        for (let k = 0; k < columns.length; k++) records[to + columns[k]] += floats[from + k] * unit;
        if (head.then) bringIntoRange(records, to + head.at, head);
      }
    }
  }

  /** @param {Float32Array} points @param {number} at @param {number} rows @param {number} stride */
  _sample(points, at, rows, stride) {
    const { floats } = this._arena;
    const C = this._channels;
    const u = new Float64Array(3);
    const [low, high] = this._box;
    for (let r = 0, to = this._features; r < rows; r++, at += stride) {
      for (let k = 0; k < 3; k++) {
        const x = points[at + k];
        u[k] = !(x > low[k]) ? 0 : x >= high[k] ? 1 : (x - low[k]) / (high[k] - low[k]);
      }
      for (let s = 0; s < this._spatial.length; s++) {
        const [first, second, third] = this._spatial[s];
        const [one, two, three] = this._temporal[s];
        for (let p = 0; p < 3; p++) {
          this._spatial[s][p].find(u[SPATIAL[p][1]], u[SPATIAL[p][2]]);
          this._temporal[s][p].find(u[TEMPORAL[p][1]], 0);
        }
        // one loop over channels for all six: a loop for each would store and load the product six times
        for (let c = 0; c < C; c++) {
          const space = first.area(c) * second.area(c) * third.area(c);
          floats[to++] = space * one.line(c) * two.line(c) * three.line(c);
        }
      }
    }
  }
}

/** @param {Float32Array} values in place @param {number} at @param {Head} head */
function bringIntoRange(values, at, { outputs, then }) {
  const most = then === "clip" ? 1 : Infinity;
  if (then === "unit") normaliseQuaternion(values, at);
  else for (let k = at; k < at + outputs; k++) values[k] = Math.min(Math.max(values[k], 0), most);
}

/** @param {Float32Array} q normalised in place from `at` on; the identity if 0 @param {number} at */
function normaliseQuaternion(q, at) {
  const norm = Math.hypot(q[at], q[at + 1], q[at + 2], q[at + 3]);
  for (let k = 0; k < 4; k++) q[at + k] = norm > 0 ? q[at + k] / norm : k === 0 ? 1 : 0;
}

/** A scene's networks in an arena, whose content they replace. */
class Evaluator {
  /** @param {Scene} scene @param {Arena} arena */
  constructor(scene, arena) {
    arena.reset();
    this.scene = scene;
    this.arena = arena;
    this._widths = widthsOf(scene);
    const { opacity, covariance, color } = scene.networks;
    this._opacity = new Chain(arena, opacity);
    this._covariance = new Chain(arena, covariance);
    this._color = new Chain(arena, color);
    const { globalDeformation, localDeformation } = scene;
    this._global = globalDeformation && new Field(arena, globalDeformation, scene, globalHeads(this._widths));
    this._local = localDeformation && new Field(arena, localDeformation, scene, LOCAL_HEADS);
    /** Inputs of the scaffold's networks, features and direction: the distance of rows, and where they begin. */
    this._stride = this._widths.feature + 3;
    this._inputs = arena.take(BATCH * this._stride);
    this._anchorStride = anchorColumns(this._widths);
    this._anchors = new Float32Array(BATCH * this._anchorStride);
    this._points = new Float32Array(BATCH * 3);
    /** The scene with what the global deformation adds to. @type {Scene | null} */
    this._rest = null;
    this._offsetAt = this._anchorStride - 4 * this._widths.slots;
  }

  /** @param {number} level @param {number} t @param {number[]} eye @returns {Gaussians} */
  evaluate(level, t, eye) {
    const { rows, codes, global, local } = levelOf(this.scene, level);
    const moved = global && this._global;
    const source = moved ? (this._rest ??= this._withoutStill(moved)) : this.scene;
    moved?.setTime(t);
    const kept = new Records(rows);
    const anchors = new Uint32Array(BATCH);
    for (let a = 0; a < rows; ) {
      let count = 0;
      for (; a < rows && count < BATCH; a++) if (codes[a]) anchors[count++] = a;
      this._keep(source, moved, anchors.subarray(0, count), codes, eye, kept);
    }
    if (local && this._local) {
      this._local.setTime(t);
      for (let first = 0; first < kept.count; first += BATCH) {
        this._local.deform(kept.data, first, Math.min(BATCH, kept.count - first), COLUMNS);
      }
    }
    return kept.gated(codes, this._widths.slots);
  }

  /** The scene; with a key instant t*, its attributes without F(x, t*). @param {Field} field @returns {Scene} */
  _withoutStill(field) {
    const { scene, _anchors: records, _anchorStride: wide } = this;
    const key = scene.globalDeformation?.key ?? null;
    if (key === null) return scene;
    const attributes = [scene.anchor, scene.feature, scene.offset, scene.scalingLog];
    const [anchor, feature, offset, scalingLog] = attributes.map((values) => values.slice());
    const rest = { ...scene, anchor, feature, offset, scalingLog };
    field.setTime(key);
    for (let first = 0; 3 * first < anchor.length; first += BATCH) {
      const points = scene.anchor.subarray(3 * first, 3 * (first + BATCH));
      records.fill(0);
      field.deform(records, 0, points.length / 3, wide, points);
      eachAttribute(rest, (values, width, columns) => {
        for (let r = 0; 3 * r < points.length; r++) {
          const to = width * (first + r);
          for (let k = 0; k < width; k++) values[to + k] -= records[r * wide + columns[k]];
        }
      });
    }
    return rest;
  }

  /**
   * Steps 1 to 4 for at most BATCH anchors: their visible Gaussians.
   *
   * @param {Scene} source of the attributes @param {Field | null} moved the global deformation, at its time
   * @param {Uint32Array} anchors @param {Uint8Array} codes @param {number[]} eye @param {Records} kept takes them
   */
  _keep(source, moved, anchors, codes, eye, kept) {
    const { floats } = this.arena;
    const { feature: F, slots: S } = this._widths;
    const { _anchors: records, _anchorStride: wide, _points: points, _inputs: inputs, _stride: stride } = this;
    const count = anchors.length;
    eachAttribute(source, (values, width, columns) => {
      for (let r = 0; r < count; r++) {
        const from = width * anchors[r];
        for (let k = 0; k < width; k++) records[r * wide + columns[k]] = values[from + k];
      }
    });
    if (moved) {
      const { anchor } = this.scene; // the field is sampled at stored positions, which `records` may not have
      for (let r = 0; r < count; r++) for (let k = 0; k < 3; k++) points[3 * r + k] = anchor[3 * anchors[r] + k];
      moved.deform(records, 0, count, wide, points);
    }
    for (let r = 0; r < count; r++) {
      const from = r * wide;
      const at = inputs + r * stride;
      floats.set(records.subarray(from + 12, from + 12 + F), at);
      const x = records[from] - eye[0];
      const y = records[from + 1] - eye[1];
      const z = records[from + 2] - eye[2];
      const distance = Math.hypot(x, y, z) || 1; // at the camera's centre itself there is no direction
      floats[at + F] = x / distance;
      floats[at + F + 1] = y / distance;
      floats[at + F + 2] = z / distance;
    }

    this._opacity.run(count, inputs, stride);
    const opacities = new Float32Array(count * S);
    const alive = [];
    for (let r = 0; r < count; r++) {
      const gate = codes[anchors[r]] / 255;
      let any = false;
      for (let i = 0; i < S; i++) {
        const opacity = Math.fround(Math.tanh(floats[this._opacity.out + r * this._opacity.stride + i]));
        if (!(opacity * gate >= MIN_OPACITY)) continue;
        opacities[r * S + i] = opacity;
        any = true;
      }
      if (!any) continue;
      floats.copyWithin(inputs + alive.length * stride, inputs + r * stride, inputs + (r + 1) * stride);
      alive.push(r);
    }

    this._covariance.run(alive.length, inputs, stride);
    this._color.run(alive.length, inputs, stride);
    const record = new Float32Array(COLUMNS);
    alive.forEach((r, row) => {
      const from = r * wide;
      for (let k = 4; k < 12; k++) records[from + k] = Math.exp(records[from + k]);
      for (let i = 0; i < S; i++) {
        const opacity = opacities[r * S + i];
        if (!opacity) continue;
        const v = this._covariance.out + row * this._covariance.stride + 7 * i;
        const w = this._color.out + row * this._color.stride + 3 * i;
        const offset = from + this._offsetAt + 4 * i;
        for (let k = 0; k < 3; k++) {
          record[k] = records[from + k] + records[offset + k] * records[from + 4 + k];
          record[4 + k] = records[from + 8 + k] * sigmoid(floats[v + k]);
          record[12 + k] = sigmoid(floats[w + k]);
        }
        record[3] = opacity;
        for (let k = 0; k < 4; k++) record[8 + k] = floats[v + 3 + k];
        normaliseQuaternion(record, 8);
        kept.add(S * anchors[r] + i, record);
      }
    });
  }
}

/** A growing list of Gaussians. */
class Records {
  /** @param {number} expected */
  constructor(expected) {
    this.count = 0;
    this._slots = new Uint32Array(Math.max(expected, 16));
    this.data = new Float32Array(this._slots.length * COLUMNS);
  }

  /** @param {number} slot @param {Float32Array} record */
  add(slot, record) {
    if (this.count === this._slots.length) {
      const slots = new Uint32Array(2 * this.count);
      slots.set(this._slots);
      const data = new Float32Array(2 * this.data.length);
      data.set(this.data);
      this._slots = slots;
      this.data = data;
    }
    this._slots[this.count] = slot;
    this.data.set(record, this.count++ * COLUMNS);
  }

  /** Step 6: opacity and scale times the gates of their anchors, without Gaussians that are no longer visible.
   * @param {Uint8Array} codes @param {number} slots of an anchor @returns {Gaussians} */
  gated(codes, slots) {
    const { data } = this;
    let count = 0;
    for (let i = 0; i < this.count; i++) {
      const at = i * COLUMNS;
      const gate = codes[Math.floor(this._slots[i] / slots)] / 255;
      for (let k = 3; k < 7; k++) data[at + k] *= gate;
      if (!(data[at + 3] >= MIN_OPACITY)) continue;
      data.copyWithin(count * COLUMNS, at, at + COLUMNS);
      this._slots[count++] = this._slots[i];
    }
    return { count, slot: this._slots.slice(0, count), records: data.slice(0, count * COLUMNS) };
  }
}

/** Of the last scene: the next evaluation is mostly of the same one at another time. @type {Evaluator | null} */
let current = null;

/**
 * The Gaussians of a level.
 *
 * @param {Scene} scene @param {number} level 0, 1 or 2 @param {number} t normalised time
 * @param {number[]} eye the camera's centre, scene units
 * @param {Arena} [arena] to work in, which is then the thread's; by default one is made
 * @returns {Gaussians}
 */
export function evaluate(scene, level, t, eye, arena) {
  if (arena || current?.scene !== scene) {
    const room = arena ?? current?.arena ?? new Arena();
    current = null; // its content is overwritten, even if there is no room for the new scene
    current = new Evaluator(scene, room);
  }
  return current.evaluate(level, t, eye);
}
