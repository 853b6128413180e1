// Clauses 13.7 and 13.8: the Gaussians of a scene of splats at a time, for a camera's centre.
//
// What neither time nor camera changes is computed once for a level.

import { splatMotion } from "../kinds/deformations.js";
import { COMPONENTS } from "../kinds/rules.js";
import { Arena, GROUP } from "./kernel.js";
import { blocksOf } from "./layers.js";
import { MIN_OPACITY, deformationUnit, levelOf, texelsFor } from "./level.js";
/** @import { SplatScene, Tracks } from "../kinds/index.js" */
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

/** 2^(i / STEPS - 150) at i. */
const STEPS = 32;
const POWERS = /* @__PURE__ */ Float64Array.from({ length: 270 * STEPS }, (_, i) => 2 ** (i / STEPS - 150));

/** e^x to 1e-9 of it, 0 below 2^-150 and where x is no number, HUGE from 2^119 on: in a third of the time of Math.exp.
 * @param {number} x */
function exp(x) {
  const y = STEPS * (Math.LOG2E * x + 150);
  if (!(y >= 0)) return 0;
  if (y > POWERS.length - 2) return HUGE;
  const i = (y + 0.5) | 0;
  const rest = (y - i) * (Math.LN2 / STEPS);
  return POWERS[i] * (1 + rest * (1 + rest * (0.5 + rest * (1 / 6))));
}

/** @param {number} x */
const sigmoid = (x) => 1 / (1 + exp(-x));

/** Farther outside of its window, in units of its softness, no Gaussian is seen. */
const REACH = Math.sqrt(-2 * Math.log(MIN_OPACITY));

/** The share of its opacity that a Gaussian has at a time. @param {Float32Array} windows centre, half width and one by
 * the softness @param {number} at where they begin @param {number} t */
function openness(windows, at, t) {
  const excess = Math.abs(t - windows[at]) - windows[at + 1];
  if (!(excess > 0)) return 1;
  const share = excess * windows[at + 2];
  return share < REACH ? exp(-0.5 * share * share) : 0;
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

const Y0 = 0.28209479177387814;
/** Y, Co and Cg of the harmonics from degree 1 on. */
const shine = new Float64Array(3);

/** Sets it for a direction, with the signs of 3DGS. @param {Float32Array} values @param {number} at where those of a
 * Gaussian begin @param {number} width how many they are @param {number} x @param {number} y @param {number} z */
function setShine(values, at, width, x, y, z) {
  const xx = x * x, yy = y * y, zz = z * z;
  const a = -0.4886025119029199 * y, b = 0.4886025119029199 * z, c = -0.4886025119029199 * x;
  const d = 1.0925484305920792 * x * y, e = -1.0925484305920792 * y * z, f = 0.31539156525252005 * (2 * zz - xx - yy);
  const g = -1.0925484305920792 * x * z, h = 0.5462742152960396 * (xx - yy), i = -0.5900435899266435 * y * (3 * xx - yy);
  const j = 2.890611442640554 * x * y * z, k = -0.4570457994644658 * y * (4 * zz - xx - yy);
  const l = 0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy), m = -0.4570457994644658 * x * (4 * zz - xx - yy);
  const n = 1.445305721320277 * z * (xx - yy), o = -0.5900435899266435 * x * (xx - 3 * yy);
  // without a loop over harmonics, which takes half as long again
  for (let channel = 0, v = at; channel < 3; channel++, v++) {
    let sum = a * values[v] + b * values[v + 3] + c * values[v + 6];
    if (width > 9) {
      sum += d * values[v + 9] + e * values[v + 12] + f * values[v + 15] + g * values[v + 18] + h * values[v + 21];
    }
    if (width > 24) {
      sum += i * values[v + 24] + j * values[v + 27] + k * values[v + 30] + l * values[v + 33] + m * values[v + 36];
      sum += n * values[v + 39] + o * values[v + 42];
    }
    shine[channel] = sum;
  }
}

