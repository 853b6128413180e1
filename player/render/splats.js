// Clauses 13.7 and 13.8: the Gaussians of a scene of splats at a time, for a camera's centre.
//
// What neither time nor camera changes is computed once for a level. Tracks are a linear layer over the coefficients of
// a Gaussian, whose weights are the bases at the time.

import { COMPONENTS } from "../kinds/tracks.js";
import { Arena } from "./kernel.js";
import { MIN_OPACITY, deformationUnit, levelOf, texelsFor } from "./level.js";
/** @import { Network } from "../decode/tensors.js" */
/** @import { SplatScene, Tracks } from "../kinds/index.js" */
/** @import { Groups } from "../kinds/tracks.js" */
/** @import { Packed } from "./kernel.js" */
/** @import { Texels } from "./level.js" */

/** Gaussians that are evaluated at a time: their sums of tracks stay in the processor's cache. */
const BATCH = 256;
const ALL = Uint32Array.from({ length: BATCH }, (_, r) => r);
const [POSITION, ROTATION, SCALE, OPACITY, COLOR] = [0, 1, 2, 3, 4];
/** What is larger becomes this: no renderer draws it. */
const HUGE = 1e30;

/** @param {number} x @returns {number} finite */
const bounded = (x) => (x > -HUGE ? (x < HUGE ? x : HUGE) : -HUGE);

/** @param {number} x */
const sigmoid = (x) => 1 / (1 + Math.exp(-x));

/** Farther outside of its window, in units of its softness, no Gaussian is seen. */
const REACH = Math.sqrt(-2 * Math.log(MIN_OPACITY));

/** The share of its opacity that a Gaussian has at a time. @param {Float32Array} windows centre, half width and one by
 * the softness @param {number} at where they begin @param {number} t */
function openness(windows, at, t) {
  const excess = Math.abs(t - windows[at]) - windows[at + 1];
  if (!(excess > 0)) return 1;
  const share = excess * windows[at + 2];
  return share < REACH ? Math.exp(-0.5 * share * share) : 0;
}

/** Puts a quaternion of length 1; the identity for zeros. @param {Float32Array} out @param {number} at
 * @param {number} w @param {number} x @param {number} y @param {number} z */
function putQuaternion(out, at, w, x, y, z) {
  const norm = Math.sqrt(w * w + x * x + y * y + z * z);
  const turned = norm > 0 && norm < Infinity;
  const share = turned ? 1 / norm : 0;
  out[at] = turned ? w * share : 1;
  out[at + 1] = x * share;
  out[at + 2] = y * share;
  out[at + 3] = z * share;
}

/** Puts sums of harmonics as RGB. @param {Float32Array} out @param {number} at @param {number} y @param {number} co
 * @param {number} cg */
function putColor(out, at, y, co, cg) {
  out[at] = Math.max(0, bounded(0.5 + y - cg + co));
  out[at + 1] = Math.max(0, bounded(0.5 + y + cg));
  out[at + 2] = Math.max(0, bounded(0.5 + y - cg - co));
}

const Y0 = 0.28209479177387814;
/** Room for the harmonics of degrees 1 to 3. */
const basis = new Float64Array(15);

/** Sets them to those of a direction, in the order and with the signs of 3DGS. @param {number} x @param {number} y
 * @param {number} z */
function setBasis(x, y, z) {
  const xx = x * x;
  const yy = y * y;
  const zz = z * z;
  basis[0] = -0.4886025119029199 * y;
  basis[1] = 0.4886025119029199 * z;
  basis[2] = -0.4886025119029199 * x;
  basis[3] = 1.0925484305920792 * x * y;
  basis[4] = -1.0925484305920792 * y * z;
  basis[5] = 0.31539156525252005 * (2 * zz - xx - yy);
  basis[6] = -1.0925484305920792 * x * z;
  basis[7] = 0.5462742152960396 * (xx - yy);
  basis[8] = -0.5900435899266435 * y * (3 * xx - yy);
  basis[9] = 2.890611442640554 * x * y * z;
  basis[10] = -0.4570457994644658 * y * (4 * zz - xx - yy);
  basis[11] = 0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy);
  basis[12] = -0.4570457994644658 * x * (4 * zz - xx - yy);
  basis[13] = 1.445305721320277 * z * (xx - yy);
  basis[14] = -0.5900435899266435 * x * (xx - 3 * yy);
}

