// What the test of the adapter to Spark calls: `window.harness`. three.js and Spark come from the page's import map.

import { Pd4Splats, SPARK_SETTINGS } from "../spark.js";
import { cameraOf, load, pictureOf } from "./pictures.js";

const [THREE, spark] = await Promise.all(["three", "@sparkjsdev/spark"].map(load));

/** @type {any} */
let shown = null;
Object.assign(window, { harness: { open, shoot, close } });

/** A scene in Spark on a canvas of some size. @param {string} url @param {number} width @param {number} height */
async function open(url, width, height) {
  close();
  const renderer = new THREE.WebGLRenderer({ antialias: false, preserveDrawingBuffer: true });
  renderer.setPixelRatio(1);
  renderer.setSize(width, height);
  document.body.append(renderer.domElement);
  const splats = await Pd4Splats.open(url, { THREE, spark });
  const scene = new THREE.Scene();
  scene.background = splats.background;
  const sparkRenderer = new spark.SparkRenderer({ renderer, autoUpdate: false, ...SPARK_SETTINGS });
  scene.add(sparkRenderer, splats.mesh);
  shown = { renderer, scene, splats, sparkRenderer, camera: new THREE.PerspectiveCamera() };
  await new Promise((resolve) => splats.addEventListener("loaded", resolve));
}

/**
 * The picture as base64 of its RGBA bytes, once Spark has sorted what the mesh holds.
 *
 * @param {{level: number, seconds: number, viewmat: number[], K: number[], width: number, height: number}} state
 */
async function shoot({ level, seconds, ...view }) {
  const { renderer, scene, splats, sparkRenderer, camera } = shown;
  splats.level = level;
  splats.time = seconds;
  splats.lookThrough(camera, view.width, view.height, cameraOf(view));
  splats.update(camera);
  while (!splats.settled) await new Promise((resolve) => setTimeout(resolve, 5));
  scene.updateMatrixWorld();
  await sparkRenderer.update({ scene, camera }); // also their order, as nothing else asks for an update
  renderer.render(scene, camera);
  return pictureOf(renderer.domElement);
}

function close() {
  if (!shown) return;
  shown.splats.close();
  shown.renderer.dispose();
  shown.renderer.domElement.remove();
  shown = null;
}
