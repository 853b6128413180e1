// Clauses 13.2 to 13.4 in plain JavaScript: the Gaussians of a level at a time, as a camera meets them. It serves where
// there is no float rendering, and tests hold the evaluator on the GPU against it.

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

/** @param {number} x */
const sigmoid = (x) => 1 / (1 + Math.exp(-x));

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

/** A deformation at one time. */
class Field {
  /** @param {Deformation} deformation @param {Scene} scene @param {number} t 0..1 */
  constructor(deformation, scene, t) {
    this._box = scene.info.box;
    const spatial = spatialPlanes(deformation);
    /** @type {Scale[]} */
    this._scales = spatial.map((planes, s) => ({ spatial: planes, rows: rowsAt(deformation, s, t) }));
    this._channels = deformation.planes[0].xy.channels;
    this._features = new Float64Array(this._channels * this._scales.length);
    this._place = new Float64Array(3);
    const { trunk, ...heads } = deformation.networks;
    this._trunk = new Chain(trunk);
    this._unit = deformationUnit(scene);
    /** @type {[string, Chain][]} */
    this._heads = Object.entries(heads).map(([name, network]) => [name, new Chain(network)]);
  }

  /**
   * Residuals at a point, by head, lengths in scene units. They are overwritten by the next call.
   *
   * @param {number} x @param {number} y @param {number} z
   * @returns {Record<string, Float64Array>}
   */
  at(x, y, z) {
    const u = this._place;
    u[0] = x;
    u[1] = y;
    u[2] = z;
    const [low, high] = this._box;
    for (let k = 0; k < 3; k++) {
      u[k] = !(u[k] > low[k]) ? 0 : u[k] >= high[k] ? 1 : (u[k] - low[k]) / (high[k] - low[k]);
    }
    const features = this._features.fill(1);
    for (let s = 0; s < this._scales.length; s++) {
      const { spatial, rows } = this._scales[s];
      for (let p = 0; p < 3; p++) {
        this._multiplyPlane(spatial[p], u[SPATIAL[p][1]], u[SPATIAL[p][2]], s);
        this._multiplyRow(rows[p], u[TEMPORAL[p][1]], s);
      }
    }
    const hidden = this._trunk.run(features);
    for (let i = 0; i < hidden.length; i++) if (hidden[i] < 0) hidden[i] = 0;
    /** @type {Record<string, Float64Array>} */
    const out = {};
    for (const [name, chain] of this._heads) {
      const values = (out[name] = chain.run(hidden));
      if (LENGTH_HEADS.includes(name)) for (let i = 0; i < values.length; i++) values[i] *= this._unit;
    }
    return out;
  }

  /** @param {Scale["spatial"][number]} plane @param {number} u @param {number} v 0..1 @param {number} scale */
  _multiplyPlane({ data, width, height }, u, v, scale) {
    const C = this._channels;
    const x = u * (width - 1);
    const y = v * (height - 1);
    const x0 = Math.floor(x);
    const y0 = Math.floor(y);
    const fx = x - x0;
    const fy = y - y0;
    const right = x0 + 1 < width ? C : 0;
    const down = y0 + 1 < height ? width * C : 0;
    const out = this._features;
    let at = (y0 * width + x0) * C;
    for (let c = scale * C; c < scale * C + C; c++, at++) {
      const top = data[at] + fx * (data[at + right] - data[at]);
      const bottom = data[at + down] + fx * (data[at + down + right] - data[at + down]);
      out[c] *= top + fy * (bottom - top);
    }
  }

  /** @param {Scale["rows"][number]} row @param {number} u 0..1 @param {number} scale */
  _multiplyRow({ data, cells }, u, scale) {
    const C = this._channels;
    const x = u * (cells - 1);
    const x0 = Math.floor(x);
    const f = x - x0;
    const right = x0 + 1 < cells ? C : 0;
    const out = this._features;
    let at = x0 * C;
    for (let c = scale * C; c < scale * C + C; c++, at++) out[c] *= data[at] + f * (data[at + right] - data[at]);
  }
}

/** A network whose last layer can be asked for some of its outputs only. */
class Chain {
  /** @param {Network} network */
  constructor(network) {
    this._hidden = network.slice(0, -1);
    this._last = network[network.length - 1];
    this._buffers = network.map((layer) => new Float64Array(layer.outputs));
  }

  /** What the last layer takes. @param {Float64Array} x */
  hidden(x) {
    this._hidden.forEach((layer, i) => {
      const out = this._buffers[i];
      multiply(layer, x, 0, layer.outputs, out);
      for (let o = 0; o < out.length; o++) if (out[o] < 0) out[o] = 0;
      x = out;
    });
    return x;
  }

  /**
   * Outputs `first` to `first + count` from what `hidden` gave, at the front of an array that the next call overwrites.
   *
   * @param {Float64Array} hidden @param {number} first @param {number} count
   */
  last(hidden, first, count) {
    const out = this._buffers[this._buffers.length - 1];
    multiply(this._last, hidden, first, count, out);
    return out;
  }

  /** @param {Float64Array} x */
  run(x) {
    return this.last(this.hidden(x), 0, this._last.outputs);
  }
}

/**
 * Four outputs at a time: one after the other, each sum would wait for its last product.
 *
 * @param {Network[number]} layer @param {Float64Array} x @param {number} first @param {number} count
 * @param {Float64Array} out
 */
