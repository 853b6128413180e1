// What the test of the PlayCanvas script calls: `window.harness`. The engine comes from the page's import map.

import * as pc from "playcanvas";

import { Pd4 } from "../playcanvas.js";
import { cameraOf, pictureOf } from "./pictures.js";

/** app, camera, script, canvas: while a scene is open. @type {any} */
const harness = { open, shoot, close };
Object.assign(window, { harness });

/** A scene in PlayCanvas on a canvas of some size. @param {string} url @param {number} width @param {number} height */
async function open(url, width, height) {
  close();
  const canvas = document.createElement("canvas");
  document.body.append(canvas);
  const graphicsDevice = await pc.createGraphicsDevice(canvas, { deviceTypes: ["webgl2"], antialias: false });
  graphicsDevice.maxPixelRatio = 1;
  const options = new pc.AppOptions();
  options.graphicsDevice = graphicsDevice;
  options.componentSystems = [pc.CameraComponentSystem, pc.GSplatComponentSystem, pc.ScriptComponentSystem];
  const app = new pc.AppBase(canvas);
  app.init(options);
  app.setCanvasFillMode(pc.FILLMODE_NONE, width, height);
  app.setCanvasResolution(pc.RESOLUTION_FIXED, width, height);
  app.start();
  const camera = new pc.Entity("camera", app);
  camera.addComponent("camera");
  const entity = new pc.Entity("scene", app);
  entity.setLocalPosition(1, 2, 3); // pictures do not depend on where the scene stands
  entity.setLocalEulerAngles(0, 0, 180);
  entity.setLocalScale(2, 2, 2);
  app.root.addChild(camera);
  app.root.addChild(entity);
  entity.addComponent("script");
  const script = /** @type {Pd4} */ (entity.script?.create(Pd4, { properties: { src: url, autoplay: false, exact: true } }));
  Object.assign(harness, { app, camera, script, canvas });
  await new Promise((resolve, reject) => {
    script.on("loaded", resolve);
    script.on("error", reject);
  });
}

/**
 * The picture as base64 of its RGBA bytes, once the engine has sorted the Gaussians of a state.
 *
 * @param {{level: number, seconds: number, viewmat: number[], K: number[], width: number, height: number}} state
 */
async function shoot({ level, seconds, ...view }) {
  const { app, camera, script, canvas } = harness;
  script.maxLayer = level;
  script.playback.time = seconds;
  script.lookThrough(camera, cameraOf(view));
  const frame = () => new Promise((resolve) => app.once("frameend", resolve));
  let sorted = false;
  const handle = app.scene.on("gsplat:sorted", () => (sorted = true));
  for (let still = 0; still < 5; still = sorted ? 0 : still + 1) {
    sorted = !script.playback.settled;
    await frame();
  }
  handle.off();
  return new Promise((resolve) => app.once("frameend", () => resolve(pictureOf(canvas))));
}

function close() {
  harness.app?.destroy();
  harness.canvas?.remove();
  harness.app = harness.canvas = harness.script = null;
}