/**
 * The tracks of a level as a layer in an arena. x: where its inputs begin, coefficients [Gaussians, inputs]. out: room
 * for the outputs of a batch. starts: by head, the first of its outputs. heads: those of all layers, each with the first
 * of its inputs.
 *
 * @typedef {{arena: Arena, layer: Packed, network: Network[number], x: number, out: number, starts: number[],
 *   heads: {head: number, first: number, bases: Float32Array, instants: Float64Array}[]}} Moving
 *
 * Sums of tracks, the outputs of that layer: those of Gaussian r of a batch begin at `at` + r · stride.
 *
 * @typedef {{values: Float32Array, at: number, stride: number}} Sums
 *
 * The Gaussians of a batch that are seen. first: the batch's. numbers: theirs in it, of which `count` are there.
 *
 * @typedef {{first: number, numbers: Uint32Array, count: number}} Seen
 */

/** Evaluates a scene. */
export class SplatEvaluator {
  /** @param {SplatScene} scene @param {boolean} [wasm] as in Arena */
  constructor(scene, wasm) {
    this.scene = scene;
    this._wasm = wasm;
    /** What all below is for. */
    this._level = -1;
    /** By head, whether there is one. @type {boolean[]} */
    this._has = [];
    /** The rows of Gaussians that may be seen, and their gates. */
    this._rows = new Uint32Array(0);
    this._gates = new Float64Array(0);
    /** Their windows, see `openness`. @type {Float32Array | null} */
    this._windows = null;
    /** They at rest; as coded, what heads or harmonics are added to. */
    this._still = texelsFor(0, null).data;
    /** @type {Moving | null} */
    this._moving = null;
    /** By head, those of the batch. @type {Sums[]} */
    this._sums = [];
    this._numbers = new Uint32Array(BATCH);
  }

  /**
   * The visible Gaussians of a level in ascending order of their rows, all finite.
   *
   * @param {number} level 0, 1 or 2 @param {number} t normalised time @param {number[]} eye the camera's centre, scene
   * units @param {Float32Array | null} [spare] data of earlier texels, which may be overwritten
   * @returns {Texels}
   */
  evaluate(level, t, eye, spare = null) {
    if (level !== this._level) this._prepare(level);
    const { _has: has, _moving: moving, _windows: windows, _rows: { length: most } } = this;
    const { harmonics } = this.scene;
    const fades = has[OPACITY] || !!windows;
    const texels = texelsFor(most, spare);
    if (!fades) texels.data.set(this._still);
    if (moving) this._setTime(moving, t);
    for (let first = 0; first < most; first += BATCH) {
      const count = Math.min(BATCH, most - first);
      if (moving) {
        const { arena, layer, x, out } = moving;
        arena.linear(layer, count, x + first * layer.inputs, layer.inputs, out);
      }
      const seen = { first, numbers: ALL, count };
      if (fades) this._see(seen, t, texels);
      if (has[POSITION]) this._move(seen, texels);
      if (has[ROTATION]) this._turn(seen, texels);
      if (has[SCALE]) this._grow(seen, texels);
      if (has[COLOR] || harmonics) this._color(seen, eye, texels);
      texels.count += seen.count;
    }
    return texels;
  }

  /** @param {number} level */
  _prepare(level) {
    const { anchorQ, offset, color, opacity, scale, rotation, harmonics, window, info } = this.scene;
    const { rows: count, codes, motion } = levelOf(this.scene, level);
    this._level = level;
    const has = (this._has = COMPONENTS.map((_, head) => !!motion?.some(({ heads }) => heads[head])));
    const visible = (/** @type {number} */ i) => has[OPACITY] || (sigmoid(opacity[i]) * codes[i]) / 255 >= MIN_OPACITY;
    const rows = (this._rows = Uint32Array.from({ length: count }, (_, i) => i).filter((i) => codes[i] && visible(i)));
    this._gates = Float64Array.from(rows, (i) => codes[i] / 255);
    this._windows = window && new Float32Array(3 * rows.length);
    this._windows?.forEach((_, k, windows) => {
      const value = /** @type {Float32Array} */ (window)[3 * rows[Math.floor(k / 3)] + (k % 3)];
      windows[k] = k % 3 === 2 ? 1 / Math.exp(value) : value;
    });
    const { data: still } = texelsFor(rows.length, null);
    const block = still.length / 4;
    rows.forEach((row, i) => {
      const gate = this._gates[i];
      const from = 3 * row;
      const [at, shape, turn, shade] = [0, 1, 2, 3].map((b) => b * block + 4 * i);
      for (let k = 0; k < 3; k++) {
        still[at + k] = bounded((anchorQ[from + k] + offset[from + k]) * info.voxelSize);
        still[shape + k] = has[SCALE] ? scale[from + k] : bounded(Math.exp(scale[from + k]) * gate);
        still[shade + k] = color[from + k];
      }
      still[at + 3] = has[OPACITY] ? opacity[row] : sigmoid(opacity[row]) * gate;
      const x = rotation[from], y = rotation[from + 1], z = rotation[from + 2];
      putQuaternion(still, turn, Math.sqrt(Math.max(0, 1 - x * x - y * y - z * z)), x, y, z);
      if (has[COLOR] || harmonics) return;
      putColor(still, shade, Y0 * color[from], Y0 * color[from + 1], Y0 * color[from + 2]);
    });
    this._still = still;
    const moving = (this._moving = this._movingOf(motion ?? []));
    this._sums = COMPONENTS.map((_, head) => {
      if (!moving || !has[head]) return NO_SUMS;
      return { values: moving.arena.floats, at: moving.out + moving.starts[head], stride: moving.layer.stride };
    });
  }