function multiply({ weight, bias, inputs }, x, first, count, out) {
  let o = 0;
  for (; o + 4 <= count; o += 4) {
    let row = (first + o) * inputs;
    let a = bias[first + o];
    let b = bias[first + o + 1];
    let c = bias[first + o + 2];
    let d = bias[first + o + 3];
    for (let i = 0; i < inputs; i++, row++) {
      const value = x[i];
      a += weight[row] * value;
      b += weight[row + inputs] * value;
      c += weight[row + 2 * inputs] * value;
      d += weight[row + 3 * inputs] * value;
    }
    out[o] = a;
    out[o + 1] = b;
    out[o + 2] = c;
    out[o + 3] = d;
  }
  for (; o < count; o++) {
    const row = (first + o) * inputs;
    let sum = bias[first + o];
    for (let i = 0; i < inputs; i++) sum += weight[row + i] * x[i];
    out[o] = sum;
  }
}

/** Columns of a record: mean 3, opacity, scale 3, quaternion 4, colour 3. */
const RECORD = 14;

/** @param {Float64Array | number[]} q normalised in place from `at` on; the identity if 0 @param {number} at */
function normaliseQuaternion(q, at) {
  const norm = Math.hypot(q[at], q[at + 1], q[at + 2], q[at + 3]);
  for (let k = 0; k < 4; k++) q[at + k] = norm > 0 ? q[at + k] / norm : k === 0 ? 1 : 0;
}

/**
 * The Gaussians of a level.
 *
 * @param {Scene} scene @param {number} level 0, 1 or 2 @param {number} t normalised time
 * @param {number[]} eye the camera's centre, scene units
 * @returns {Gaussians}
 */
export function evaluate(scene, level, t, eye) {
  const { rows, codes, global, local } = levelOf(scene, level);
  const { feature: F, slots: S } = widthsOf(scene);
  const globalField = global && new Field(global, scene, t);
  const localField = local && new Field(local, scene, t);
  const opacityChain = new Chain(scene.networks.opacity);
  const covarianceChain = new Chain(scene.networks.covariance);
  const colorChain = new Chain(scene.networks.color);
  const inputs = new Float64Array(F + 3);
  const position = new Float64Array(3);
  const spread = new Float64Array(6);
  const record = new Float64Array(RECORD);
  const kept = new Records(rows);

  for (let a = 0; a < rows; a++) {
    const gate = codes[a] / 255;
    if (!gate) continue;
    for (let k = 0; k < 3; k++) position[k] = scene.anchor[3 * a + k];
    const residual = globalField?.at(position[0], position[1], position[2]);
    for (let k = 0; k < 3; k++) position[k] += residual?.position?.[k] ?? 0;
    for (let k = 0; k < F; k++) inputs[k] = scene.feature[F * a + k] + (residual?.feature?.[k] ?? 0);
    const direction = [0, 1, 2].map((k) => position[k] - eye[k]);
    const distance = Math.hypot(...direction) || 1; // at the camera's centre itself there is no direction
    for (let k = 0; k < 3; k++) inputs[F + k] = direction[k] / distance;
    const opacities = opacityChain.run(inputs);
    let covarianceHidden = null;
    let colorHidden = null;
    for (let i = 0; i < S; i++) {
      const opacity = Math.tanh(opacities[i]);
      if (!(opacity * gate >= MIN_OPACITY)) continue;
      if (!covarianceHidden || !colorHidden) {
        covarianceHidden = covarianceChain.hidden(inputs);
        colorHidden = colorChain.hidden(inputs);
        for (let k = 0; k < 6; k++) spread[k] = Math.exp(scene.scalingLog[6 * a + k] + (residual?.scaling?.[k] ?? 0));
      }
      const v = covarianceChain.last(covarianceHidden, 7 * i, 7);
      const w = colorChain.last(colorHidden, 3 * i, 3);
      for (let k = 0; k < 3; k++) {
        const offset = scene.offset[3 * (S * a + i) + k] + (residual?.offset?.[3 * i + k] ?? 0);
        record[k] = position[k] + offset * spread[k];
        record[4 + k] = spread[3 + k] * sigmoid(v[k]);
        record[11 + k] = sigmoid(w[k]);
      }
      record[3] = opacity;
      for (let k = 0; k < 4; k++) record[7 + k] = v[3 + k];
      normaliseQuaternion(record, 7);
      if (localField) deform(record, localField);
      record[3] *= gate;
      for (let k = 4; k < 7; k++) record[k] *= gate;
      if (record[3] >= MIN_OPACITY) kept.add(S * a + i, record);
    }
  }
  return kept.columns();
}

/** Step 5: the local deformation of one Gaussian. @param {Float64Array} record @param {Field} field */
function deform(record, field) {
  const { mean, scale, quat, opacity, color } = field.at(record[0], record[1], record[2]);
  for (let k = 0; k < 3; k++) {
    if (mean) record[k] += mean[k];
    if (scale) record[4 + k] = Math.max(record[4 + k] + scale[k], 0);
    if (color) record[11 + k] = Math.min(Math.max(record[11 + k] + color[k], 0), 1);
  }
  if (quat) {
    for (let k = 0; k < 4; k++) record[7 + k] += quat[k];
    normaliseQuaternion(record, 7);
  }
  if (opacity) record[3] = Math.min(Math.max(record[3] + opacity[0], 0), 1);
}

/** A growing list of Gaussians. */
class Records {
  /** @param {number} expected */
  constructor(expected) {
    this._count = 0;
    this._slots = new Uint32Array(Math.max(expected, 16));
    this._data = new Float32Array(this._slots.length * RECORD);
  }

  /** @param {number} slot @param {Float64Array} record */
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
