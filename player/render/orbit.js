// Moving the camera: about a point of the scene, along the picture, towards it.

import { centreOf, cross, downOf, dot, forwardOf, goesOn, lookAlong, magnification } from "./camera.js";
import { middleOf, plus, project, turn, unit } from "./camera.js";
/** @import { Camera } from "../decode/tensors.js" */
/** @import { Scene } from "../kinds/index.js" */
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
/** How far the view of a place may differ from that of its camera: radians, and to the side, ahead and back as shares of
 * the distance to what the camera looks at. Beyond, nothing was captured. */
const CONE = { angle: 0.5, aside: 0.5, ahead: 0.7, back: 0.15 };

/** The camera of a place, and how far what it looks at is. @typedef {{eye: Vector, forward: Vector, distance: number}}
 * Limits */

export class Orbit {
  /** @param {Player} player @param {HTMLElement} surface takes pointers, wheel and keys */
  constructor(player, surface) {
    this._player = player;
    this._surface = surface;
    /** Whether the camera may go where nothing was captured. */
    this.free = false;
    /** Whether the pointer has pressed since it came in: a wheel that only comes past scrolls the page. */
    this._engaged = false;
    /** Whose limits are known, null: it has none. @type {{info: object, limits: Limits | null} | null} */
    this._known = null;
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
    surface.addEventListener("pointerleave", () => (this._engaged = false), { signal });
    surface.addEventListener("wheel", (event) => this._wheel(event), { signal, passive: false });
    surface.addEventListener("contextmenu", (event) => event.preventDefault(), { signal });
    surface.addEventListener("dblclick", () => this.reset(), { signal });
    // in a page that scrolls, a finger that goes up or down scrolls it
    const touch = () => (surface.style.touchAction = this.fills ? "none" : "pan-y");
    addEventListener("resize", touch, { signal });
    touch();
  }

  /** Whether there is nothing beside the surface that could scroll or take keys. */
  get fills() {
    const { clientWidth, clientHeight } = this._surface;
    return clientWidth >= innerWidth && clientHeight >= innerHeight;
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
    this._turn(yaw, 0);
    this._turn(0, pitch); // where one of them ends, the other goes on
  }

  /** @param {number} yaw @param {number} pitch radians */
  _turn(yaw, pitch) {
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
      const scale = magnification(camera, clientWidth, clientHeight, this._player.fit);
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
    this._engaged = true;
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
    if (!this._engaged && !this.fills) return;
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
    const pivot = (this._pivot ??= this._findPivot(camera));
    const down = downOf(camera);
    const up = unit(info.up, plus([0, 0, 0], down, -1));
    const pose = /** @type {[Vector, Vector]} */ ([centreOf(camera), forwardOf(camera)]);
    const next = change(...pose, down, pivot, up);
    if (!next || !next.flat().every(Number.isFinite)) return;
    if (this._excess(next[0], next[1]) > 1 && this._excess(...pose) <= 1) { // a script may have gone beyond
      this._pivot = pivot; // a pan has moved it
      return;
    }
    player.camera = this._made = lookAlong(...next, camera);
  }

  /** How far a view is from the camera of a place, in units of what CONE allows. @param {Vector} eye
   * @param {Vector} forward */
  _excess(eye, forward) {
    const { scene } = this._player;
    if (!scene || this.free) return 0;
    if (this._known?.info !== scene.info) this._known = { info: scene.info, limits: this._findLimits(scene) };
    const { limits } = this._known;
    if (!limits) return 0;
    const moved = plus(eye, limits.eye, -1);
    const ahead = dot(moved, limits.forward) / limits.distance;
    const aside = Math.hypot(...plus(moved, limits.forward, -ahead * limits.distance)) / limits.distance;
    const angle = Math.acos(Math.min(dot(forward, limits.forward), 1));
    return Math.max(angle / CONE.angle, aside / CONE.aside, ahead / CONE.ahead, -ahead / CONE.back);
  }

  /** @param {Scene} scene @returns {Limits | null} */
  _findLimits(scene) {
    const home = scene.info.camera;
    if (!home || !goesOn(scene, home)) return null;
    const eye = centreOf(home);
    const forward = forwardOf(home);
    return { eye, forward, distance: dot(plus(this._findPivot(home), eye, -1), forward) };
  }

  /** What a camera looks at: on its axis, at the median depth of the anchors in the picture's middle.
   * @param {Camera | null} camera */
  _findPivot(camera) {
    const { scene } = this._player;
    if (!scene || !camera) return /** @type {Vector} */ ([0, 0, 0]);
    const { width, height } = camera;
    const { anchor, info } = scene;
    const depths = [];
    const step = 3 * Math.max(1, Math.floor(anchor.length / 3 / SAMPLES));
    for (let i = 0; i < anchor.length; i += step) {
      const [x, y, z] = project(camera, anchor, i);
      const inMiddle = Math.abs(x - width / 2) < width / 4 && Math.abs(y - height / 2) < height / 4;
      if (z > info.near && inMiddle) depths.push(z);
    }
    depths.sort((a, b) => a - b);
    const depth = depths.length
      ? depths[depths.length >> 1]
      : Math.max(dot(plus(middleOf(info), centreOf(camera), -1), forwardOf(camera)), 2 * info.near);
    return plus(centreOf(camera), forwardOf(camera), depth);
  }
}
