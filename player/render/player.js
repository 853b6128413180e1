// A player on a canvas. It loads, evaluates, sorts and draws, each step only when its inputs have changed.

import { centreOf, defaultCamera, fitted } from "./camera.js";
import { Drawable } from "./drawable.js";
import { Gpu } from "./gl.js";
import { levelOf, stateOf } from "./level.js";
import { Clip } from "./loader.js";
import { Pace } from "./pace.js";
import { Painter } from "./painter.js";
/** @import { Camera } from "../decode/tensors.js" */
/** @import { Scene } from "../kinds/index.js" */
/** @import { State } from "./level.js" */

/**
 * @typedef {object} Options
 * @property {number | null} [level] the highest to load and show, default all
 * @property {number | null} [time] seconds of the scene's time to start at
 * @property {boolean} [autoplay]
 * @property {boolean} [loop]
 * @property {number | null} [speed] seconds of the scene's time per second, default 1
 * @property {number | null} [bytes] how much of the file to load at most
 * @property {number | null} [seconds] how long to load beyond the first slice
 * @property {number | null} [held] so many bytes of a file show less than the poster that covers the canvas: with them,
 * nothing counts as shown, or plays, unless the viewer acts, another start than the poster's is asked for, or no more comes
 * @property {"gpu" | "cpu" | null} [evaluator] default: the faster one of the machine
 * @property {boolean} [degrade] whether a slow machine gets fewer pixels while something moves, default true
 * @property {import("./camera.js").Fit} [fit] what a window of another shape shows, default contain
 * @property {number | null} [pixelRatio] device pixels per CSS pixel, default the window's, at most 2
 */

/**
 * The state of a player, for a status line.
 *
 * @typedef {object} Status
 * @property {number} bytes arrived so far
 * @property {number | null} total length of the file, null while it is unknown
 * @property {boolean} loading
 * @property {{layer: number, end: number}[]} ends where in the file each slice ends, empty while it is unknown
 * @property {number | null} level shown, null before the first picture
 * @property {number[]} levels that have arrived
 * @property {number} fps pictures drawn a second while something moves, else 0
 * @property {number} scale of the picture's sides
 * @property {number} gaussians drawn
 * @property {boolean} software whether the CPU draws, for want of a GPU
 * @property {boolean} lost whether it is in view and the browser has taken the WebGL context
 * @property {string} problem why the segment at hand does not come, "" if it does
 * @property {[number, number] | null} awaited the seconds that it shows, while it is on its way
 */

/** After so many milliseconds without movement the picture is drawn at full quality. */
const REST_MS = 250;
/** The first step of SCALES without a GPU. */
const SOFTWARE_STEP = 2;
/** So many players of a page have WebGL contexts, as many as mobile browsers keep; for more in view, the browser decides.
 * Those out of view give theirs up. */
const MOST_CONTEXTS = 8;
/** Players that have one. @type {Set<Player>} */
const equipped = new Set();
/** A context that the browser took comes back within so many milliseconds, or others have it. */
const LOST_MS = 1000;

/**
 * Events: those of `Clip`; `progress` {bytes, total}; `firstpicture` and `upgrade` {level, bytes, seconds, arrived,
 * decoded}. Seconds count from `load`: to the picture, to the last byte that it is made of, and to the end of their
 * decoding.
 */