  /** @param {Tracks[]} tracks @returns {Moving | null} */
  _movingOf(tracks) {
    const { _rows: rows, _has: has } = this;
    let inputs = 0;
    const heads = tracks.flatMap(({ instants, heads, groups }) => heads.flatMap((found, head) => {
      if (!found) return [];
      const [first, width] = [inputs, found.bases.length / COMPONENTS[head] / instants.length];
      inputs += width;
      return { head, first, width, instants, groups, ...found };
    }));
    if (!inputs) return null;
    let outputs = 0;
    const starts = COMPONENTS.map((components, head) => (has[head] ? (outputs += components) - components : 0));
    const network = { weight: new Float32Array(outputs * inputs), bias: new Float32Array(outputs), inputs, outputs };
    if (has[ROTATION]) network.bias[starts[ROTATION]] = 1; // residuals are added to the identity
    const arena = new Arena(this._wasm, Math.ceil(outputs / 4));
    const layer = arena.pack(network, false);
    const [out, x] = [arena.take(BATCH * layer.stride), arena.take(rows.length * inputs)];
    for (const { first, width, coefficients, groups, maps } of heads) {
      for (let i = 0, to = x + first; i < rows.length; i++, to += inputs) {
        // layers have nothing for the rows of later ones
        for (let k = 0; k < width; k++) arena.floats[to + k] = coefficients[width * rows[i] + k] ?? 0;
      }
      if (groups && maps) this._addGroups(groups, maps, arena.floats.subarray(x + first), inputs);
    }
    return { arena, layer, x, out, network, starts, heads };
  }

  /** Adds to coefficients what groups have for them. @param {Groups} groups @param {Float32Array} maps of a head
   * @param {Float32Array} coefficients of the rows that may be seen @param {number} stride from one row's to the next */
  _addGroups({ of, centres }, maps, coefficients, stride) {
    const { _rows: rows, _still: still } = this;
    const count = centres.length / 3;
    const width = maps.length / count / 4;
    const scale = 1 / (deformationUnit(this.scene) || Infinity);
    for (let i = 0, to = 0; i < rows.length; i++, to += stride) {
      const group = of[rows[i]];
      if (!(group >= 0 && group < count)) continue;
      const [x, y, z] = [0, 1, 2].map((axis) => still[4 * i + axis] * scale - centres[axis * count + group]);
      for (let k = 0, from = group, step = width * count; k < width; k++, from += count) {
        const turned = x * maps[from] + y * maps[from + step] + z * maps[from + 2 * step];
        coefficients[to + k] += turned + maps[from + 3 * step];
      }
    }
  }

  /** Makes the bases at a time the weights. @param {Moving} moving @param {number} t 0..1 */
  _setTime({ arena, layer, network, starts, heads }, t) {
    const { weight, inputs } = network;
    for (const { head, first, bases, instants } of heads) {
      const { length } = instants;
      let j = 0;
      while (j < length - 2 && instants[j + 1] <= t) j++;
      const f = (t - instants[j]) / (instants[j + 1] - instants[j]);
      for (let from = j, c = 0; from < bases.length; from += length, c++) {
        const [basis, component] = [Math.floor(c / COMPONENTS[head]), c % COMPONENTS[head]];
        weight[(starts[head] + component) * inputs + first + basis] = bases[from] * (1 - f) + bases[from + 1] * f;
      }
    }
    arena.repack(layer.at, network);
  }

