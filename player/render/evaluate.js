// Clauses 13.3 and 13.4 without a GPU: the Gaussians of a level at a time, for a camera's centre. For Spark, for
// machines whose GPU is missing or slow, and the reference of the evaluator on the GPU.

import { Column } from "../decode/columns.js";
import { Arena } from "./kernel.js";
import { cellsOf, eachAttribute, GAUSSIAN_COLUMNS as COLUMNS, headsIn, levelOf } from "./level.js";
import { MIN_OPACITY, SPATIAL, sliceAt, texelsFor } from "./level.js";
import { anchorColumns } from "./record.js";
/** @import { Network } from "../decode/tensors.js" */
/** @import { Deformation, Scale, AnchorScene } from "../kinds/index.js" */
/** @import { Texels } from "./level.js" */

/**
 * The visible Gaussians in ascending order of their slot, anchor · slots + i. records: [count, GAUSSIAN_COLUMNS], all
 * finite. Opacity and scale include the anchor's gate.
 *
 * @typedef {{count: number, slot: Uint32Array, records: Float32Array}} Gaussians
 */

/** Rows that networks process at a time: their intermediate values stay in the processor's cache. */
const BATCH = 256;

/** @param {number} x */
const sigmoid = (x) => 1 / (1 + Math.exp(-x));

/** A network in an arena, with room for the outputs of its layers. */
class Chain {
  /** @param {Arena} arena @param {Network} network @param {boolean} [relu] whether ReLU follows the last layer too */
  constructor(arena, network, relu = false) {
    this._arena = arena;
    const last = network.length - 1;
    this._layers = network.map((layer, i) => arena.pack(layer, relu || i < last));
    this._outs = this._layers.map((layer) => arena.take(BATCH * layer.stride));
    /** Where the rows of the result begin, and their distance. */
    this.out = this._outs[last];
    this.stride = this._layers[last].stride;
  }

  /** @param {number} rows at most BATCH @param {number} x where the first begins @param {number} stride */
  run(rows, x, stride) {
    this._layers.forEach((layer, i) => {
      this._arena.linear(layer, rows, x, stride, this._outs[i]);
      x = this._outs[i];
      stride = layer.stride;
    });
  }
}

/** A spatial plane, or a row at a time, of height 1. data: [height, width, channels]. */
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

/** Spatial planes with their channels last, by the first of a scale: levels share planes.
 * @type {WeakMap<object, Sampler[]>} */
const transposed = new WeakMap();

/** @param {Scale} planes */
function spatialPlanes(planes) {
  let samplers = transposed.get(planes.xy);
  if (!samplers) {
    samplers = SPATIAL.map(([name]) => {
      const { data, channels, height, width } = planes[name];
      const out = new Float32Array(data.length);
      const cells = height * width;
      for (let c = 0; c < channels; c++) for (let i = 0; i < cells; i++) out[i * channels + c] = data[c * cells + i];
      return new Sampler(out, width, height, channels);
    });
    transposed.set(planes.xy, samplers);
  }
  return samplers;
}

/** A deformation in an arena: planes, trunk, and heads that add to anchors' records. */
class Field {
  /** @param {Arena} arena @param {Deformation} deformation @param {AnchorScene} scene */
  constructor(arena, deformation, scene) {
    this._arena = arena;
    this._deformation = deformation;
    this._box = scene.info.box;
    this._spatial = deformation.planes.map(spatialPlanes);
    /** @type {Sampler[][]} */
    this._temporal = [];
    this._channels = deformation.planes[0].xy.channels;
    this._width = this._channels * this._spatial.length;
    this._features = arena.take(BATCH * this._width);
    this._trunk = new Chain(arena, deformation.trunk, true);
    this._stride = anchorColumns(scene.widths);
    this._heads = headsIn(deformation, scene).map(({ network, columns, unit }) => {
      return { chain: new Chain(arena, network), columns: Int32Array.from(columns), unit };
    });
  }

  /** @param {number} t 0..1 */
  setTime(t) {
    const { _channels: channels } = this;
    this._temporal = this._deformation.planes.map((planes) =>
      cellsOf(planes).map((cells, axis) => {
        const out = new Float32Array(cells * channels);
        sliceAt(planes, axis, t, (c, i, value) => (out[i * channels + c] = value));
        return new Sampler(out, cells, 1, channels);
      }),
    );
  }