export class Player extends Clip {
  /** @param {HTMLCanvasElement} canvas @param {Options} [options] */
  constructor(canvas, options = {}) {
    super(options);
    this.canvas = canvas;
    this._options = options;
    /** @type {Camera | null} */
    this._camera = null;
    /** The camera of a headset, which draws meanwhile. @type {Camera | null} */
    this._head = null;
    /** @type {number | null} */
    this._level = options.level ?? null;
    this._pace = new Pace();
    /** Whether it plays as soon as what it begins with is there. */
    this._starts = false;
    /** As the option, 0 once a picture counts. */
    this._held = 0;
    /** The highest level that loading went for. */
    this._loadedLevel = Infinity;
    /** @type {Pick<Status, "bytes" | "total" | "loading" | "ends">} */
    this._status = { bytes: 0, total: null, loading: false, ends: [] };

    /** @type {Gpu | null} */
    this._gpu = null;
    /** @type {Painter | null} */
    this._painter = null;
    /** Draws the scene. */
    this._main = new Drawable(options.evaluator);
    /** Draws the one that it is blended with, once there was one. @type {Drawable | null} */
    this._second = null;
    this._drawing = false;
    this._dirty = true;
    /** @type {number | null} */
    this._shownLevel = null;
    /** Anchors of that level. */
    this._shownRows = 0;
    this._frameRequest = 0;
    this._lastFrame = 0;
    this._lastMoved = -Infinity;
    /** Ends of draws in the last second, of slower ones the last four. @type {number[]} */
    this._draws = [];
    this._started = performance.now();
    /** When scenes came, and of how many bytes. @type {WeakMap<Scene, {arrived: number, decoded: number, consumed: number}>} */
    this._came = new WeakMap();
    /** Pictures drawn and evaluations made so far. */
    this.counts = { drawn: 0, evaluated: 0 };
    this._listening = new AbortController();
    const { signal } = this._listening;
    /** What brings back the context that was given up. @type {WEBGL_lose_context | null} */
    this._given = null;
    /** When the browser took the context. */
    this._lostAt = Infinity;
    const lost = (/** @type {Event} */ event) => {
      event.preventDefault(); // else it never comes back
      this._dropGpu();
      if (!this._given) this._lostAt = performance.now();
      else if (this._inView) setTimeout(() => this._equip()); // it has come back meanwhile
    };
    const restored = () => {
      this._given = null;
      this._startGpu();
      this._wake();
    };
    canvas.addEventListener("webglcontextlost", lost, { signal });
    canvas.addEventListener("webglcontextrestored", restored, { signal });
    this._resize = new ResizeObserver(() => this._changed());
    this._resize.observe(canvas);
    this._visible = true;
    /** Whether it is known to be in view. */
    this._inView = false;
    this._seen = new IntersectionObserver((entries) => {
      this._visible = this._inView = entries[entries.length - 1].isIntersecting; // the newest
      if (this._inView) this._equip();
      this._wake();
    });
    this._seen.observe(canvas);
  }

  // --- public

  /**
   * Loads a scene in place of what is shown: an address, or a file.
   *
   * @param {string | URL | Blob} source
   * @returns {Promise<void>} settles when no more is loaded; errors are events
   */
  async load(source) {
    if (this.closed) return;
    this._open(source);
    this._scene = null;
    this._starts = false;
    this._held = this._options.time == null ? (this._options.held ?? 0) : 0;
    this._shownLevel = null;
    this._camera = null;
    for (const drawable of this._drawables()) drawable.clear();
    this._time = this._options.time ?? null;
    this._status = { bytes: 0, total: null, loading: true, ends: [] };
    this._started = performance.now();
    this._dirty = true;
    const loading = this._loadOn();
    if (this._inView || equipped.size < MOST_CONTEXTS) this._equip(); // which takes longer than to ask a server
    if (this._options.evaluator === "cpu" || this._gpu?.software) this._main.prepare();
    await loading;
  }

  /** Loads as much as options and level allow. */
  async _loadOn() {
    const { bytes, seconds } = this._options;
    const loader = this._loader;
    this._loadedLevel = this._level ?? Infinity;
    this._status.loading = true;
    await this._load({ maxLayer: this._loadedLevel, bytes: bytes ?? undefined, seconds: seconds ?? undefined });
    if (loader !== this._loader) return;
    this._status.loading = false;
    if ((this._level ?? Infinity) > this._loadedLevel) await this._loadOn(); // raised meanwhile
    else this._holdNoMore();
  }

