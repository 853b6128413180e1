// What the browser tests call: `window.harness`.

import { decode } from "../decode/index.js";
import { Player } from "../element.js";
import { evaluate } from "../render/evaluate.js";
import { GpuEvaluator, NO_ENTRY } from "../render/evaluator.js";
import { Gpu } from "../render/gl.js";
import { listGaussians } from "../render/sort.js";

/** @param {string} url */
async function sceneOf(url) {
  return decode(await (await fetch(url)).arrayBuffer());
}

/**
 * The two evaluators over some levels, times and cameras' centres, in this order on one GPU evaluator: the largest
 * difference of each quantity, relative to its largest magnitude, and how many Gaussians only one of them has although
 * its opacity is clear of the threshold.
 *
 * @param {string} url @param {{level: number, t: number, eye: number[]}[]} cases @param {number} bandPoints
 */
async function compare(url, cases, bandPoints) {
  const scene = await sceneOf(url);
  const canvas = document.createElement("canvas");
  const gl = /** @type {WebGL2RenderingContext} */ (canvas.getContext("webgl2"));
  const gpu = new Gpu(gl);
  gpu.bandPoints = bandPoints;
  const evaluator = new GpuEvaluator(gpu, scene);
  const lister = { list: async (/** @type {Parameters<typeof listGaussians>} */ ...args) => listGaussians(...args) };
  const slots = scene.offset.length / scene.anchor.length;
  const out = [];
  let splats = null;
  for (const { level, t, eye } of cases) {
    ({ splats } = await evaluator.evaluate(level, t, eye, splats, lister));
    const n = splats.texels;
    const texels = n ? await gpu.read(splats.field, 0, 4, n / splats.field.width) : new Float32Array(0);
    const reference = evaluate(scene, level, t, eye);
    const at = new Map();
    evaluator.slotsOfTexels().forEach((slot, i) => slot !== NO_ENTRY && i < n && at.set(slot, i));
    /** @type {Record<string, [Float32Array, number, number, number]>} values, width, block, first component */
    const quantities = {
      mean: [reference.mean, 3, 0, 0],
      opacity: [reference.opacity, 1, 0, 3],
      scale: [reference.scale, 3, 1, 0],
      quaternion: [reference.quaternion, 4, 2, 0],
      color: [reference.color, 3, 3, 0],
    };
    const worst = Object.fromEntries(
      Object.entries(quantities).map(([name, [values, width, block, first]]) => {
        const size = values.reduce((most, v) => Math.max(most, Math.abs(v)), 1e-30);
        let difference = 0;
        reference.slot.forEach((slot, i) => {
          const g = at.get(slot);
          if (g === undefined) return;
          for (let k = 0; k < width; k++) {
            const d = Math.abs(values[i * width + k] - texels[4 * (block * n + g) + first + k]) / size;
            if (!(d <= difference)) difference = d;
          }
        });
        return [name, difference];
      }),
    );
    const clear = 1.01 / 255;
    const known = new Set(reference.slot);
    let lonely = 0;
    reference.slot.forEach((slot, i) => (lonely += Number(reference.opacity[i] > clear && !at.has(slot))));
    for (const [slot, g] of at) lonely += Number(texels[4 * g + 3] > clear && !known.has(slot));
    out.push({ worst, lonely, count: reference.count, slots });
  }
  const error = gl.getError();
  evaluator.free();
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  return { cases: out, error };
}

/** @type {Player | null} */
let player = null;
/** @type {[string, any][]} */
let events = [];

/**
 * A player on a canvas of some size; events are kept.
 *
 * @param {string} url @param {number} width @param {number} height
 * @param {import("../render/player.js").Options} [options]
 */
async function open(url, width, height, options = {}) {
  close();
  const canvas = document.createElement("canvas");
  Object.assign(canvas.style, { width: `${width}px`, height: `${height}px`, display: "block" });
  document.body.append(canvas);
  const made = new Player(canvas, { degrade: false, pixelRatio: 1, ...options });
  player = made;
  events = [];
  for (const name of ["firstpicture", "upgrade", "loaded", "error"]) {
    made.addEventListener(name, (event) => events.push([name, /** @type {CustomEvent} */ (event).detail]));
  }
  await made.load(url);
  return events;
}

/**
 * The settled picture as base64 of its RGBA bytes.
 *
 * @param {{level?: number, seconds?: number, viewmat?: number[], K?: number[], width?: number, height?: number}}
 * [state]
 */
async function shoot({ level, seconds, viewmat, K, width, height } = {}) {
  if (!player) throw new Error("nothing is open");
  if (level !== undefined) player.level = level;
  if (seconds !== undefined) player.seek(seconds);
  if (viewmat && K && width && height) {
    player.camera = { viewmat: new Float32Array(viewmat), K: new Float32Array(K), width, height };
  }
  await player.settled();
  const { data } = player.snapshot();
  let text = "";
  for (let i = 0; i < data.length; i += 8192) text += String.fromCharCode(...data.subarray(i, i + 8192));
  return btoa(text);
}

/** Takes the GPU away for a while. */
async function loseContext() {
  const gl = player?.canvas.getContext("webgl2");
  const extension = gl?.getExtension("WEBGL_lose_context");
  const lost = new Promise((resolve) => player?.canvas.addEventListener("webglcontextlost", resolve, { once: true }));
  extension?.loseContext();
  await lost;
  await new Promise((resolve) => setTimeout(resolve, 50));
  extension?.restoreContext();
}

function close() {
  player?.close();
  player?.canvas.remove();
  player = null;
}

Object.assign(window, {
  harness: {
    compare,
    open,
    shoot,
    loseContext,
    close,
    get player() {
      return player;
    },
    get events() {
      return events;
    },
  },
});