  /**
   * Adds F(x, t) to records.
   *
   * @param {Float32Array} points x, [rows, 3] @param {number} rows at most BATCH @param {Float32Array} records
   */
  deform(points, rows, records) {
    this._sample(points, rows);
    this._trunk.run(rows, this._features, this._width);
    const { floats } = this._arena;
    for (const { chain, columns, unit } of this._heads) {
      chain.run(rows, this._trunk.out, this._trunk.stride);
      for (let r = 0; r < rows; r++) {
        const from = chain.out + r * chain.stride;
        const to = r * this._stride;
        for (let k = 0; k < columns.length; k++) records[to + columns[k]] += floats[from + k] * unit;
      }
    }
  }

  /** @param {Float32Array} points @param {number} rows */
  _sample(points, rows) {
    const { floats } = this._arena;
    const C = this._channels;
    const u = new Float64Array(3);
    const [low, high] = this._box;
    for (let r = 0, to = this._features; r < rows; r++) {
      for (let k = 0; k < 3; k++) {
        const x = points[3 * r + k];
        u[k] = !(x > low[k]) ? 0 : x >= high[k] ? 1 : (x - low[k]) / (high[k] - low[k]);
      }
      for (let s = 0; s < this._spatial.length; s++) {
        const [first, second, third] = this._spatial[s];
        const [one, two, three] = this._temporal[s];
        for (let p = 0; p < 3; p++) {
          this._spatial[s][p].find(u[SPATIAL[p][1]], u[SPATIAL[p][2]]);
          this._temporal[s][p].find(u[p], 0);
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

/** @param {Float32Array} q normalised in place from `at` on; the identity if 0 @param {number} at */
function normaliseQuaternion(q, at) {
  const norm = Math.hypot(q[at], q[at + 1], q[at + 2], q[at + 3]);
  for (let k = 0; k < 4; k++) q[at + k] = norm > 0 ? q[at + k] / norm : k === 0 ? 1 : 0;
}

/** A deformation, and the attributes of the anchors to which it adds.
 * @typedef {{field: Field, rest: AnchorScene}} Motion */

/** A scene's networks in an arena, whose content they replace. */
class Evaluator {
  /** @param {AnchorScene} scene @param {Arena} arena */
  constructor(scene, arena) {
    arena.reset();
    this.scene = scene;
    this.arena = arena;
    this._widths = scene.widths;
    const { opacity, covariance, color } = scene.networks;
    this._opacity = new Chain(arena, opacity);
    this._covariance = new Chain(arena, covariance);
    this._color = new Chain(arena, color);
    /** Those of the levels shown so far. @type {Map<Deformation, Motion>} */
    this._motions = new Map();
    /** Inputs of the scaffold's networks, features and direction: the distance of rows, and where they begin. */
    this._stride = this._widths.feature + 3;
    this._inputs = arena.take(BATCH * this._stride);
    this._anchorStride = anchorColumns(this._widths);
    this._anchors = new Float32Array(BATCH * this._anchorStride);
    this._points = new Float32Array(BATCH * 3);
    this._offsetAt = this._anchorStride - 4 * this._widths.slots;
  }

  /** @param {number} level @param {number} t @param {number[]} eye @returns {Gaussians} */
  evaluate(level, t, eye) {
    const { rows, codes, spread, motion } = levelOf(this.scene, level);
    const moving = motion && this._motionOf(motion);
    moving?.field.setTime(t);
    const kept = { slot: new Column(Uint32Array, 1), records: new Column(Float32Array, COLUMNS) };
    const anchors = new Uint32Array(BATCH);
    for (let a = 0; a < rows; ) {
      let count = 0;
      for (; a < rows && count < BATCH; a++) if (codes[a]) anchors[count++] = a;
      this._keep(moving, anchors.subarray(0, count), codes, spread, eye, kept);
    }
    return { count: kept.slot.rows, slot: kept.slot.values, records: kept.records.values };
  }

  /** @param {Deformation} deformation @returns {Motion} */
  _motionOf(deformation) {
    let motion = this._motions.get(deformation);
    if (!motion) {
      const field = new Field(this.arena, deformation, this.scene);
      const { key } = deformation;
      motion = { field, rest: key === null ? this.scene : this._withoutStill(field, key) };
      this._motions.set(deformation, motion);
    }
    return motion;
  }

  /** The scene with its attributes without F(x, t*). @param {Field} field @param {number} key t* @returns {AnchorScene} */
  _withoutStill(field, key) {
    const { scene, _anchors: records, _anchorStride: wide } = this;
    const attributes = [scene.anchor, scene.feature, scene.offset, scene.scalingLog];
    const [anchor, feature, offset, scalingLog] = attributes.map((values) => values.slice());
    const rest = { ...scene, anchor, feature, offset, scalingLog };
    field.setTime(key);
    for (let first = 0; 3 * first < anchor.length; first += BATCH) {
      const points = scene.anchor.subarray(3 * first, 3 * (first + BATCH));
      records.fill(0);
      field.deform(points, points.length / 3, records);
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
   * Adds the visible Gaussians of at most BATCH anchors to `kept`.
   *
   * @param {Motion | null} moving at its time @param {Uint32Array} anchors @param {Uint8Array} codes
   * @param {number} spread @param {number[]} eye @param {{slot: Column<Uint32Array>, records: Column<Float32Array>}} kept
   */
  _keep(moving, anchors, codes, spread, eye, kept) {
    const { floats } = this.arena;
    const { feature: F, slots: S } = this._widths;
    const { _anchors: records, _anchorStride: wide, _points: points, _inputs: inputs, _stride: stride } = this;
    const count = anchors.length;
    eachAttribute(moving?.rest ?? this.scene, (values, width, columns) => {
      for (let r = 0; r < count; r++) {
        const from = width * anchors[r];
        for (let k = 0; k < width; k++) records[r * wide + columns[k]] = values[from + k];
      }
    });
    if (moving) {
      const { anchor } = this.scene; // the field is sampled at stored positions, which `records` may not have
      for (let r = 0; r < count; r++) for (let k = 0; k < 3; k++) points[3 * r + k] = anchor[3 * anchors[r] + k];
      moving.field.deform(points, count, records);
    }
    for (let r = 0; r < count; r++) {
      const from = r * wide;
      const at = inputs + r * stride;
      floats.set(records.subarray(from + 4, from + 4 + F), at);
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
    const found = new Float32Array(alive.length * S * COLUMNS);
    /** @type {number[]} */
    const slots = [];
    alive.forEach((r, row) => {
      const from = r * wide;
      const gate = codes[anchors[r]] / 255;
      const size = from + this._offsetAt - 8;
      for (let k = 0; k < 8; k++) records[size + k] = Math.exp(records[size + k]);
      for (let i = 0; i < S; i++) {
        const opacity = opacities[r * S + i];
        if (!opacity) continue;
        const v = this._covariance.out + row * this._covariance.stride + 7 * i;
        const w = this._color.out + row * this._color.stride + 3 * i;
        const offset = from + this._offsetAt + 4 * i;
        for (let k = 0; k < 3; k++) {
          record[k] = records[from + k] + records[offset + k] * records[size + k];
          record[4 + k] = records[size + 4 + k] * sigmoid(floats[v + k]) * gate * spread;
          record[12 + k] = sigmoid(floats[w + k]);
        }
        record[3] = opacity * gate;
        for (let k = 0; k < 4; k++) record[8 + k] = floats[v + 3 + k];
        normaliseQuaternion(record, 8);
        if (!record.every(Number.isFinite)) continue;
        found.set(record, slots.length * COLUMNS);
        slots.push(S * anchors[r] + i);
      }
    });
    kept.slot = kept.slot.with(slots, 2);
    kept.records = kept.records.with(found.subarray(0, slots.length * COLUMNS), 2);
  }
}

/** Of the last scene: the next evaluation is mostly of the same one at another time. @type {Evaluator | null} */
let current = null;

/**
 * The Gaussians of a level.
 *
 * @param {AnchorScene} scene @param {number} level 0, 1 or 2 @param {number} t normalised time
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

/** `evaluate` as texels. @param {AnchorScene} scene @param {number} level @param {number} t @param {number[]} eye
 * @param {Texels | null} spare earlier ones, which may be overwritten @returns {Texels} */
export function texelsOf(scene, level, t, eye, spare) {
  const { count, records } = evaluate(scene, level, t, eye);
  const texels = texelsFor(count, spare);
  const block = texels.data.length / 4;
  for (let i = 0; i < count; i++) {
    for (let k = 0; k < COLUMNS; k++) texels.data[(k >> 2) * block + 4 * i + (k & 3)] = records[COLUMNS * i + k];
  }
  return { ...texels, count, still: 0 };
}
