// Moving the camera: about a point of the scene, along the picture, towards it.

import { centreOf, cross, downOf, dot, forwardOf, lookAlong, magnification } from "./camera.js";
import { middleOf, plus, turn, unit } from "./camera.js";
/** @import { Camera } from "../decode/scene.js" */
/** @import { Vector } from "./camera.js" */
/** @import { Player } from "./player.js" */

/** Radians that a drag across the picture's shorter side turns. */
const TURN = 2.5;
/** Radians, or shares of the distance, of one key press. */
const KEY_STEP = 0.08;
/** The view stays so far from straight up and down, radians. */
const POLE = 0.1;
/** Factor on the distance of one pixel of a wheel. */
const WHEEL = 1.0015;
/** Anchors that are looked at to find what the camera looks at. */
const SAMPLES = 4000;

export class Orbit {
  /** @param {Player} player @param {HTMLElement} surface takes pointers, wheel and keys */
  constructor(player, surface) {
    this._player = player;
    this._surface = surface;
    /** What the camera turns about. @type {Vector | null} */
    this._pivot = null;
    /** The camera that it made last. @type {Camera | null} */
    this._made = null;
    /** Pointers that are down, by their ids. @type {Map<number, {x: number, y: number}>} */
    this._pointers = new Map();
    this._panning = false;
    this._abort = new AbortController();
    const { signal } = this._abort;
    surface.addEventListener("pointerdown", (event) => this._down(event), { signal });
    surface.addEventListener("pointermove", (event) => this._move(event), { signal });
    for (const name of /** @type {const} */ (["pointerup", "pointercancel"])) {
      surface.addEventListener(name, (event) => this._pointers.delete(event.pointerId), { signal });
    }
    surface.addEventListener("wheel", (event) => this._wheel(event), { signal, passive: false });
    surface.addEventListener("contextmenu", (event) => event.preventDefault(), { signal });
    surface.addEventListener("dblclick", () => this.reset(), { signal });
    surface.style.touchAction = "none";
  }

  /** Back to the scene's own camera. */
  reset() {
    this._player.camera = null;
  }

  /** Stops listening. */
  close() {
    this._abort.abort();
    this._surface.style.touchAction = "";
  }

  /**
   * Turns the camera about what it looks at: to the left and upwards, so that the picture goes right and down.
   *
   * @param {number} yaw @param {number} pitch radians
   */
  turn(yaw, pitch) {
    this._change((eye, forward, down, pivot, up) => {
      const right = cross(down, forward);
      const polar = Math.acos(Math.min(Math.max(-dot(forward, up), -1), 1)); // between the view and straight down
      const by = Math.min(Math.max(pitch, Math.min(polar - Math.PI + POLE, 0)), Math.max(polar - POLE, 0));
      /** @param {Vector} v */
      const turned = (v) => turn(turn(v, right, -by), up, -yaw);
      return [plus(pivot, turned(plus(eye, pivot, -1))), turned(forward), turned(down)];
    });
  }

  /** Moves the picture. @param {number} x @param {number} y CSS pixels to the right and down */
  pan(x, y) {
    this._change((eye, forward, down, pivot) => {
      const camera = this._player.camera;
      const { clientWidth, clientHeight } = this._surface;
      if (!camera || !clientWidth || !clientHeight) return null;
      const scale = magnification(camera, clientWidth, clientHeight);
      const distance = Math.max(dot(plus(pivot, eye, -1), forward), 1e-9);
      const { viewmat } = camera;
      const right = [viewmat[0], viewmat[1], viewmat[2]];
      const by = plus(
        plus([0, 0, 0], right, (-x * distance) / (camera.K[0] * scale)),
        down,
        (-y * distance) / (camera.K[4] * scale),
      );
      this._pivot = plus(pivot, by);
      return [plus(eye, by), forward, down];
    });
  }

  /** Goes towards what the camera looks at. @param {number} factor on the distance, below 1 comes closer */
  zoom(factor) {
    this._change((eye, forward, down, pivot) => {
      const info = this._player.info;
      const away = plus(eye, pivot, -1);
      const distance = Math.hypot(...away);
      const least = 2 * (info?.near ?? 0);
      const next = Math.max(distance * factor, Math.min(least, distance));
      return [plus(pivot, away, next / (distance || 1)), forward, down];
    });
  }

