// What the test of SuperSplat's viewer calls: `window.harness`. It and its engine come from the page's import map.

import { Entity, Mat4 } from "playcanvas";

import { Pd4 } from "../playcanvas.js";
import { load } from "./pictures.js";

const [{ createViewer }, { defaultSettings }] = await Promise.all(
  ["viewer", "settings"].map((name) => load(`@playcanvas/supersplat-viewer/${name}.js`)),
);

/** @type {any} */
let shown = null;
Object.assign(window, { harness: { open, show, close } });

/**
 * A scene in the viewer, in place of a still one. Time stands still.
 *
 * @param {string} url @param {number} width @param {number} height
 * @param {{still: string, fov: number, background: number[], position: number[], target: number[], angles: number[],
 * ui: boolean}} options fov: degrees, of the longer side. angles: degrees, from the scene to the viewer's y-up world. ui:
 * whether the viewer's controls are there
 */
async function open(url, width, height, { still, fov, background, position, target, angles, ui }) {
  const container = document.createElement("div");
  Object.assign(container.style, { width: `${width}px`, height: `${height}px` });
  document.body.append(container);
  const style = Object.assign(document.createElement("link"), {
    ...{ rel: "stylesheet", href: import.meta.resolve("@playcanvas/supersplat-viewer/viewer.css") },
  });
  document.head.append(style);
  await new Promise((resolve) => (style.onload = resolve));
  localStorage.setItem("controlsPanelOpen", "false"); // which hides the scene
  const settings = defaultSettings("object");
  Object.assign(settings, { tonemapping: "none", background: { color: background } });
  settings.cameras = [{ initial: { position, target, fov } }];
  const viewer = await createViewer({
    ...{ container, settings, contentUrl: still, renderer: "webgl", ui, noanim: true, nofx: true },
  });
  const { app, events, state } = viewer;
  if (!state.loaded) await new Promise((resolve) => events.once("loaded:changed", resolve));
  state.cameraMode = "orbit"; // else it flies around
  viewer.resetCamera();
  const entity = new Entity("moving", app);
  entity.setLocalEulerAngles(angles[0], angles[1], angles[2]);
  app.root.addChild(entity);
  entity.addComponent("script");
  const properties = { src: url, autoplay: false, exact: true };
  const script = /** @type {Pd4} */ (entity.script?.create(Pd4, { properties }));
  script.once("upgrade", () => (app.root.findByName("gsplat").enabled = false));
  shown = { viewer, script, container };
  await new Promise((resolve, reject) => {
    script.on("loaded", resolve);
    script.on("error", reject);
  });
}

/**
 * Shows a state, until the viewer has nothing more to draw.
 *
 * @param {{level: number, seconds: number}} state
 * @returns {Promise<{pose: number[], focal: number}>} camera to scene, column-major; focal length, pixels
 */
async function show({ level, seconds }) {
  const { viewer, script } = shown;
  script.maxLayer = level;
  script.playback.time = seconds;
  let drawn = 0;
  const handle = viewer.app.on("postrender", () => drawn++);
  for (let before = -1; before !== drawn || !script.playback.settled; ) {
    before = drawn;
    await new Promise((resolve) => setTimeout(resolve, 200));
  }
  handle.off();
  const { entity, projectionMatrix } = viewer.app.systems.camera.cameras[0];
  const toScene = new Mat4().copy(script.entity.getWorldTransform()).invert();
  return {
    pose: [...toScene.mul(entity.getWorldTransform()).data],
    focal: (projectionMatrix.data[5] * viewer.app.graphicsDevice.height) / 2,
  };
}

function close() {
  shown?.viewer.destroy();
  shown?.container.remove();
  shown = null;
}