  /** Stops loading; layers that have arrived stay. */
  stopLoading() {
    super.stopLoading();
    this._status.loading = false;
    this._holdNoMore();
  }

  /** @param {number} seconds of the scene's time */
  seek(seconds) {
    if (seconds !== this.time) this._release();
    super.seek(seconds);
  }

  play() {
    this._release();
    super.play();
  }

  /** As no more comes, the newest counts. */
  _holdNoMore() {
    if (!this._held) return;
    this._held = this._scene ? Math.min(this._held, this._consumed(this._scene) - 1) : 0;
    this._wake();
    this._begin();
  }

  /** Bytes that a scene is made of. @param {Scene} scene */
  _consumed(scene) {
    return this._came.get(scene)?.consumed ?? Infinity;
  }

  /** From now on what is drawn counts. */
  _release() {
    if (!this._held) return;
    this._held = 0;
    this._changed();
    this._begin();
  }

  /** Plays, if that was asked for and what it begins with is there. */
  _begin() {
    if (!this._starts || this._held || this.awaited) return;
    this._starts = false;
    this.play();
  }

  /** The scene as far as it has arrived. */
  get scene() {
    return this._scene;
  }

  /** The highest level to show, null: the highest there is. */
  get level() {
    return this._level;
  }

  set level(level) {
    this._level = level;
    const more = (level ?? Infinity) > this._loadedLevel;
    if (more && this._loader && !this._status.loading) this._loadOn();
    this._changed();
  }

  /** What a window of another shape than the camera's picture shows. @returns {import("./camera.js").Fit} */
  get fit() {
    return this._options.fit ?? "contain";
  }

  set fit(fit) {
    this._options.fit = fit;
    this._changed();
  }

  /** The camera in use; assign null for the scene's own. @returns {Camera | null} */
  get camera() {
    return this._head ?? this._camera ?? (this._scene && defaultCamera(this._scene.info));
  }

  set camera(camera) {
    this._camera = camera;
    this._release();
    this._changed();
  }

  /** @returns {Status} */
  get status() {
    const now = performance.now();
    return {
      ...this._status,
      level: this._shownLevel,
      levels: this._scene?.layers ?? [],
      fps: this._moving(now) ? this._rate(now) : 0,
      scale: this._moving(now) ? this._scale() : 1,
      gaussians: this._drawables().reduce((sum, { front, order }) => sum + ((front && order?.count) || 0), 0),
      software: this._gpu?.software ?? false,
      problem: this.problem,
      awaited: this.awaited,
      lost: this._visible && now - this._lostAt > LOST_MS,
    };
  }

  /** Pictures a second lately; 0 where the last one was long ago. @param {number} now */
  _rate(now) {
    const draws = this._draws;
    while (draws.length > 4 && now - draws[0] > 1000) draws.shift();
    const span = (draws[draws.length - 1] - draws[0]) / (draws.length - 1);
    return draws.length > 1 && now - draws[draws.length - 1] < 2 * span + 500 ? 1000 / span : 0;
  }

  /** The renderer as the driver names it; empty without WebGL2. */
  get renderer() {
    return this._gpu?.renderer ?? "";
  }

  /** Waits until the picture is complete and at full quality. */
  async settled() {
    while (!this.closed && !(this._scene && !this.awaited && this._isSettled())) {
      await new Promise((resolve) => setTimeout(resolve, 5));
    }
  }

  /** The picture on show, its size that of the canvas. */
  snapshot() {
    const { width, height } = this.canvas;
    const picture = /** @type {OffscreenCanvasRenderingContext2D} */ (new OffscreenCanvas(width, height).getContext("2d"));
    if (this._draw()) picture.drawImage(this.canvas, 0, 0);
    return picture.getImageData(0, 0, width, height);
  }

