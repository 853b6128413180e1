// Explicit Gaussians and tracks against the formulas of clauses 13.7 and 13.8, number by number.

import assert from "node:assert/strict";
import { test } from "node:test";

import { COMPONENTS } from "../kinds/rules.js";
import { levelOf, sameState, stateOf } from "../render/level.js";
import { SplatEvaluator } from "../render/splats.js";
/** @import { SplatScene, Tracks } from "../kinds/index.js" */

let state = 1;
/** @param {number} count @param {number} [size] @returns {Float32Array} in -size..size */
const numbers = (count, size = 1) =>
  Float32Array.from({ length: count }, () => size * ((state = (state * 48271) % 2147483647) / 1073741824 - 1));

/** With groups, every second head has maps, and some rows have no group, said in two ways. @param {number} rows
 * @param {number[]} instants @param {number[]} heads @param {number} groups @returns {Tracks} */
function tracksOf(rows, instants, heads, groups) {
  const made = COMPONENTS.map((components, head) => {
    const K = 1 + head;
    const bases = numbers(K * components * instants.length);
    const maps = groups && !(head % 2) ? numbers(4 * K * groups, 0.3) : null;
    return heads.includes(head) ? { components, bases, coefficients: numbers(rows * K, 0.5), maps } : null;
  });
  const of = Float32Array.from({ length: rows }, (_, i) => (i % (groups + 2)) - 1);
  const own = groups ? { of, centres: numbers(3 * groups) } : null;
  return { kind: "tracks", instants: Float64Array.from(instants), heads: made, groups: own };
}

/** Rows with each layer; more than a batch. */
const ROWS = [200, 300, 333];
const ALL_HEADS = [0, 1, 2, 3, 4];

/**
 * A scene of three layers. Layer 1 has tracks at instants that are not even, layer 2 others.
 *
 * @param {{degree?: number, window?: boolean, heads?: number[][], groups?: number, flat?: boolean}} [options] heads: of
 * layers 1 and 2. flat: the box has no extent
 * @returns {SplatScene}
 */
function sceneOf({ degree = 0, window = false, heads = [ALL_HEADS, [0, 1]], groups = 0, flat = false } = {}) {
  const [first, second] = heads;
  const N = ROWS[2];
  const one = first.length ? [tracksOf(ROWS[1], [0, 0.125, 0.5, 0.75, 1], first, groups)] : [];
  const two = second.length ? [tracksOf(N, [0, 1], second, groups)] : [];
  const windows = numbers(3 * N, 0.5).map((v, k) => [v + 0.5, (v + 0.5) / 4, 4 * v - 2][k % 3]);
  const motion = [[], one, [...one, ...two]].map((tracks) => (tracks.length || window ? tracks : null));
  const mask = ROWS.map((rows) => numbers(rows).map((v) => (v < -0.8 ? 0 : 255 * Math.min(1, 1 + v))));
  return {
    kind: "splats",
    sees: degree > 0,
    info: {
      voxelSize: 1 / 16, box: flat ? [[2, 2, 2], [2, 2, 2]] : [[-1, -2, 3], [1, 1, 4]], timeRange: [1, 3], background: [0, 0, 0], near: 0.1, far: 9,
      up: [0, 1, 0], unit: 0, camera: null,
    },
    layers: [0, 1, 2],
    rows: ROWS,
    mask: mask.map((codes) => Uint8Array.from(codes)),
    fill: ROWS.map(() => [0, 0, 0]),
    spread: ROWS.map((_, i) => 1 + i / 4),
    anchorQ: Int32Array.from(numbers(3 * N, 40)),
    baseRows: 0,
    anchor: new Float32Array(3 * N), // not read
    offset: numbers(3 * N, 2),
    color: numbers(3 * N, 2),
    opacity: numbers(N, 7),
    scale: numbers(3 * N, 3),
    rotation: numbers(3 * N, 0.9), // of some, w would be the root of a negative number
    harmonics: degree ? numbers(3 * N * ((degree + 1) ** 2 - 1), 0.7) : null,
    window: window ? windows : null,
    motion,
  };
}

const { PI, exp, max, sqrt } = Math;

/** H_1 to H_15 of clause 13.7. @param {number[]} d */
function harmonicsAt([x, y, z]) {
  const [one, two, three] = [3, 15, 35].map((n) => sqrt(n / (4 * PI)));
  const tall = sqrt(21 / (32 * PI));
  return [
    ...[-one * y, one * z, -one * x],
    ...[two * x * y, -two * y * z, sqrt(5 / (16 * PI)) * (2 * z ** 2 - x ** 2 - y ** 2)],
    ...[-two * x * z, (two / 2) * (x ** 2 - y ** 2)],
    ...[-sqrt(35 / (32 * PI)) * y * (3 * x ** 2 - y ** 2), sqrt(3) * three * x * y * z],
    ...[-tall * y * (4 * z ** 2 - x ** 2 - y ** 2), sqrt(7 / (16 * PI)) * z * (2 * z ** 2 - 3 * x ** 2 - 3 * y ** 2)],
    ...[-tall * x * (4 * z ** 2 - x ** 2 - y ** 2), sqrt(105 / (16 * PI)) * z * (x ** 2 - y ** 2)],
    -sqrt(35 / (32 * PI)) * x * (x ** 2 - 3 * y ** 2),
  ];
}

