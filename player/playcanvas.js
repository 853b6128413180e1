// A script that plays a .pd4 in PlayCanvas (engine 2.23 or later) and in viewers that are made with it. The page's import
// map, or its bundler, says where "playcanvas" is.

import { BoundingBox, Color, Mat4, Script, Vec3 } from "playcanvas";
import { GSPLATDATA_LARGE, GSplatContainer, GSplatFormat, PIXELFORMAT_RGBA32F } from "playcanvas";

import { defaultCamera, fitted } from "./render/camera.js";
import { Playback, poseOf, takeCentres } from "./render/playback.js";
/** @import { AppBase, Asset, CameraComponent, Entity, Texture } from "playcanvas" */
/** @import { Camera } from "./decode/tensors.js" */
/** @import { Gaussians } from "./render/playback.js" */

/** Textures of floats, one for each array of Gaussians. */
const STREAMS = /** @type {const} */ (["means", "scales", "quaternions", "colors"]);
const READ_GLSL = `
vec3 getCenter() { return loadMeans().xyz; }
vec4 getColor() { return vec4(loadColors().rgb, loadMeans().a); }
vec3 getScale() { return loadScales().xyz; }
vec4 getRotation() { return loadQuaternions(); }`;
const READ_WGSL = `
fn getCenter() -> vec3f { return loadMeans().xyz; }
fn getColor() -> vec4f { return vec4f(loadColors().rgb, loadMeans().a); }
fn getScale() -> vec3f { return loadScales().xyz; }
fn getRotation() -> vec4f { return loadQuaternions(); }`;

/** The engine ends Gaussians at exp(−4), where they have faded to 0, and blurs them by 0.3 / 4 pixels². Here they end at
 * 1/255 and are blurred by 0.3, as clause 13.5 says: larger ones that fall faster. pd4Pixel: of a place in the world, a
 * pixel's side there. */
const REACH = Math.log(255) / 4;
const EXACT = {
  gsplatModifyVS: `
uniform vec4 pd4Pixel;
void modifySplatCenter(inout vec3 center) {}
void modifySplatRotationScale(vec3 before, vec3 center, inout vec4 rotation, inout vec3 scale) {
  float side = dot(pd4Pixel, vec4(center, 1.0));
  scale = sqrt(${REACH} * scale * scale + ${0.3 * REACH - 0.075} * side * side);
}
void modifySplatColor(vec3 center, inout vec4 color) {}`,
  gsplatModifyPS: `
void modifySplatColor(vec2 uv, inout vec4 color) {
  color.a = min(0.999, gaussianColor.a * pow(255.0, -dot(uv, uv)));
}`,
};

/** @param {AppBase} app */
function drawExactly({ scene: { gsplat } }) {
  gsplat.dataFormat = GSPLATDATA_LARGE;
  gsplat.minPixelSize = 0;
  gsplat.radialSorting = false;
  gsplat.useTonemap = false;
  for (const [name, code] of Object.entries(EXACT)) gsplat.material.getShaderChunks("glsl").set(name, code);
}

/**
 * Plays a scene on an entity, whose `gsplat` component it owns.
 *
 * Events: `ready` when `info` is there; `upgrade`, `loaded` and `error` as those of `Playback`.
 */
export class Pd4 extends Script {
  static scriptName = "pd4";

  /** Address of the scene. @attribute @type {string} */
  src = "";
  /** The scene, if it is not at an address. @attribute @type {Asset | null} @resource binary */
  asset = null;
  /** The camera that colours are seen from; default: the first one. @attribute @type {Entity | null} */
  camera = null;
  /** @attribute @type {boolean} */
  autoplay = true;
  /** @attribute @type {boolean} */
  loop = true;
  /** Seconds of the scene's time per second. @attribute @type {number} */
  speed = 1;
  /** The highest layer to load and show. @attribute @type {number} */
  maxLayer = 2;
  /** Whether all splats of the application are drawn as clause 13.5 of the format says, with WebGL2 and for one camera.
   * @attribute @type {boolean} */
  exact = false;

  /** @type {Playback | null} */
  _playback = null;
  /** @type {GSplatContainer | null} */
  _container = null;
  /** The camera whose background changes with the Gaussians. @type {CameraComponent | null} */
  _seenThrough = null;
  /** Whether the frame shows the newest Gaussians, null: no camera has drawn them. @type {boolean | null} */
  _current = null;
  /** Called when a frame shows the newest Gaussians. */
  _seen = () => {};

  initialize() {
    if (this.exact) drawExactly(this.app);
    const handles = [
      this.app.systems.gsplat?.on("frame:ready", (_camera, _layer, /** @type {boolean} */ ready) => {
        this._current = ready && this._current !== false;
      }),
      this.app.on("frameend", () => {
        if (this._current) this._seen();
        this._current = null;
      }),
    ];
    this.once("destroy", () => {
      for (const handle of handles) handle?.off();
      this._close();
    });
    if (this.asset || this.src) this.load();
  }

