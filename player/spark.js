// A mesh that plays a .pd4 in Spark (sparkjs.dev), a splat renderer for three.js. The page imports both and passes them
// in.
//
// three.js owns the drawing context, so Gaussians are evaluated in a worker and handed over as Spark's ExtSplats.

import { centreOf, defaultCamera, fitted, unit } from "./render/camera.js";
import { startWorker } from "./render/cpu.js";
import { levelOf, sameState, stateOf, timeAfter } from "./render/level.js";
import { Emitter, startLoader } from "./render/loader.js";
/** @import { Camera, Scene } from "./decode/scene.js" */
/** @import { State } from "./render/level.js" */

/**
 * The parts of three.js (r180 or later) and of Spark (2.2 or later) in use.
 *
 * @typedef {Record<"Vector3" | "Quaternion" | "Color" | "Matrix4", new (...args: any[]) => any>
 *   & {SRGBColorSpace: string}} Three
 * @typedef {Record<"SplatMesh" | "ExtSplats", new (options?: any) => any>} Spark
 */

/**
 * @typedef {object} SplatsOptions
 * @property {Three} THREE
 * @property {Spark} spark
 * @property {number} [level] the highest to load, default all
 * @property {number} [time] seconds of the scene's time to start at
 * @property {number} [bytes] how much of the file to load at most
 * @property {number} [seconds] how long to load beyond the first layer
 * @property {boolean} [loop] whether playing begins anew at the end, default true
 */

/**
 * Options of a SparkRenderer that draws as clause 13.5 of the format says: its blur, its cut at 1/255, its order. Spark
 * does not clamp slopes beyond the picture but leaves out Gaussians whose centres are far outside, however large.
 */
export const SPARK_SETTINGS = {
  preBlurAmount: 0.3,
  blurAmount: 0,
  maxStdDev: Math.sqrt(2 * Math.log(255)),
  minAlpha: 1 / 255,
  maxPixelRadius: 8192,
  sortRadial: false,
  accumExtSplats: true,
};

/**
 * A scene as a mesh. Add `mesh` to a three.js scene, and call `update` before each frame.
 *
 * Events: `upgrade` {level, anchors, gaussians} when a higher level, or more anchors of it, is in the mesh;
 * `loaded` {bytes, complete}; `error` {message, kind}, after which what was valid stays.
 */
export class Pd4Splats extends Emitter {
  /**
   * Begins to load.
   *
   * @param {string | URL | Blob} source @param {SplatsOptions} options
   * @returns {Promise<Pd4Splats>} as soon as the first layer, or slice of it, is there
   * @throws {Error} with `kind`, a name of clause 15 or FetchError, if it never is
   */
  static open(source, options) {
    return new Promise((resolve, reject) => {
      const splats = new Pd4Splats(options, () => resolve(splats));
      splats._load(source, options).catch((error) => {
        if (splats._scene) splats._fail(error);
        else {
          splats.close();
          reject(error);
        }
      });
    });
  }

  /** @param {SplatsOptions} options @param {() => void} begun is called when there is a scene */
  constructor({ THREE, spark, time, loop = true }, begun) {
    super();
    this._three = THREE;
    this._begun = begun;
    this._splats = new spark.ExtSplats();
    /** A SplatMesh of Spark. */
    this.mesh = new spark.SplatMesh({ extSplats: this._splats });
    /** The highest level to show of what is loaded, null: all. @type {number | null} */
    this.level = null;
    /** Whether playing begins anew at the end. */
    this.loop = loop;
    /** @type {Scene | null} */
    this._scene = null;
    this._time = time;
    this._playing = false;
    this._lastFrame = 0;
    this._loader = startLoader((news) => this._told(news));
    this._evaluator = startWorker();
    /** What the evaluator has. @type {Scene | null} */
    this._evaluatorScene = null;
    /** @type {State | null} */
    this._wanted = null;
    /** What the mesh holds. @type {State | null} */
    this._shown = null;
    this._evaluating = false;
    this._closed = false;
  }

  /** @param {string | URL | Blob} source @param {SplatsOptions} options */
  async _load(source, { level, bytes, seconds }) {
    const from = source instanceof Blob ? source : new URL(source, document.baseURI).href;
    await this._loader.call("open", [from]);
    const result = await this._loader.call("load", [{ maxLayer: level ?? Infinity, bytes, seconds }]);
    this._loader.close();
    this._emit("loaded", result);
  }

  /** @param {import("./render/loader-worker.js").News} news */
  _told({ scene }) {
    if (!scene) return;
    this._scene = scene;
    this.time = this.time; // into the scene's range
    this._begun();
  }

  /** The scene's global properties (clause 5.1). */
  get info() {
    return this._sceneThere().info;
  }

  /** The layers that have arrived. */
  get levels() {
    return this._sceneThere().layers;
  }

  /** The colour behind the scene, for `scene.background`. */
  get background() {
    return new this._three.Color().setRGB(...this.info.background, this._three.SRGBColorSpace);
  }

  /** Seconds of the scene's time. */
  get time() {
    return this._time ?? this.info.timeRange[0];
  }

  set time(seconds) {
    const [start, end] = this.info.timeRange;
    this._time = Math.min(Math.max(seconds, start), Math.max(start, end));
  }

  get paused() {
    return !this._playing;
  }

  play() {
    if (this.time >= this.info.timeRange[1]) this.time = this.info.timeRange[0];
    this._lastFrame = 0;
    this._playing = true;
  }

  pause() {
    this._playing = false;
  }