/**
 * A head of a level's tracks, of all its layers, as a layer in an arena that makes one row for each component, its inputs
 * the bases of a time, its outputs Gaussians, its weights their coefficients. x: where the inputs begin, [components,
 * bases]. sums: where the outputs for a batch begin, [components, BATCH].
 *
 * @typedef {{layer: Packed, components: number, x: number, sums: number, parts: Part[]}} Sum
 *
 * The Gaussians of a batch that are seen. first: the batch's. numbers: theirs in it, of which `count` are there. to: where
 * their texels begin in a block.
 *
 * @typedef {{first: number, numbers: Uint32Array, count: number, to: number}} Seen
 */

/**
 * The Gaussians of a level at rest, as texels, see SplatEvaluator._rest; their coefficients, those of each head from a
 * block on, [blocks, height, width, 4]; their windows, null without any.
 *
 * @typedef {{width: number, height: number, rest: Float32Array, coefficients: Float32Array,
 *   windows: Float32Array | null}} Parts
 */

/** Of the values that no time changes, each of a level: 0 stands for none. */
let stills = 0;

/** Evaluates a scene. */
export class SplatEvaluator {
  /** @param {SplatScene} scene @param {boolean} [wasm] as in Arena */
  constructor(scene, wasm) {
    this.scene = scene;
    this._wasm = wasm;
    /** What all below is for. */
    this._level = -1;
    /** @type {Tracks[]} */
    this._tracks = [];
    /** The rows of Gaussians that may be seen. */
    this._rows = new Uint32Array(0);
    /** Their windows, [count, 4], see `openness`. @type {Float32Array | null} */
    this._windows = null;
    /** They at rest, as texels, and what stands for that. Behind scales are gates, behind colours rows; what heads are
     * added to, and colours that depend on the eye, are not bounded yet. */
    this._rest = texelsFor(0, null).data;
    this._still = 0;
    this._arena = new Arena(wasm);
    /** By head; those of which there is none have no inputs. @type {Sum[]} */
    this._sums = [];
    this._numbers = new Uint32Array(BATCH);
  }

  /**
   * The visible Gaussians of a level in ascending order of their rows, all finite.
   *
   * @param {number} level 0, 1 or 2 @param {number} t normalised time @param {number[]} eye the camera's centre, scene
   * units @param {Texels | null} [spare] earlier ones, which may be overwritten
   * @returns {Texels}
   */
  evaluate(level, t, eye, spare = null) {
    this._prepare(level);
    const { _rest: rest, _rows: { length: most }, scene: { harmonics } } = this;
    const sums = this._sumsAt(t, [POSITION, ROTATION, SCALE, OPACITY, COLOR]);
    const [position, rotation, scale, opacity, color] = sums;
    const fades = !!opacity || !!this._windows;
    const shades = color || harmonics;
    const texels = texelsFor(most, spare);
    const moving = [position, scale, rotation, shades];
    const resting = texels.changing.filter((block) => !moving[block]);
    if (!fades) {
      texels.changing = texels.changing.filter((block) => moving[block]);
      if (texels.still !== this._still) texels.data.set(rest);
    }
    texels.still = fades ? 0 : this._still;
    for (let first = 0; first < most; first += BATCH) {
      const seen = { first, numbers: ALL, count: Math.min(BATCH, most - first), to: 4 * texels.count };
      this._sum(sums, first);
      if (fades) this._see(seen, t, texels.data, opacity, resting);
      if (position) this._move(seen, texels.data, position.sums);
      if (rotation) this._turn(seen, texels.data, rotation.sums);
      if (scale) this._grow(seen, texels.data, scale.sums);
      if (shades) this._color(seen, texels.data, color?.sums ?? -1, eye);
      texels.count += seen.count;
    }
    return texels;
  }

  /**
   * Means and opacities of the Gaussians of a level that may be seen, [count, 4]; opacity -1 where one is not.
   *
   * @param {number} level 0, 1 or 2 @param {number} t normalised time
   */
  means(level, t) {
    this._prepare(level);
    const { length: most } = this._rows;
    const means = this._rest.slice(0, 4 * most);
    const sums = this._sumsAt(t, [POSITION, OPACITY]);
    const [position, opacity] = sums;
    for (let first = 0; first < most; first += BATCH) {
      const seen = { first, numbers: ALL, count: Math.min(BATCH, most - first), to: 4 * first };
      this._sum(sums, first);
      if (position) this._move(seen, means, position.sums);
      if (!opacity && !this._windows) continue;
      for (let r = 0; r < seen.count; r++) {
        const share = this._opacityOf(first + r, opacity ? opacity.sums + r : -1, t);
        means[seen.to + 4 * r + 3] = share >= MIN_OPACITY ? share : -1;
      }
    }
    return means;
  }