  /** Finds the Gaussians of a batch that are seen, and puts them at rest, but with their opacities. @param {Seen} seen
   * @param {number} t @param {Texels} texels */
  _see(seen, t, { data, count: before }) {
    const { _still: still, _gates: gates, _windows: windows, _numbers: numbers } = this;
    const { values, at, stride } = this._sums[OPACITY];
    const { first } = seen;
    const fades = this._has[OPACITY];
    const block = data.length / 4;
    let n = 0;
    for (let r = 0; r < seen.count; r++) {
      const i = first + r;
      let opacity = still[4 * i + 3];
      if (fades) opacity = sigmoid(opacity + values[at + stride * r]) * gates[i];
      if (windows) opacity *= openness(windows, 3 * i, t);
      if (!(opacity >= MIN_OPACITY)) continue;
      let from = 4 * i;
      let to = 4 * (before + n);
      for (let b = 0; b < 4; b++, from += block, to += block) {
        data[to] = still[from];
        data[to + 1] = still[from + 1];
        data[to + 2] = still[from + 2];
        data[to + 3] = b ? still[from + 3] : opacity;
      }
      numbers[n++] = r;
    }
    seen.numbers = numbers;
    seen.count = n;
  }

  /** Adds to means. @param {Seen} seen @param {Texels} texels */
  _move({ numbers, count }, { data, count: before }) {
    const { values, at, stride } = this._sums[POSITION];
    for (let s = 0, to = 4 * before; s < count; s++, to += 4) {
      const sum = at + stride * numbers[s];
      data[to] = bounded(data[to] + values[sum]);
      data[to + 1] = bounded(data[to + 1] + values[sum + 1]);
      data[to + 2] = bounded(data[to + 2] + values[sum + 2]);
    }
  }

  /** Turns quaternions from the left. @param {Seen} seen @param {Texels} texels */
  _turn({ numbers, count }, { data, count: before }) {
    const { values, at, stride } = this._sums[ROTATION];
    for (let s = 0, to = data.length / 2 + 4 * before; s < count; s++, to += 4) {
      const sum = at + stride * numbers[s];
      const a = values[sum], b = values[sum + 1], c = values[sum + 2], d = values[sum + 3];
      const w = data[to], x = data[to + 1], y = data[to + 2], z = data[to + 3];
      const i = a * x + b * w + c * z - d * y;
      const j = a * y - b * z + c * w + d * x;
      const k = a * z + b * y - c * x + d * w;
      putQuaternion(data, to, a * w - b * x - c * y - d * z, i, j, k);
    }
  }

  /** Adds to logarithms of scales, which become scales. @param {Seen} seen @param {Texels} texels */
  _grow({ first, numbers, count }, { data, count: before }) {
    const { values, at, stride } = this._sums[SCALE];
    for (let s = 0, to = data.length / 4 + 4 * before; s < count; s++, to += 4) {
      const sum = at + stride * numbers[s];
      const gate = this._gates[first + numbers[s]];
      data[to] = bounded(Math.exp(data[to] + values[sum]) * gate);
      data[to + 1] = bounded(Math.exp(data[to + 1] + values[sum + 1]) * gate);
      data[to + 2] = bounded(Math.exp(data[to + 2] + values[sum + 2]) * gate);
    }
  }

  /** Makes coded colours those that the camera sees. @param {Seen} seen @param {number[]} eye @param {Texels} texels
   * with their means */
  _color({ first, numbers, count }, eye, { data, count: before }) {
    const { _rows: rows, scene: { harmonics, anchor } } = this;
    const { values, at, stride } = this._sums[COLOR];
    const width = harmonics ? (3 * harmonics.length) / anchor.length : 0;
    const block = (3 * data.length) / 4;
    for (let s = 0, mean = 4 * before; s < count; s++, mean += 4) {
      const sum = at + stride * numbers[s];
      const to = block + mean;
      let y = Y0 * (data[to] + values[sum]);
      let co = Y0 * (data[to + 1] + values[sum + 1]);
      let cg = Y0 * (data[to + 2] + values[sum + 2]);
      if (harmonics) {
        const dx = data[mean] - eye[0], dy = data[mean + 1] - eye[1], dz = data[mean + 2] - eye[2];
        const distance = Math.sqrt(dx * dx + dy * dy + dz * dz) || 1; // at the camera's centre there is no direction
        setBasis(dx / distance, dy / distance, dz / distance);
        const from = width * rows[first + numbers[s]];
        for (let j = 0, c = from; c < from + width; j++, c += 3) {
          const h = basis[j];
          y += h * harmonics[c];
          co += h * harmonics[c + 1];
          cg += h * harmonics[c + 2];
        }
      }
      putColor(data, to, y, co, cg);
    }
  }
}

/** Of heads that a level lacks. @type {Sums} */
const NO_SUMS = { values: new Float32Array(4), at: 0, stride: 0 };