  /**
   * Draws a frame of a headset, which takes the place of the canvas until `release`.
   *
   * @param {number} now milliseconds @param {Camera} head that Gaussians are evaluated and sorted for
   * @param {(Camera & {x: number, y: number})[]} eyes @param {import("./painter.js").Target} target
   */
  present(now, head, eyes, target) {
    this._head = head;
    this._release();
    if (!this._gpu || !this._scene) return;
    this._step(now);
    const state = this._draw(eyes, target);
    if (state) this._shown(state, now);
  }

  /** Draws on the canvas again. */
  release() {
    this._head = null;
    this._lastFrame = 0;
    this._changed();
  }

  /** Frees everything; the player cannot be used again. */
  close() {
    if (this.closed) return;
    this._held = 0;
    super.close();
    cancelAnimationFrame(this._frameRequest);
    this._resize.disconnect();
    this._seen.disconnect();
    this._listening.abort();
    for (const drawable of this._drawables()) drawable.close();
    this._giveUp();
    this.canvas.width = this.canvas.height = 1;
  }

  // --- loading

  /** @param {import("./loader-worker.js").News} news */
  _told(news) {
    const { scene, arrived, decoded, consumed, bytes, total, ends } = news;
    Object.assign(this._status, { bytes, total, ends });
    this._emit("progress", { bytes, total });
    if (scene) {
      const start = performance.timeOrigin + this._started;
      this._came.set(scene, { arrived: (arrived - start) / 1000, decoded: (decoded - start) / 1000, consumed });
    }
    const first = super._told(news);
    this._starts ||= first && !!this._options.autoplay;
    this._begin();
    this._dirty ||= !!scene; // which is no movement, for which pictures would have fewer pixels
    this._wake();
    return first;
  }

  // --- the GPU

  /** Sees to a GPU for what is loaded. */
  _equip() {
    if (this._gpu || this.closed || !(this._loader || this._scene)) return;
    if (equipped.size >= MOST_CONTEXTS) [...equipped].find((player) => !player._visible)?._giveUp();
    if (this._given) this._given.restoreContext();
    else this._startGpu();
  }

  /** Gives up the WebGL context, as browsers keep few alive; `_equip` brings it back. */
  _giveUp() {
    this._given = this._gpu?.gl.getExtension("WEBGL_lose_context") ?? this._given;
    this._dropGpu();
    this._given?.loseContext();
  }

  _startGpu() {
    const gl = this.canvas.getContext("webgl2", {
      alpha: false,
      antialias: false,
      depth: false,
      powerPreference: "high-performance",
    });
    if (!gl) {
      setTimeout(() => this._fail(new Error("this browser has no WebGL2, which the player needs")));
      return;
    }
    if (gl.isContextLost()) return;
    this._gpu = new Gpu(gl);
    equipped.add(this);
    this._lostAt = Infinity;
    this._pace = new Pace(this._gpu.software ? SOFTWARE_STEP : 0);
    this._painter = new Painter(this._gpu);
    this._dirty = true;
  }

  /** Forgets a GPU whose context is lost, and with it all that it held. */
  _dropGpu() {
    this._gpu = this._painter = null;
    for (const drawable of this._drawables()) drawable.drop();
    equipped.delete(this);
  }

  /** Whether another scene was opened, or the GPU's context lost, since a step began: it then has no result, and its
   * fault is none. @param {Gpu} gpu @param {number} opened `_started` when it began */
  _isStale(gpu, opened) {
    return this.closed || gpu !== this._gpu || opened !== this._started || gpu.gl.isContextLost();
  }

  // --- the loop

  /** The picture has to change. */
  _changed() {
    this._dirty = true;
    this._lastMoved = performance.now();
    this._wake();
  }

  _wake() {
    if (this._frameRequest || this.closed || this._head) return;
    this._frameRequest = requestAnimationFrame((now) => {
      this._frameRequest = 0;
      this._frame(now);
    });
  }

  /** @param {number} now */
  _moving(now) {
    return this._playing || now - this._lastMoved < REST_MS;
  }

  _scale() {
    return this._options.degrade === false ? 1 : this._pace.scale;
  }