  /** A key. @param {KeyboardEvent} event @returns {boolean} whether it was one of ours */
  key({ key, shiftKey }) {
    const step = Math.min(this._surface.clientWidth, this._surface.clientHeight) * KEY_STEP;
    /** @type {Record<string, [number, number]>} */
    const arrows = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    const arrow = arrows[key];
    if (arrow && shiftKey) this.pan(arrow[0] * step, arrow[1] * step);
    else if (arrow) this.turn(arrow[0] * KEY_STEP, arrow[1] * KEY_STEP);
    else if (key === "+" || key === "=") this.zoom(1 - KEY_STEP);
    else if (key === "-" || key === "_") this.zoom(1 / (1 - KEY_STEP));
    else if (key === "Home") this.reset();
    else return false;
    return true;
  }

  /** @param {PointerEvent} event */
  _down(event) {
    this._surface.setPointerCapture(event.pointerId);
    this._pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    this._panning = event.button !== 0 || event.shiftKey;
  }

  /** @param {PointerEvent} event */
  _move(event) {
    const before = this._pointers.get(event.pointerId);
    if (!before) return;
    const now = { x: event.clientX, y: event.clientY };
    this._pointers.set(event.pointerId, now);
    const x = now.x - before.x;
    const y = now.y - before.y;
    if (this._pointers.size === 1) {
      if (this._panning) this.pan(x, y);
      else {
        const side = Math.min(this._surface.clientWidth, this._surface.clientHeight) || 1;
        this.turn((x / side) * TURN, (y / side) * TURN);
      }
      return;
    }
    const other = [...this._pointers].find(([id]) => id !== event.pointerId)?.[1];
    if (!other) return;
    const was = Math.hypot(before.x - other.x, before.y - other.y);
    const is = Math.hypot(now.x - other.x, now.y - other.y);
    if (was > 0 && is > 0) this.zoom(was / is);
    this.pan(x / 2, y / 2);
  }

  /** @param {WheelEvent} event */
  _wheel(event) {
    event.preventDefault();
    const pixels = event.deltaMode === WheelEvent.DOM_DELTA_PIXEL ? event.deltaY : 30 * event.deltaY;
    this.zoom(WHEEL ** Math.min(Math.max(pixels, -400), 400));
  }

  /**
   * @param {(eye: Vector, forward: Vector, down: Vector, pivot: Vector, up: Vector) => [Vector, Vector, Vector] | null}
   * change gives the new eye, forward and down
   */
  _change(change) {
    const player = this._player;
    const { camera, info } = player;
    if (!camera || !info) return;
    if (camera !== this._made) this._pivot = null; // of another scene or a script's camera
    const pivot = (this._pivot ??= this._findPivot());
    const down = downOf(camera);
    const up = unit(info.up, plus([0, 0, 0], down, -1));
    const next = change(centreOf(camera), forwardOf(camera), down, pivot, up);
    if (next && next.flat().every(Number.isFinite)) player.camera = this._made = lookAlong(...next, camera);
  }

  /** What the camera looks at: on its axis, at the median depth of the anchors in the picture's middle. */
  _findPivot() {
    const { scene, camera } = this._player;
    if (!scene || !camera) return /** @type {Vector} */ ([0, 0, 0]);
    const { viewmat: v, K, width, height } = camera;
    const { anchor, info } = scene;
    const depths = [];
    const step = 3 * Math.max(1, Math.floor(anchor.length / 3 / SAMPLES));
    for (let i = 0; i < anchor.length; i += step) {
      const [x, y, z] = [0, 4, 8].map(
        (r) => v[r] * anchor[i] + v[r + 1] * anchor[i + 1] + v[r + 2] * anchor[i + 2] + v[r + 3],
      );
      if (!(z > info.near)) continue;
      const px = (K[0] * x) / z + K[2] - width / 2;
      const py = (K[4] * y) / z + K[5] - height / 2;
      if (Math.abs(px) < width / 4 && Math.abs(py) < height / 4) depths.push(z);
    }
    depths.sort((a, b) => a - b);
    const depth = depths.length
      ? depths[depths.length >> 1]
      : Math.max(dot(plus(middleOf(info), centreOf(camera), -1), forwardOf(camera)), 2 * info.near);
    return plus(centreOf(camera), forwardOf(camera), depth);
  }
}
