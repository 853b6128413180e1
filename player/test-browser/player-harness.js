// What the browser tests call: `window.harness`.

import { decode } from "../decode/index.js";
import { Player } from "../element.js";
import { evaluate } from "../render/evaluate.js";
import { GpuEvaluator } from "../render/evaluator.js";
import { Gpu } from "../render/gl.js";
import { ANCHOR_BITS, listGaussians, NO_ENTRY } from "../render/sort.js";
import { base64, cameraOf } from "./pictures.js";
/** @import { AnchorScene } from "../kinds/index.js" */

/** Columns of a Gaussian's record. */
const QUANTITIES = { mean: [0, 1, 2], opacity: [3], scale: [4, 5, 6], quaternion: [8, 9, 10, 11], color: [12, 13, 14] };

/**
 * Both evaluators at some levels, times and cameras' centres, in this order on one GPU evaluator. worst: the largest
 * difference of each quantity, relative to its largest magnitude. lonely: how many Gaussians only one of them has
 * although their opacity is clear of the threshold. moved: whether means or the list changed.
 *
 * @param {string} url @param {{level: number, t: number, eye: number[]}[]} cases @param {number} bandPoints
 */
async function compare(url, cases, bandPoints) {
  const scene = /** @type {AnchorScene} */ (decode(await (await fetch(url)).arrayBuffer()));
  const canvas = document.createElement("canvas");
  const gl = /** @type {WebGL2RenderingContext} */ (canvas.getContext("webgl2"));
  const gpu = new Gpu(gl);
  gpu.bandPoints = bandPoints;
  const evaluator = new GpuEvaluator(gpu, scene);
  const lister = async (/** @type {Parameters<typeof listGaussians>} */ ...args) => listGaussians(...args);
  const out = [];
  let splats = null;
  for (const { level, t, eye } of cases) {
    const evaluated = await evaluator.evaluate(level, t, eye, splats, lister);
    ({ splats } = evaluated);
    const { entries, rows, width } = evaluator._listed;
    const n = rows * width;
    const texels = n ? await gpu.read(splats.field, 4, rows) : new Float32Array(0);
    const { count, slot, records } = evaluate(scene, level, t, eye);
    /** Records by their slot, of either evaluator. @type {Map<number, ArrayLike<number>>[]} */
    const [plain, shaded] = [new Map(), new Map()];
    slot.forEach((number, i) => plain.set(number, records.subarray(16 * i, 16 * i + 16)));
    entries.subarray(0, n).forEach((entry, i) => {
      const record = Float32Array.from({ length: 16 }, (_, k) => texels[4 * ((k >> 2) * n + i) + (k & 3)]);
      const anchor = entry & (2 ** ANCHOR_BITS - 1);
      if (entry !== NO_ENTRY) shaded.set(anchor * scene.widths.slots + (entry >>> ANCHOR_BITS), record);
    });
    const worst = Object.entries(QUANTITIES).map(([name, columns]) => {
      let [size, most] = [1e-30, 0];
      for (const [number, record] of plain) {
        const other = shaded.get(number) ?? record;
        for (const k of columns) {
          size = Math.max(size, Math.abs(record[k]));
          most = Math.max(most, Math.abs(record[k] - other[k]));
        }
      }
      return [name, most / size];
    });
    let lonely = 0;
    for (const [own, others] of [[plain, shaded], [shaded, plain]]) {
      for (const [number, record] of own) lonely += Number(record[3] > 1.01 / 255 && !others.has(number));
    }
    out.push({ worst: Object.fromEntries(worst), lonely, count, moved: evaluated.means !== null });
  }
  const error = gl.getError();
  evaluator.free();
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  return { cases: out, error };
}

const harness = {
  compare,
  open,
  shoot,
  loseContext,
  close,
  /** @type {Player | null} */
  player: null,
  /** @type {[string, any][]} */
  events: [],
};
Object.assign(window, { harness });

/**
 * A player on a canvas of some size; events are kept.
 *
 * @param {string} url @param {number} width @param {number} height
 * @param {import("../render/player.js").Options} [options]
 */
async function open(url, width, height, options = {}) {
  close();
  const canvas = document.createElement("canvas");
  Object.assign(canvas.style, { width: `${width}px`, height: `${height}px` });
  document.body.append(canvas);
  const made = new Player(canvas, { degrade: false, pixelRatio: 1, ...options });
  harness.player = made;
  /** @type {[string, any][]} */
  const events = (harness.events = []);
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
  const { player } = harness;
  if (!player) throw new Error("nothing is open");
  if (level !== undefined) player.level = level;
  if (seconds !== undefined) player.seek(seconds);
  if (viewmat && K && width && height) {
    player.camera = cameraOf({ viewmat, K, width, height });
  }
  await player.settled();
  return base64(player.snapshot().data);
}

/** Takes the GPU away for a while. */
async function loseContext() {
  const { player } = harness;
  const gl = player?.canvas.getContext("webgl2");
  const extension = gl?.getExtension("WEBGL_lose_context");
  const lost = new Promise((resolve) => player?.canvas.addEventListener("webglcontextlost", resolve, { once: true }));
  extension?.loseContext();
  await lost;
  await new Promise((resolve) => setTimeout(resolve, 50));
  extension?.restoreContext();
}

function close() {
  harness.player?.close();
  harness.player?.canvas.remove();
  harness.player = null;
}