  /** @param {number} now */
  _frame(now) {
    if (this._head) return;
    if (!this._visible || !this._gpu || !this._scene) {
      this._lastFrame = 0;
      return;
    }
    this._step(now);
    const size = this._size(now);
    const { _front: front } = this;
    const counts = front && this._consumed(front.scene) > this._held;
    if (counts && !this._drawing && (this._dirty || !this._isSized(size))) this._show(size, front);
    if (this._playing || !this._isSettled()) this._wake();
  }

  /** Brings time, Gaussians and their order on. @param {number} now */
  _step(now) {
    if (this._playing) {
      this._advance(this._lastFrame ? Math.min((now - this._lastFrame) / 1000, 0.25) : 0);
      this._lastFrame = now;
    }
    this._assign();
    for (const [drawable, state] of this._states()) {
      const waits = drawable.evaluating || this._waits() || drawable.isEvaluated(state);
      if (!waits) this._evaluate(drawable, state);
      this._sort(drawable);
    }
  }

  /** All that draw. */
  _drawables() {
    return this._second ? [this._main, this._second] : [this._main];
  }

  /** Gives the scene, and the one that it is blended with, to what has their Gaussians. */
  _assign() {
    const { _scene: scene, fading, _main: main, _second: second } = this;
    if (fading && !second) this._second = new Drawable(this._options.evaluator);
    if (this._second && scene !== main.scene && (second?.scene === scene || main.scene === fading?.scene)) {
      [this._main, this._second] = [this._second, main];
    }
    if (!fading && this._second?.scene) this._second.clear();
  }

  /** What draws, and the state to show of each. @returns {[Drawable, State][]} */
  _states() {
    const { fading, _second: second } = this;
    const main = this._state(/** @type {Scene} */ (this._scene));
    return fading && second ? [[this._main, main], [second, this._state(fading.scene)]] : [[this._main, main]];
  }

  /** The state on show, of two the one of the scene. @returns {State | null} */
  get _front() {
    const [last] = this._fronts().slice(-1);
    return last?.front?.state ?? null;
  }

  /** What is there of scenes to draw: that which fades, and the scene. Another one only if neither is there. */
  _fronts() {
    const { fading, _second: second, _main: main, _scene: scene } = this;
    const wanted = fading && second?.scene === fading.scene ? [second, main] : [main];
    const there = wanted.filter((drawable) => drawable.scene && (drawable === second || drawable.scene === scene));
    return there.length || !main.front ? there : [main];
  }

  /** Whether nothing is to be evaluated yet: the first picture does not wait for the second, and while the poster is held
   * what is there only makes the shaders ready. */
  _waits() {
    if (!this._front || this._shownLevel !== null) return false;
    const [front, next] = [this._front.scene, this._scene].map((scene) => this._consumed(/** @type {Scene} */ (scene)));
    return front > this._held || next <= this._held;
  }

  /** The state to show of a scene. @param {Scene} scene @returns {State} */
  _state(scene) {
    const camera = /** @type {Camera} */ (this.camera);
    const level = this._front ? (this._level ?? 2) : 0; // the first picture is the one that comes soonest
    return stateOf(scene, Math.max(level, 0), this.time, centreOf(camera));
  }

  _isEvaluated() {
    return this._states().every(([drawable, state]) => drawable.isEvaluated(state));
  }

  _isSorted() {
    return this._states().every(([drawable]) => drawable.isSorted(this._row()));
  }

  _isSettled() {
    const now = performance.now();
    return (
      !!this._front &&
      !this._dirty &&
      !this._drawing &&
      !this._drawables().some(({ evaluating, sorting }) => evaluating || sorting) &&
      this._isEvaluated() &&
      this._isSorted() &&
      !this._moving(now) &&
      !this._status.loading &&
      this._isSized(this._size(now))
    );
  }

  _row() {
    return /** @type {Camera} */ (this.camera).viewmat.slice(8, 12);
  }

