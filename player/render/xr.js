// A player in a headset (WebXR): a picture for each eye, of Gaussians that are evaluated and sorted for the head.

import { centreOf, dot, forwardOf, lookAlong, middleOf, plus, unit } from "./camera.js";
/** @import { Camera, Info } from "../decode/tensors.js" */
/** @import { Player } from "./player.js" */

/** Metres from the head to the middle of a scene whose unit is unknown. */
const DISTANCE = 2;
/** Signs of axes that point right, up and backwards, along ours. */
const SIGNS = [1, -1, -1];

/** The device API, which TypeScript does not know. */
const { xr } = /** @type {any} */ (globalThis.navigator ?? {});

/** Whether there is a headset. */
export async function hasHeadset() {
  try {
    return !!(await xr?.isSessionSupported("immersive-vr"));
  } catch {
    return false; // a page may forbid it
  }
}

/**
 * Shows a scene in the headset, from where the player's camera is, until the session ends. The trigger plays and pauses.
 *
 * @param {Player} player
 */
export async function enterVr(player) {
  const session = await xr.requestSession("immersive-vr");
  try {
    await show(player, session);
  } catch (error) {
    session.end(); // else the headset stays dark
    throw error;
  }
}

/** @param {Player} player @param {any} session XRSession */
async function show(player, session) {
  const gl = /** @type {any} */ (player.canvas.getContext("webgl2"));
  await gl.makeXRCompatible();
  const { XRWebGLLayer } = /** @type {any} */ (globalThis);
  const layer = new XRWebGLLayer(session, gl, { alpha: false, antialias: false, depth: false });
  session.updateRenderState({ baseLayer: layer });
  const space = await session.requestReferenceSpace("local");
  session.addEventListener("select", () => (player.paused ? player.play() : player.pause()));
  session.addEventListener("end", () => player.release());
  /** Where the head is when it comes on, and metres per scene unit. @type {[Camera, number] | null} */
  let start = null;
  session.requestAnimationFrame(function draw(/** @type {number} */ now, /** @type {any} */ frame) {
    if (player.closed) session.end();
    else session.requestAnimationFrame(draw);
    const pose = frame.getViewerPose(space);
    const { camera, info } = player;
    if (!pose || !camera || !info) return;
    start ??= standing(camera, info);
    const [from, metres] = start;
    const head = { ...from, viewmat: viewOf(pose.transform, from, metres) };
    const eyes = pose.views.map((/** @type {any} */ view) => ({
      ...lensOf(view.projectionMatrix, layer.getViewport(view)),
      viewmat: viewOf(view.transform, from, metres),
    }));
    player.present(now, head, eyes, layer);
  });
}

/** @param {Camera} camera @param {Info} info @returns {[Camera, number]} the camera with its horizon level, and metres
 * per scene unit */
function standing(camera, info) {
  const { up, unit: metres } = info;
  const eye = centreOf(camera);
  const scale = metres || DISTANCE / (Math.hypot(...plus(middleOf(info), eye, -1)) || 1);
  const upward = unit(up, [0, 0, 0]);
  const ahead = plus(forwardOf(camera), upward, -dot(forwardOf(camera), upward));
  const steep = !Math.hypot(...upward) || Math.hypot(...ahead) < 0.1;
  return [steep ? camera : lookAlong(eye, unit(ahead), plus([0, 0, 0], upward, -1), camera), scale];
}

/** The view matrix of a pose relative to a camera. @param {any} transform XRRigidTransform, metres
 * @param {Camera} camera @param {number} metres per scene unit */
function viewOf({ inverse: { matrix: m } }, { viewmat: v }, metres) {
  const out = new Float32Array(16);
  for (let i = 0; i < 12; i++) {
    const [row, column] = [i >> 2, i & 3];
    if (column === 3) out[i] = (SIGNS[row] * m[12 + row]) / metres;
    for (let k = 0; k < 3; k++) out[i] += SIGNS[row] * SIGNS[k] * m[4 * k + row] * v[4 * k + column];
  }
  out[15] = 1;
  return out;
}

/** @param {Float32Array} P projection, column-major @param {{x: number, y: number, width: number, height: number}} area
 * of an eye in the picture, pixels */
function lensOf(P, { x, y, width, height }) {
  const [w, h] = [width / 2, height / 2];
  return { K: new Float32Array([w * P[0], 0, w - w * P[8], 0, h * P[5], h + h * P[9], 0, 0, 1]), x, y, width, height };
}
