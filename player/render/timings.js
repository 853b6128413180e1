// What a file costs in node, as JSON for pd4dgs-bench: `node timings.js FILE PICTURES`. Milliseconds of CPU, medians over
// pictures at times of the highest level, whose camera moves.

import { readFileSync } from "node:fs";

import { decode } from "../decode/index.js";
import { drawing } from "../kinds/drawing.js";
import { COMPONENTS } from "../kinds/rules.js";
import { centreOf, defaultCamera } from "./camera.js";
import { packed } from "./ext-splats.js";
import { levelOf } from "./level.js";
import { takeCentres } from "./playback.js";
import { DepthSort } from "./sort.js";
import { SplatEvaluator, basesOf, eachBasis } from "./splats.js";

const LEVEL = 2;
const DECODINGS = 3;
/** Between two pictures, of all times. */
const STEP = 0.0137;

const [, , file, pictures] = process.argv;
/** By step, milliseconds of each of its runs. @type {Record<string, number[]>} */
const taken = {};

/** @template T @param {string} step @param {() => T} run @returns {T} */
function timed(step, run) {
  const start = process.cpuUsage();
  const result = run();
  const { user, system } = process.cpuUsage(start); // microseconds
  (taken[step] ??= []).push((user + system) / 1000);
  return result;
}

const bytes = readFileSync(file);
for (let i = 1; i < DECODINGS; i++) timed("decode", () => decode(bytes));
const scene = timed("decode", () => decode(bytes));
const camera = defaultCamera(scene.info);
const centre = centreOf(camera);
const row = camera.viewmat.slice(8, 12);
const sorter = new DepthSort();
const evaluator = drawing(scene).cpu(scene);
const explicit = evaluator instanceof SplatEvaluator ? evaluator : null;
const tracks = (scene.kind === "splats" && levelOf(scene, LEVEL).motion) || [];
/** @type {import("./ext-splats.js").Packed | null} */
let splats = null;
/** @type {import("./level.js").Texels | null} */
let spare = null;
/** What PlayCanvas has, [4, ...] and the centres. */
let arrays = new Float32Array(0);
let centres = new Float32Array(0);

for (let i = 0; i < Number(pictures); i++) {
  const t = (i * STEP) % 1;
  const eye = centre.map((x) => x + i / 1000);
  const texels = timed("evaluate", () => evaluator.evaluate(LEVEL, t, eye, spare));
  spare = texels;
  const { count, data, changing } = texels;
  const means = explicit ? timed("evaluate means", () => explicit.means(LEVEL, t)) : data.slice(0, 4 * count);
  timed("sort", () => sorter.sort(means, row, scene.info.near));
  splats = timed("pack for Spark", () => packed(texels, splats));
  timed("page, own player: bases", () => {
    COMPONENTS.forEach((_, head) => eachBasis(basesOf(tracks, head).parts, t, () => {}));
  });
  if (arrays.length !== data.length) [arrays, centres] = [data.slice(), new Float32Array((3 * data.length) / 16)];
  timed("page, PlayCanvas: arrays", () => {
    const size = data.length / 4;
    for (const b of changing) arrays.set(data.subarray(b * size, b * size + 4 * count), b * size);
    takeCentres(data, count, centres);
  });
}

/** Of the runs behind those that are compiled. @param {number[]} runs */
const median = (runs) => runs.slice(runs.length >> 2).sort((a, b) => a - b)[(runs.length - (runs.length >> 2)) >> 1];
const steps = Object.fromEntries(Object.entries(taken).map(([step, runs]) => [step, median(runs)]));
process.stdout.write(`${JSON.stringify({ gaussians: spare?.count ?? 0, steps })}\n`);