  /** Brings a scene's Gaussians to a state. @param {Drawable} drawable @param {State} state */
  async _evaluate(drawable, state) {
    const { _gpu: gpu, _painter: painter } = this;
    try {
      if (!gpu || !painter) return;
      if (!(await drawable.evaluate(gpu, painter, state, () => this._row()))) return;
      this.counts.evaluated++;
      this._dirty = true;
    } catch (error) {
      this._fail(error);
      this._scene = null;
    } finally {
      this._wake();
    }
  }

  /** Brings a scene's order to the camera. @param {Drawable} drawable */
  async _sort(drawable) {
    const { _painter: painter } = this;
    if (!painter || !drawable.front || drawable.sorting || drawable.isSorted(this._row())) return;
    try {
      await drawable.sort(painter, this._row());
      this._dirty = true;
    } catch (error) {
      if (!this.closed) this._fail(error);
    } finally {
      this._wake();
    }
  }

  /** Width and height to draw, pixels. @param {number} now @returns {[number, number]} */
  _size(now) {
    const { clientWidth, clientHeight } = this.canvas;
    const ratio = this._options.pixelRatio ?? Math.min(devicePixelRatio, 2);
    const scale = ratio * (this._moving(now) ? this._scale() : 1);
    const most = this._gpu?.maxSide ?? 4096;
    /** @param {number} n */
    const side = (n) => Math.min(Math.max(Math.round(n * scale), 1), most);
    return [side(clientWidth), side(clientHeight)];
  }

  /** Whether the canvas has this size. @param {[number, number]} size */
  _isSized([width, height]) {
    return width === this.canvas.width && height === this.canvas.height;
  }

  /** Draws, and records when that is done. @param {[number, number]} size @param {State} state the one on show */
  async _show(size, state) {
    const gpu = /** @type {Gpu} */ (this._gpu);
    if (!this._isSized(size)) [this.canvas.width, this.canvas.height] = size;
    const opened = this._started;
    const started = performance.now();
    const alone = !this._drawables().some(({ evaluating }) => evaluating);
    const moving = this._moving(started);
    this._dirty = false;
    this._drawing = true;
    try {
      this._draw();
      await gpu.finished();
      if (this._isStale(gpu, opened)) return;
      const now = performance.now();
      this._draws.push(now);
      this.counts.drawn++;
      if (alone && moving) this._pace.drew(now - started);
      this._shown(state, now);
    } catch (error) {
      if (!this._isStale(gpu, opened)) this._fail(error);
    } finally {
      this._drawing = false;
      this._wake();
    }
  }

  /** Draws immediately. @param {(Camera & {x: number, y: number})[]} [eyes]
   * @param {import("./painter.js").Target} [target] @returns {State | null} the one on show, null without Gaussians */
  _draw(eyes, target) {
    const { camera, _painter: painter } = this;
    const scenes = this._fronts().flatMap(({ front, order }) => {
      if (!front || !order) return [];
      const { scene, level } = front.state;
      return [{ splats: front.splats, order, fill: levelOf(scene, level).fill, near: scene.info.near }];
    });
    if (!camera || !painter || !scenes.length) return null;
    const views = eyes ?? [fitted(camera, this.canvas.width, this.canvas.height, this.fit)];
    painter.draw(scenes, views, scenes.length > 1 ? 1 - (this.fading?.share ?? 0) : 0, target);
    return this._front;
  }

  /** A picture of a state is on the screen. @param {State} state @param {number} now */
  _shown({ scene, level }, now) {
    this._held = 0;
    this._begin();
    const before = this._shownLevel;
    const { rows } = levelOf(scene, level);
    const more = before !== null && (level > before || (level === before && rows > this._shownRows));
    this._shownLevel = level;
    this._shownRows = rows;
    const seconds = (now - this._started) / 1000;
    const told = { level, bytes: this._status.bytes, seconds, ...this._came.get(scene) };
    if (before === null) this._emit("firstpicture", told);
    else if (more) this._emit("upgrade", told);
  }
}