  /** What SplatPass needs of a level. @param {number} level @returns {Parts} */
  parts(level) {
    this._prepare(level);
    const { _rows: rows, _tracks: tracks } = this;
    const { width, height } = texelsFor(rows.length, null);
    const size = 4 * width * height;
    const heads = COMPONENTS.map((_, head) => basesOf(tracks, head));
    const coefficients = new Float32Array(size * heads.reduce((sum, { inputs }) => sum + blocksOf(inputs), 0));
    let at = 0;
    for (const { inputs, parts } of heads) {
      for (const part of parts) {
        const { first, width: K } = part;
        const own = this._coefficients(part);
        for (let k = 0; k < K; k++) {
          const to = at + ((first + k) >> 2) * size + ((first + k) & 3);
          for (let i = 0; i < rows.length; i++) coefficients[to + 4 * i] = own[K * i + k];
        }
      }
      at += blocksOf(inputs) * size;
    }
    return { width, height, rest: this._rest.slice(), coefficients, windows: this._windows?.slice() ?? null };
  }

  /** @param {number} level */
  _prepare(level) {
    if (level === this._level) return;
    const { anchorQ, offset, color, opacity, scale, rotation, harmonics, window, info } = this.scene;
    const { rows: count, codes, spread, motion } = levelOf(this.scene, level);
    this._level = level;
    this._still = ++stills;
    this._tracks = motion ?? [];
    this._arena = new Arena(this._wasm);
    this._sums = [];
    const has = COMPONENTS.map((_, head) => basesOf(this._tracks, head).inputs > 0);
    const visible = (/** @type {number} */ i) => has[OPACITY] || (sigmoid(opacity[i]) * codes[i]) / 255 >= MIN_OPACITY;
    const rows = (this._rows = Uint32Array.from({ length: count }, (_, i) => i).filter((i) => codes[i] && visible(i)));
    const { data: rest } = texelsFor(rows.length, null);
    this._rest = rest;
    const block = rest.length / 4;
    this._windows = window && new Float32Array(block);
    const least = has[COLOR] || harmonics ? -HUGE : 0;
    const grown = Math.log(spread);
    rows.forEach((row, i) => {
      const gate = codes[row] / 255;
      const from = 3 * row;
      const [at, shape, turn, shade] = [0, 1, 2, 3].map((b) => b * block + 4 * i);
      for (let k = 0; k < 3; k++) {
        rest[at + k] = bounded((anchorQ[from + k] + offset[from + k]) * info.voxelSize);
        const size = scale[from + k] + grown;
        rest[shape + k] = has[SCALE] ? size : bounded(exp(size) * gate);
      }
      rest[at + 3] = has[OPACITY] ? opacity[row] : sigmoid(opacity[row]) * gate;
      rest[shape + 3] = gate;
      const x = rotation[from], y = rotation[from + 1], z = rotation[from + 2];
      putQuaternion(rest, turn, Math.sqrt(Math.max(0, 1 - x * x - y * y - z * z)), x, y, z);
      const luma = Y0 * color[from], co = Y0 * color[from + 1], cg = Y0 * color[from + 2];
      rest[shade] = Math.max(least, bounded(0.5 + luma - cg + co));
      rest[shade + 1] = Math.max(least, bounded(0.5 + luma + cg));
      rest[shade + 2] = Math.max(least, bounded(0.5 + luma - cg - co));
      rest[shade + 3] = row;
      if (window) this._windows?.set([window[from], window[from + 1], 1 / Math.exp(window[from + 2])], 4 * i);
    });
  }

  /** The sums of some heads at a time, null where there is none. @param {number} t 0..1 @param {number[]} heads */
  _sumsAt(t, heads) {
    return heads.map((head) => {
      const sum = (this._sums[head] ??= this._sumOf(head));
      if (!sum.layer.inputs) return null;
      const { layer: { inputs }, x, parts } = sum;
      eachBasis(parts, t, (basis, c, value) => (this._arena.floats[x + c * inputs + basis] = value));
      return sum;
    });
  }