  /**
   * Loads a scene in place of the one on show, as far as `maxLayer`.
   *
   * @param {string | Blob} [source] default: the script's `asset` or `src`
   */
  async load(source = this.asset?.getFileUrl() ?? this.src) {
    this._close();
    const options = { level: this.maxLayer };
    const playback = new Playback(options, (gaussians) => this._fill(gaussians));
    this._playback = playback;
    for (const name of ["upgrade", "loaded", "error"]) {
      playback.addEventListener(name, (event) => this._tell(name, /** @type {CustomEvent} */ (event).detail));
    }
    try {
      await playback.load(source, options);
      if (this.autoplay) playback.play();
      this.fire("ready");
    } catch (error) {
      if (playback === this._playback) this._tell("error", error);
    }
  }

  /** What plays, null before `load`: `play()`, `pause()`, `paused`, `time`, `levels`, `settled`. */
  get playback() {
    return this._playback;
  }

  /** The scene's global properties (clause 5.1), null before `ready`. */
  get info() {
    return this._playback?.info ?? null;
  }

  /**
   * Gives a camera the pose, lens, depth range and background of a view, by default the scene's own.
   *
   * @param {Entity} entity with a camera @param {Camera} [view]
   */
  lookThrough(entity, view) {
    const { info, playback } = this;
    const { camera } = entity;
    if (!info || !playback || !camera) throw new Error("lookThrough: expected a loaded scene and an entity with a camera");
    const seen = view ?? defaultCamera(info);
    const world = this.entity.getWorldTransform();
    const pose = new Mat4().mul2(world, new Mat4().set(poseOf(seen)));
    const scale = world.getScale().x;
    entity.setPosition(pose.getTranslation());
    entity.setEulerAngles(pose.getEulerAngles());
    camera.nearClip = Math.max(info.near, 1e-6) * scale;
    camera.farClip = info.far * scale;
    this._seenThrough = camera;
    camera.clearColor = new Color(playback.fill);
    const { width, height } = this.app.graphicsDevice;
    camera.fov = (360 / Math.PI) * Math.atan(height / 2 / fitted(seen, width, height).K[4]);
  }

  /** @param {number} dt seconds */
  update(dt) {
    const camera = this.camera ?? this.app.systems.camera?.cameras[0]?.entity;
    const playback = this._playback;
    if (!playback?.info || !camera) return;
    const toScene = new Mat4().copy(this.entity.getWorldTransform()).invert();
    const { x, y, z } = toScene.transformPoint(camera.getPosition());
    playback.loop = this.loop;
    playback.level = this.maxLayer;
    playback.speed = this.speed;
    playback.advance(dt, [x, y, z]);
    if (this.exact && camera.camera) this._measurePixels(camera.camera);
  }

  /** @param {CameraComponent} camera */
  _measurePixels({ entity, projectionMatrix }) {
    const side = 2 / (projectionMatrix.data[5] * this.app.graphicsDevice.height);
    const { x, y, z } = entity.forward.mulScalar(side);
    const { material } = this.app.scene.gsplat;
    material.setParameter("pd4Pixel", [x, y, z, -entity.forward.mulScalar(side).dot(entity.getPosition())]);
    material.update();
  }

  /** Brings Gaussians onto the screen. @param {Gaussians & {fill: number[]}} gaussians @returns {Promise<void>} when a
   * frame shows them: the engine sorts them first, and reads their textures only then */
  _fill(gaussians) {
    const { count, means, changed } = gaussians;
    const had = this._container;
    const container = this._containerFor(count);
    STREAMS.forEach((name, i) => {
      if (container === had && !changed[i]) return;
      const texture = /** @type {Texture} */ (container.getTexture(name));
      texture.lock().set(gaussians[name]);
      texture.unlock();
    });
    const { low, high } = takeCentres(means, count, container.centers);
    if (count) container.aabb.setMinMax(new Vec3(low), new Vec3(high));
    container.update(count);
    if (this._seenThrough) this._seenThrough.clearColor = new Color(gaussians.fill);
    this.app.renderNextFrame = true;
    return new Promise((resolve) => (this._seen = resolve));
  }

  /** The container, or a larger one that takes its place. @param {number} count */
  _containerFor(count) {
    const had = this._container;
    if (had && had.maxSplats >= count) return had;
    const device = this.app.graphicsDevice;
    const streams = STREAMS.map((name) => ({ name, format: PIXELFORMAT_RGBA32F }));
    const format = new GSplatFormat(device, streams, { readGLSL: READ_GLSL, readWGSL: READ_WGSL });
    const container = new GSplatContainer(device, Math.max(Math.ceil(1.25 * count), 1), format);
    container.aabb = new BoundingBox();
    const component = this.entity.gsplat ?? this.entity.addComponent("gsplat");
    /** @type {any} */ (component).resource = container;
    had?.destroy();
    this._container = container;
    return container;
  }

  /** @param {string} name @param {any} detail */
  _tell(name, detail) {
    if (name === "error" && !this.hasEvent("error")) console.error(`pd4: ${detail.message}`);
    this.fire(name, detail);
  }

  _close() {
    this._playback?.close();
    this._playback = null;
    if (this._container) this.entity.removeComponent("gsplat");
    this._container?.destroy();
    this._container = null;
  }
}