  /**
   * Gives a camera the pose, lens and depth range of a view, by default the scene's own. The camera has no parent.
   *
   * @param {any} camera a PerspectiveCamera @param {number} width @param {number} height of what is drawn, pixels
   * @param {Camera} [view]
   */
  lookThrough(camera, width, height, view = defaultCamera(this.info)) {
    const { near, far, up } = this.info;
    const { viewmat: v, K } = fitted(view, width, height);
    const [x, y, z] = centreOf(view);
    const scale = new this._three.Vector3();
    this.mesh.updateWorldMatrix(true, false);
    // rows of the view matrix are the camera's axes; those of three.js point up and backwards
    new this._three.Matrix4()
      .set(v[0], -v[4], -v[8], x, v[1], -v[5], -v[9], y, v[2], -v[6], -v[10], z, 0, 0, 0, 1)
      .premultiply(this.mesh.matrixWorld)
      .decompose(camera.position, camera.quaternion, scale);
    camera.up.set(...unit(up, [0, 1, 0])).transformDirection(this.mesh.matrixWorld);
    camera.near = Math.max(near, 1e-6) * scale.x;
    camera.far = far * scale.x;
    camera.fov = (360 / Math.PI) * Math.atan(height / 2 / K[4]);
    camera.aspect = (width * K[4]) / (height * K[0]);
    camera.updateProjectionMatrix();
    camera.projectionMatrix.elements[8] = 1 - (2 * K[2]) / width;
    camera.projectionMatrix.elements[9] = (2 * K[5]) / height - 1;
    camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  }

  /**
   * Advances time while playing, and updates the mesh to time, level and camera as soon as they are evaluated. A slow
   * evaluation skips frames, not time.
   *
   * @param {any} camera that the scene is seen through
   */
  update(camera) {
    const scene = this._sceneThere();
    const now = performance.now();
    if (this._playing) {
      const elapsed = this._lastFrame ? (now - this._lastFrame) / 1000 : 0;
      const { time, ended } = timeAfter(this.time, elapsed, scene.info.timeRange, this.loop);
      this._time = time;
      this._playing = !ended;
    }
    this._lastFrame = now;
    this.mesh.updateWorldMatrix(true, false);
    camera.updateWorldMatrix(true, false);
    const toMesh = new this._three.Matrix4().copy(this.mesh.matrixWorld).invert();
    const eye = new this._three.Vector3().setFromMatrixPosition(camera.matrixWorld).applyMatrix4(toMesh);
    this._wanted = stateOf(scene, Math.max(this.level ?? Infinity, 0), this.time, [eye.x, eye.y, eye.z]);
    this._evaluate();
  }

  /** Whether the mesh shows the state of the last `update`. */
  get settled() {
    return !!this._wanted && !!this._shown && sameState(this._shown, this._wanted);
  }

  /** Ends the workers and frees the mesh, which the page takes out of its scene. */
  close() {
    if (this._closed) return;
    this._closed = true;
    this._loader.close();
    this._evaluator.close();
    this.mesh.dispose();
    this._scene = this._evaluatorScene = this._wanted = this._shown = null;
  }

  _sceneThere() {
    if (!this._scene) throw new Error("the scene is closed");
    return this._scene;
  }

  /** Evaluates until the mesh shows the wanted state; intermediate ones are skipped. */
  async _evaluate() {
    if (this._evaluating) return;
    this._evaluating = true;
    try {
      while (this._wanted && !this.settled) {
        const state = this._wanted;
        if (state.scene !== this._evaluatorScene) await this._evaluator.call("setScene", [state.scene]);
        this._evaluatorScene = state.scene;
        const packed = await this._evaluator.call("evaluate", [state.level, state.t, state.eye]);
        if (this._closed) return;
        this._fill(packed);
        this._tell(state);
        this._shown = state;
      }
      this._evaluating = false;
    } catch (error) {
      if (!this._closed) this._fail(error); // and nothing is evaluated any more
    }
  }

  /** Brings Gaussians into the mesh. @param {import("./render/cpu.js").Packed} packed */
  _fill({ data, width, height }) {
    const { Vector3, Quaternion, Color } = this._three;
    const [centre, scales, quaternion, color] = [new Vector3(), new Vector3(), new Quaternion(), new Color()];
    const splats = this._splats;
    const [before] = splats.extArrays;
    const block = 4 * width * height;
    let count = 0;
    splats.ensureSplats(width * height); // Spark pads to whole rows of its textures, 2,048 splats each
    splats.numSplats = 0;
    for (let at = 0; at < block; at += 4) {
      const opacity = data[at + 3];
      if (!(opacity > 0)) continue;
      centre.fromArray(data, at);
      scales.fromArray(data, block + at);
      const [w, x, y, z] = data.subarray(2 * block + at, 2 * block + at + 4);
      quaternion.set(x, y, z, w);
      color.fromArray(data, 3 * block + at);
      const sum = centre.x + centre.y + centre.z + scales.x + scales.y + scales.z + w + x + y + z;
      if (!Number.isFinite(sum + color.r + color.g + color.b)) continue;
      splats.setSplat(count++, centre, scales, quaternion, opacity, color);
    }
    const { extArrays } = splats;
    if (extArrays[0] === before) for (const texture of splats.textures) texture.needsUpdate = true;
    else splats.reinitialize({ extArrays, numSplats: count });
    // Gaussians are others than before, so that their old order is of no use: Spark shows them when they are sorted
    this.mesh.updateMappingVersion();
  }

  /** @param {State} state which the mesh now holds */
  _tell({ scene, level }) {
    const had = this._shown;
    const { rows: anchors } = levelOf(scene, level);
    if (had && level <= had.level && anchors <= levelOf(had.scene, had.level).rows) return;
    this._emit("upgrade", { level, anchors, gaussians: this._splats.numSplats });
  }
}