  /** @param {number} head @returns {Sum} */
  _sumOf(head) {
    const { _rows: rows, _arena: arena } = this;
    const components = COMPONENTS[head];
    const { inputs, parts } = basesOf(this._tracks, head);
    const outputs = inputs ? BATCH * Math.ceil(rows.length / BATCH) : 0;
    const weight = new Float32Array(outputs * inputs);
    for (const part of parts) {
      const { first, width } = part;
      const own = this._coefficients(part);
      for (let i = 0; i < rows.length; i++) {
        for (let k = 0; k < width; k++) weight[inputs * i + first + k] = own[width * i + k];
      }
    }
    const layer = arena.pack({ weight, bias: new Float32Array(outputs), inputs, outputs }, false);
    return { layer, components, x: arena.take(components * inputs), sums: arena.take(components * BATCH), parts };
  }

  /** The coefficients of a layer's head, of the rows that may be seen, [count, width]. @param {Part} part */
  _coefficients({ motion, head }) {
    const scale = 1 / (deformationUnit(this.scene) || Infinity);
    return splatMotion(motion).coefficients(motion, head, this._rows, this._rest, scale);
  }

  /** Makes the sums of a batch. @param {(Sum | null)[]} sums @param {number} first Gaussian of the batch */
  _sum(sums, first) {
    for (const sum of sums) {
      if (!sum) continue;
      const { inputs } = sum.layer;
      const batch = { ...sum.layer, at: sum.layer.at + first * (inputs + 1), groups: BATCH / GROUP, stride: BATCH };
      this._arena.linear(batch, sum.components, sum.x, inputs, sum.sums);
    }
  }

  /** @param {number} i @param {number} sum of its opacity, negative: there is none @param {number} t */
  _opacityOf(i, sum, t) {
    const { _rest: rest, _windows: windows } = this;
    let opacity = rest[4 * i + 3];
    if (sum >= 0) opacity = sigmoid(opacity + this._arena.floats[sum]) * rest[rest.length / 4 + 4 * i + 3];
    return windows ? opacity * openness(windows, 4 * i, t) : opacity;
  }

  /** Finds the Gaussians of a batch that are seen, and puts their opacities, and at rest the blocks that no head adds to.
   * @param {Seen} seen @param {number} t @param {Float32Array} data @param {Sum | null} opacities
   * @param {number[]} resting blocks */
  _see(seen, t, data, opacities, resting) {
    const { _rest: rest, _numbers: numbers } = this;
    const block = data.length / 4;
    const sums = opacities?.sums ?? -1;
    let n = 0;
    for (let r = 0; r < seen.count; r++) {
      const i = seen.first + r;
      const opacity = this._opacityOf(i, sums < 0 ? -1 : sums + r, t);
      if (!(opacity >= MIN_OPACITY)) continue;
      for (let k = 0; k < resting.length; k++) {
        const from = resting[k] * block + 4 * i;
        const to = resting[k] * block + seen.to + 4 * n;
        data[to] = rest[from];
        data[to + 1] = rest[from + 1];
        data[to + 2] = rest[from + 2];
        data[to + 3] = rest[from + 3];
      }
      data[seen.to + 4 * n + 3] = opacity;
      numbers[n++] = r;
    }
    seen.numbers = numbers;
    seen.count = n;
  }

  /** Adds to means. @param {Seen} seen @param {Float32Array} data @param {number} sums */
  _move({ first, numbers, count, to }, data, sums) {
    const { _rest: rest, _arena: { floats } } = this;
    for (let s = 0; s < count; s++, to += 4) {
      const sum = sums + numbers[s];
      const from = 4 * (first + numbers[s]);
      data[to] = bounded(rest[from] + floats[sum]);
      data[to + 1] = bounded(rest[from + 1] + floats[sum + BATCH]);
      data[to + 2] = bounded(rest[from + 2] + floats[sum + 2 * BATCH]);
    }
  }

