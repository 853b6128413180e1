// A mesh that plays a .pd4 in Spark (sparkjs.dev), a splat renderer for three.js. The page imports both and passes them
// in.

import { defaultCamera, fitted, unit } from "./render/camera.js";
import { packed } from "./render/ext-splats.js";
import { Playback, poseOf } from "./render/playback.js";
/** @import { Camera } from "./decode/tensors.js" */
/** @import { Packed } from "./render/ext-splats.js" */
/** @import { Gaussians, PlaybackOptions } from "./render/playback.js" */

/**
 * The parts of three.js (r180 or later) and of Spark (2.2 or later) in use.
 *
 * @typedef {Record<"Vector3" | "Quaternion" | "Color" | "Matrix4", new (...args: any[]) => any>
 *   & {SRGBColorSpace: string}} Three
 * @typedef {Record<"SplatMesh" | "ExtSplats", new (options?: any) => any>} Spark
 * @typedef {PlaybackOptions & {THREE: Three, spark: Spark}} SplatsOptions
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

/** A scene as a mesh. Add `mesh` to a three.js scene, and call `update` before each frame.
 * @extends {Playback<Packed | Gaussians>} */
export class Pd4Splats extends Playback {
  /**
   * Begins to load.
   *
   * @param {string | URL | Blob} source @param {SplatsOptions} options
   * @returns {Promise<Pd4Splats>} as `load`
   */
  static open(source, options) {
    return new Pd4Splats(options).load(source, options);
  }

  /** @param {SplatsOptions} options */
  constructor(options) {
    super(options, (gaussians) => this._fillMesh(gaussians));
    const { THREE, spark } = options;
    this._three = THREE;
    this._splats = new spark.ExtSplats();
    /** Whether the worker packs Gaussians. */
    this._packs = storesPacked(spark);
    /** A SplatMesh of Spark. */
    this.mesh = new spark.SplatMesh({ extSplats: this._splats });
    this._background = new THREE.Color();
    this._lastFrame = performance.now();
  }

  /** The scene's global properties (clause 5.1). */
  get info() {
    return this._sceneThere().info;
  }

  /** The colour behind the Gaussians, for `scene.background`: one object, which changes with them. */
  get background() {
    return this._background.setRGB(...this.fill, this._three.SRGBColorSpace);
  }

  /**
   * Gives a camera the pose, lens and depth range of a view, by default the scene's own. The camera has no parent.
   *
   * @param {any} camera a PerspectiveCamera @param {number} width @param {number} height of what is drawn, pixels
   * @param {Camera} [view]
   */
  lookThrough(camera, width, height, view = defaultCamera(this.info)) {
    const { near, far, up } = this.info;
    const { K } = fitted(view, width, height);
    const scale = new this._three.Vector3();
    this.mesh.updateWorldMatrix(true, false);
    new this._three.Matrix4()
      .fromArray(poseOf(view))
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

  /** Brings time and camera to the mesh, as `advance`. @param {any} camera that the scene is seen through */
  update(camera) {
    const now = performance.now();
    const elapsed = (now - this._lastFrame) / 1000;
    this._lastFrame = now;
    this.mesh.updateWorldMatrix(true, false);
    camera.updateWorldMatrix(true, false);
    const toMesh = new this._three.Matrix4().copy(this.mesh.matrixWorld).invert();
    const eye = new this._three.Vector3().setFromMatrixPosition(camera.matrixWorld).applyMatrix4(toMesh);
    this.advance(elapsed, [eye.x, eye.y, eye.z]);
  }

  /** Ends the workers and frees the mesh, which the page takes out of its scene. */
  close() {
    if (!this.closed) this.mesh.dispose();
    super.close();
  }

  /** @param {import("./render/level.js").State} state */
  _gaussians(state) {
    return this._packs ? this._evaluator.pack(state) : super._gaussians(state);
  }

  /** @param {(Packed | Gaussians) & {fill: number[]}} gaussians */
  _fillMesh({ fill, ...gaussians }) {
    this._background.setRGB(...fill, this._three.SRGBColorSpace);
    if ("extArrays" in gaussians) {
      const { extArrays, count } = gaussians;
      const splats = this._splats;
      splats.reinitialize({ extArrays, numSplats: count });
      // Spark 2.2 gives a texture of unchanged size its new array as bytes: WebGL refuses them for 32-bit numbers
      for (const [i, { image }] of splats.textures.entries()) image.data = extArrays[i];
    } else this._setSplats(gaussians);
    // Gaussians are others than before, so that their old order is of no use: Spark shows them when they are sorted
    this.mesh.updateMappingVersion();
  }

  /** Has Spark store Gaussians, which takes the page's time. @param {Gaussians} gaussians */
  _setSplats({ count, means, scales, quaternions, colors }) {
    const { Vector3, Quaternion, Color } = this._three;
    const [centre, size, quaternion, color] = [new Vector3(), new Vector3(), new Quaternion(), new Color()];
    const splats = this._splats;
    const [before] = splats.extArrays;
    splats.ensureSplats(count); // Spark pads to whole rows of its textures, 2,048 splats each
    splats.numSplats = 0;
    for (let i = 0, at = 0; i < count; i++, at += 4) {
      centre.fromArray(means, at);
      size.fromArray(scales, at);
      quaternion.set(quaternions[at + 1], quaternions[at + 2], quaternions[at + 3], quaternions[at]);
      color.fromArray(colors, at);
      splats.setSplat(i, centre, size, quaternion, means[at + 3], color);
    }
    const { extArrays } = splats;
    if (extArrays[0] === before) for (const texture of splats.textures) texture.needsUpdate = true;
    else splats.reinitialize({ extArrays, numSplats: count });
  }
}

/** A Gaussian as a texel of each block: mean and opacity, scales, quaternion, colour. */
const PROBE = [1, -2, 3, 0.5, 0.5, 2, 8, 0, 0.5, 0.1, -0.5, 0.7, 0.25, 0.5, 0.75, 0];

/** Whether this version of Spark stores splats as `packed` does. @param {Spark} spark */
function storesPacked({ ExtSplats }) {
  const data = Float32Array.from(PROBE);
  const { extArrays } = packed({ count: 1, data, width: 1, height: 1, still: 0, changing: [] });
  try {
    const { center, scales, quaternion: q, opacity, color } = new ExtSplats({ extArrays, numSplats: 1 }).getSplat(0);
    const turned = [q.w, q.x, q.y, q.z];
    const found = [center.x, center.y, center.z, opacity, scales.x, scales.y, scales.z, 0, ...turned, color.r, color.g, color.b];
    return found.every((value, i) => Math.abs(value - PROBE[i]) < 0.01);
  } catch {
    return false;
  }
}