/** D of a head. @param {SplatScene} scene @param {number} level @param {number} head @param {number} i @param {number} t */
function residual({ layers, motion, info, anchorQ, offset }, level, head, i, t) {
  const { voxelSize, box: [low, high] } = info;
  const unit = max(...high.map((v, k) => v - low[k])) / 4;
  const place = [0, 1, 2].map((k) => unit && ((anchorQ[3 * i + k] + offset[3 * i + k]) * voxelSize) / unit);
  const sum = new Array(COMPONENTS[head]).fill(0);
  for (const { instants, heads, groups } of motion[layers.indexOf(level)] ?? []) {
    const found = heads[head];
    if (!found) continue;
    const { bases, coefficients, maps } = found;
    const [T, c] = [instants.length, COMPONENTS[head]];
    const M = bases.length / T / c;
    const j = Math.min(instants.filter((instant) => instant <= t).length - 1, T - 2);
    const f = (t - instants[j]) / (instants[j + 1] - instants[j]);
    for (let m = 0; m < M && M * i < coefficients.length; m++) {
      let a = coefficients[M * i + m];
      if (groups && maps) {
        const { centres, of: { [i]: g } } = groups;
        const P = centres.length / 3;
        const d = [...place.map((p, k) => p - centres[k * P + g]), 1];
        if (g >= 0 && g < P) d.forEach((v, k) => (a += v * maps[(k * M + m) * P + g]));
      }
      for (let k = 0; k < c; k++) {
        const at = (m * c + k) * T + j;
        sum[k] += a * ((1 - f) * bases[at] + f * bases[at + 1]);
      }
    }
  }
  return sum;
}

/** A Gaussian's record by the formulas of clause 13.7; null if it is not seen. @param {SplatScene} scene
 * @param {number} level @param {number} i @param {number} t @param {number[]} eye */
function expected(scene, level, i, t, eye) {
  const { codes, spread } = levelOf(scene, level);
  const gate = codes[i] / 255;
  const of = (/** @type {Float32Array | Int32Array} */ values) => [...values.subarray(3 * i, 3 * (i + 1))];
  const [move, turn, grow, [fade], shade] = COMPONENTS.map((_, head) => residual(scene, level, head, i, t));
  const offset = of(scene.offset);
  const mean = of(scene.anchorQ).map((q, k) => (q + offset[k]) * scene.info.voxelSize + move[k]);
  const [x, y, z] = of(scene.rotation);
  const w = sqrt(max(0, 1 - x * x - y * y - z * z));
  const [a, b, c, d] = [1 + turn[0], turn[1], turn[2], turn[3]];
  const p = [
    a * w - b * x - c * y - d * z, a * x + b * w + c * z - d * y, a * y - b * z + c * w + d * x,
    a * z + b * y - c * x + d * w,
  ];
  let opacity = gate / (1 + exp(-scene.opacity[i] - fade));
  if (scene.window) {
    const [centre, half, softness] = of(scene.window);
    opacity *= exp(-0.5 * (max(0, Math.abs(t - centre) - half) / exp(softness)) ** 2);
  }
  const way = mean.map((m, k) => m - eye[k]);
  const harmonics = harmonicsAt(way.map((v) => v / Math.hypot(...way)));
  const H = scene.harmonics ? scene.harmonics.length / scene.opacity.length : 0;
  const [Y, Co, Cg] = of(scene.color).map((value, k) => {
    const rest = harmonics.map((h, j) => (3 * j < H ? h * (scene.harmonics?.[H * i + 3 * j + k] ?? NaN) : 0));
    return sqrt(1 / (4 * PI)) * (value + shade[k]) + rest.reduce((sum, v) => sum + v, 0);
  });
  const color = [Y - Cg + Co, Y + Cg, Y - Cg - Co].map((v) => max(0, 0.5 + v));
  const scale = of(scene.scale).map((v, k) => exp(v + grow[k]) * gate * spread);
  if (!gate || opacity < 1 / 255) return null;
  return { mean, opacity, scale, quaternion: p.map((v) => v / Math.hypot(...p)), color };
}

/** The Gaussians of an evaluation. @param {import("../render/level.js").Texels} texels */
function recordsOf({ count, data }) {
  const block = data.length / 4;
  return Array.from({ length: count }, (_, i) => {
    const of = (/** @type {number} */ b, width = 3) => [...data.subarray(b * block + 4 * i, b * block + 4 * i + width)];
    return { mean: of(0), opacity: data[4 * i + 3], scale: of(1), quaternion: of(2, 4), color: of(3) };
  });
}

