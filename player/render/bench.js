// The page that measures itself: frame rates per level and size, on the machine that opens it.

import { centreOf, dot, downOf, forwardOf, lookAlong, plus, turn } from "./camera.js";
import { Player } from "./player.js";

/** CSS pixels. */
const SIZES = "320x240,640x480,1280x720,1920x1080";
/** Of one measurement, milliseconds; slow machines do at least one picture. */
const SPAN_MS = 2000;
/** Where moving pictures come more slowly, larger ones are left out. */
const SLOWEST = 1;
/** Radians to and fro that the camera turns while it is measured, and the length of that. */
const SWING = 0.1;
const SWING_MS = 2000;

/**
 * One row of the result. moving: pictures a second while the camera moves and the time stands still. playing: the same
 * while time moves; where nothing depends on time, level 0, that is 0.
 *
 * @typedef {object} Row
 * @property {number} level
 * @property {number} width
 * @property {number} height
 * @property {number} gaussians
 * @property {number} moving
 * @property {number} playing
 */

/**
 * Measures a scene and writes a table into `place`. The result is also `window.benchResult`.
 *
 * @param {string | Blob} source @param {HTMLElement} place @param {string} [sizes] to measure, smallest first
 */
export async function bench(source, place, sizes = SIZES) {
  const output = document.createElement("div");
  output.id = "bench";
  const state = document.createElement("p");
  const canvas = document.createElement("canvas");
  output.append(state);
  place.append(output, canvas);
  const player = new Player(canvas, { degrade: false, pixelRatio: 1 });
  /** @type {{seconds: number, bytes: number} | null} */
  let first = null;
  player.addEventListener("firstpicture", (event) => (first = /** @type {CustomEvent} */ (event).detail));
  player.addEventListener("error", (event) => {
    state.textContent = /** @type {CustomEvent} */ (event).detail.message;
  });
  Object.assign(canvas.style, { width: "640px", height: "480px" });
  const name = source instanceof Blob ? "the scene" : source;
  state.textContent = `loading ${name}`;
  const started = performance.now();
  await player.load(source);
  const loaded = (performance.now() - started) / 1000;
  if (!player.scene) return;
  /** @type {Row[]} */
  const rows = [];
  for (const level of player.status.levels) {
    player.level = level;
    for (const [width, height] of sizes.split(",").map((size) => size.split("x").map(Number))) {
      Object.assign(canvas.style, { width: `${width}px`, height: `${height}px` });
      state.textContent = `level ${level}, ${width} × ${height}`;
      await player.settled();
      const moving = await perSecond(() => player.counts.drawn, swing(player));
      await player.settled();
      const playing = level ? await perSecond(() => player.counts.evaluated, play(player)) : 0;
      rows.push({ level, width, height, gaussians: player.status.gaussians, moving, playing });
      if (moving < SLOWEST) break;
    }
  }
  const result = { renderer: player.renderer, agent: navigator.userAgent, source: name, loaded, first, rows };
  player.close();
  canvas.remove();
  output.append(table(rows));
  state.textContent =
    `${name}: ${player.status.bytes.toLocaleString()} bytes in ${loaded.toFixed(2)} s. ` +
    `Drawn by ${result.renderer}. Pictures per second:`;
  Object.assign(window, { benchResult: result });
}

/**
 * How much `count` grows in a second while `step` is called with the milliseconds since the start.
 *
 * @param {() => number} count @param {(ms: number) => void} step
 */
async function perSecond(count, step) {
  const before = count();
  const start = performance.now();
  let last = start;
  for (let now = start; now - start < SPAN_MS || count() === before; now = performance.now()) {
    step(now - start);
    const drawn = count();
    await new Promise((resolve) => requestAnimationFrame(resolve));
    if (count() !== drawn) last = performance.now();
  }
  return (1000 * (count() - before)) / (last - start);
}

/** Turns the camera to and fro about a point before it. @param {Player} player @returns {(ms: number) => void} */
function swing(player) {
  const camera = player.camera;
  const info = player.info;
  if (!camera || !info) return () => {};
  const middle = plus(plus([0, 0, 0], info.box[0], 0.5), info.box[1], 0.5);
  const depth = Math.max(dot(plus(middle, centreOf(camera), -1), forwardOf(camera)), 2 * info.near);
  const pivot = plus(centreOf(camera), forwardOf(camera), depth);
  return (ms) => {
    const angle = SWING * Math.sin((2 * Math.PI * ms) / SWING_MS);
    const [forward, down] = [forwardOf(camera), downOf(camera)].map((v) => turn(v, downOf(camera), angle));
    player.camera = lookAlong(plus(pivot, forward, -depth), forward, down, camera);
  };
}

/** Goes through the scene's time. @param {Player} player @returns {(ms: number) => void} */
function play(player) {
  const [start, end] = player.timeRange;
  const length = end - start || 1;
  return (ms) => {
    player.seek(start + ((ms / 1000) % length));
  };
}

/** @param {Row[]} rows */
function table(rows) {
  const names = ["level", "width", "height", "gaussians", "moving", "playing"];
  const element = document.createElement("table");
  const head = element.createTHead().insertRow();
  for (const name of names) head.append(Object.assign(document.createElement("th"), { textContent: name }));
  const body = element.createTBody();
  for (const row of rows) {
    const line = body.insertRow();
    for (const [name, value] of Object.entries(row)) {
      const rate = name === "moving" || name === "playing";
      line.insertCell().textContent = rate ? value.toFixed(1) : value.toLocaleString();
    }
  }
  return element;
}