  /** Adds to logarithms of scales, which become scales. @param {Seen} seen @param {Float32Array} data
   * @param {number} sums */
  _grow({ first, numbers, count, to }, data, sums) {
    const { _rest: rest, _arena: { floats } } = this;
    const block = data.length / 4;
    to += block;
    for (let s = 0; s < count; s++, to += 4) {
      const sum = sums + numbers[s];
      const from = block + 4 * (first + numbers[s]);
      const gate = rest[from + 3];
      data[to] = bounded(exp(rest[from] + floats[sum]) * gate);
      data[to + 1] = bounded(exp(rest[from + 1] + floats[sum + BATCH]) * gate);
      data[to + 2] = bounded(exp(rest[from + 2] + floats[sum + 2 * BATCH]) * gate);
    }
  }

  /** Turns quaternions from the left. @param {Seen} seen @param {Float32Array} data @param {number} sums */
  _turn({ first, numbers, count, to }, data, sums) {
    const { _rest: rest, _arena: { floats } } = this;
    const block = data.length / 2;
    to += block;
    for (let s = 0; s < count; s++, to += 4) {
      const sum = sums + numbers[s];
      const from = block + 4 * (first + numbers[s]);
      const a = 1 + floats[sum], b = floats[sum + BATCH], c = floats[sum + 2 * BATCH], d = floats[sum + 3 * BATCH];
      const w = rest[from], x = rest[from + 1], y = rest[from + 2], z = rest[from + 3];
      const i = a * x + b * w + c * z - d * y;
      const j = a * y - b * z + c * w + d * x;
      const k = a * z + b * y - c * x + d * w;
      putQuaternion(data, to, a * w - b * x - c * y - d * z, i, j, k);
    }
  }

  /** Adds to colours what heads and, for an eye, harmonics do. @param {Seen} seen @param {Float32Array} data with their
   * means @param {number} sums negative: there are none @param {number[]} eye */
  _color({ first, numbers, count, to: mean }, data, sums, eye) {
    const { _rest: rest, _rows: rows, _arena: { floats }, scene: { harmonics, anchor } } = this;
    const width = harmonics ? (3 * harmonics.length) / anchor.length : 0;
    const block = (3 * data.length) / 4;
    for (let s = 0; s < count; s++, mean += 4) {
      const sum = sums + numbers[s];
      const at = block + 4 * (first + numbers[s]);
      let y = 0, co = 0, cg = 0;
      if (harmonics) {
        const dx = data[mean] - eye[0], dy = data[mean + 1] - eye[1], dz = data[mean + 2] - eye[2];
        const share = 1 / (Math.sqrt(dx * dx + dy * dy + dz * dz) || 1); // at the camera's centre there is no direction
        setShine(harmonics, width * rows[first + numbers[s]], width, dx * share, dy * share, dz * share);
        y = shine[0];
        co = shine[1];
        cg = shine[2];
      }
      if (sums >= 0) {
        y += Y0 * floats[sum];
        co += Y0 * floats[sum + BATCH];
        cg += Y0 * floats[sum + 2 * BATCH];
      }
      const to = block + mean;
      data[to] = Math.max(0, bounded(rest[at] + y - cg + co));
      data[to + 1] = Math.max(0, bounded(rest[at + 1] + y + cg));
      data[to + 2] = Math.max(0, bounded(rest[at + 2] + y - cg - co));
    }
  }
}

/** What one layer has of a head. @typedef {ReturnType<typeof basesOf>["parts"][number]} Part */

/** The bases of a head in all layers, each layer's with the first of its own, and their number. @param {Tracks[]} motions
 * @param {number} head */
export function basesOf(motions, head) {
  let inputs = 0;
  const parts = motions.flatMap((motion) => {
    const width = splatMotion(motion).width(motion, head);
    inputs += width;
    return width ? { first: inputs - width, width, motion, head } : [];
  });
  return { inputs, parts };
}

/** @param {Part[]} parts @param {number} t 0..1 @param {(basis: number, component: number, value: number) => void} put
 * takes each component of each basis at a time */
export function eachBasis(parts, t, put) {
  for (const { first, motion, head } of parts) {
    splatMotion(motion).basesAt(motion, head, t, (basis, c, value) => put(first + basis, c, value));
  }
}