const CASES = {
  "as they are": { heads: [[], []] },
  "harmonics of degree 1": { degree: 1, heads: [[], []] },
  "harmonics of degree 2 and windows": { degree: 2, window: true, heads: [[], []] },
  "harmonics of degree 3 and tracks": { degree: 3 },
  "tracks in groups": { groups: 5 },
  "tracks in one group, in a box without extent": { groups: 1, flat: true },
  "tracks and windows": { window: true },
  "positions move, in layer 2 alone": { degree: 1, heads: [[], [0]] },
  "opacities and colours change": { heads: [[3], [4]] },
};
for (const [name, options] of Object.entries(CASES)) {
  test(`Gaussians are those of the formulas: ${name}`, () => {
    const scene = sceneOf(options);
    for (const evaluator of [new SplatEvaluator(scene), new SplatEvaluator(scene, false)]) {
      for (const level of [0, 2, 1]) {
        for (const [t, ...eye] of [[0, 0, 0, -4], [0.55, 1, 2, 3], [0.125, 0, 0, 0], [1, 9, 0, 0]]) {
          const rows = Array.from({ length: levelOf(scene, level).rows }, (_, i) => expected(scene, level, i, t, eye));
          const wanted = rows.filter((row) => row !== null);
          const found = recordsOf(evaluator.evaluate(level, t, eye));
          assert.ok(wanted.length > 20);
          assert.equal(found.length, wanted.length);
          const parts = /** @type {(keyof typeof found[0])[]} */ (Object.keys(found[0]));
          for (const part of parts) {
            const [got, want] = [found, wanted].map((records) => records.flatMap((record) => record[part]));
            const most = want.reduce((largest, v) => max(largest, Math.abs(v)), 1);
            got.forEach((v, k) => assert.ok(Math.abs(v - want[k]) < 2e-6 * most, `${part} ${k}: ${v}, not ${want[k]}`));
          }
        }
      }
    }
  });
}

test("absurd values are bounded, and a quaternion of zeros is the identity", () => {
  const scene = sceneOf({ degree: 3, heads: [ALL_HEADS, []] });
  for (const values of [scene.offset, scene.scale, scene.color, scene.harmonics]) values?.fill(3e38);
  for (const head of scene.motion[1]?.[0].heads ?? []) head?.coefficients.fill(3e38, 0, 90);
  scene.opacity.fill(9);
  const evaluator = new SplatEvaluator(scene);
  for (const level of [0, 1]) {
    const { count, data } = evaluator.evaluate(level, 0.3, [0, 0, 0]);
    assert.ok(count > 20 && data.every(Number.isFinite));
  }
  const still = sceneOf({ heads: [[1], []] });
  still.mask[1].fill(255);
  still.opacity.fill(9);
  const [tracks] = /** @type {Tracks[]} */ (still.motion[1]);
  const head = tracks.heads[1];
  head?.coefficients.forEach((_, i, values) => (values[i] = i % 2 ? 0 : 1));
  head?.bases.forEach((_, k, values) => (values[k] = k < 5 ? -1 : 0)); // D = (−1, 0, 0, 0)
  for (const { quaternion } of recordsOf(new SplatEvaluator(still).evaluate(1, 0.3, [0, 0, 0]))) {
    assert.deepEqual(quaternion, [1, 0, 0, 0]);
  }
});

test("an evaluation writes to the arrays of an earlier one of the same size", () => {
  const evaluator = new SplatEvaluator(sceneOf({ window: true }));
  const first = evaluator.evaluate(2, 0.2, [0, 0, 0]);
  const second = evaluator.evaluate(2, 0.7, [0, 0, 0], first);
  assert.equal(second.data, first.data);
  assert.notEqual(evaluator.evaluate(0, 0.7, [0, 0, 0], first).data, first.data);
});

test("a state has a time where something changes, and an eye where there are harmonics", () => {
  const states = (/** @type {SplatScene} */ scene, /** @type {number} */ level) => [
    sameState(stateOf(scene, level, 1.5, [0, 0, 0]), stateOf(scene, level, 2, [0, 0, 0])),
    sameState(stateOf(scene, level, 2, [0, 0, 0]), stateOf(scene, level, 2, [1, 0, 0])),
  ];
  assert.deepEqual(states(sceneOf(), 0), [true, true]);
  assert.deepEqual(states(sceneOf(), 1), [false, true]);
  assert.deepEqual(states(sceneOf({ heads: [[], []], window: true }), 0), [false, true]);
  assert.deepEqual(states(sceneOf({ heads: [[], []], degree: 1 }), 2), [true, false]);
});
