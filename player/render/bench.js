// The page that measures frame rates per level and size on the machine that opens it.

import { levelOf } from "./level.js";
import { Orbit } from "./orbit.js";
import { Player } from "./player.js";

/** CSS pixels, smallest first. */
const SIZES = "320x240,640x480,1280x720,1920x1080";
/** Length of one measurement, milliseconds; slow machines draw at least one picture. */
const SPAN_MS = 1000;
/** Below this rate, larger pictures are not measured. */
const SLOWEST = 1;
/** Radians that the camera turns to each side, and the period, milliseconds. */
const SWING = 0.1;
const SWING_MS = 2000;

/**
 * Measures a scene; the result is shown and is `window.benchResult`. moving: pictures per second while the camera moves
 * and time stands still. playing: evaluations per second while time advances; 0 for a level that is static.
 *
 * @param {string | Blob} source @param {HTMLElement} place @param {string} [sizes]
 */
export async function bench(source, place, sizes = SIZES) {
  const output = Object.assign(document.createElement("pre"), { id: "bench", textContent: "loading" });
  const canvas = document.createElement("canvas");
  place.append(output, canvas);
  const player = new Player(canvas, { degrade: false, pixelRatio: 1, loop: true });
  const orbit = new Orbit(player, canvas);
  /** @type {{seconds: number, bytes: number} | null} */
  let first = null;
  player.addEventListener("firstpicture", (event) => (first = /** @type {CustomEvent} */ (event).detail));
  player.addEventListener("error", (event) => (output.textContent = /** @type {CustomEvent} */ (event).detail.message));
  Object.assign(canvas.style, { width: "640px", height: "480px" });
  const started = performance.now();
  await player.load(source);
  const loaded = (performance.now() - started) / 1000;
  if (!player.scene) return;
  const rows = [];
  for (const level of player.status.levels) {
    player.level = level;
    for (const [width, height] of sizes.split(",").map((size) => size.split("x").map(Number))) {
      Object.assign(canvas.style, { width: `${width}px`, height: `${height}px` });
      output.textContent = `level ${level}, ${width} × ${height}`;
      await player.settled();
      const moving = await perSecond(() => player.counts.drawn, swing(orbit));
      await player.settled();
      player.play();
      const moves = player.scene && levelOf(player.scene, level).motion;
      const playing = moves ? await perSecond(() => player.counts.evaluated) : 0;
      player.pause();
      rows.push({ level, width, height, gaussians: player.status.gaussians, moving, playing });
      if (moving < SLOWEST) break;
    }
  }
  const name = source instanceof Blob ? "the scene" : source;
  const result = { renderer: player.renderer, agent: navigator.userAgent, source: name, loaded, first, rows };
  player.close();
  canvas.remove();
  output.textContent = JSON.stringify(result, null, 1);
  Object.assign(window, { benchResult: result });
}

/**
 * Increase of `count` per second while `step` is called with the milliseconds since the start.
 *
 * @param {() => number} count @param {(ms: number) => void} [step]
 */
async function perSecond(count, step) {
  const before = count();
  const start = performance.now();
  let last = start;
  for (let now = start; now - start < SPAN_MS || count() === before; now = performance.now()) {
    step?.(now - start);
    const drawn = count();
    await new Promise((resolve) => requestAnimationFrame(resolve));
    if (count() !== drawn) last = performance.now();
  }
  return (1000 * (count() - before)) / (last - start);
}

/** Turns the camera to and fro. @param {Orbit} orbit @returns {(ms: number) => void} */
function swing(orbit) {
  let turned = 0;
  return (ms) => {
    const angle = SWING * Math.sin((2 * Math.PI * ms) / SWING_MS);
    orbit.turn(angle - turned, 0);
    turned = angle;
  };
}
