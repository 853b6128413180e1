// What the harnesses share.

/** A package that TypeScript need not find. @param {string} name */
export const load = (name) => import(name);

/** A camera from a message. @param {{viewmat: number[], K: number[], width: number, height: number}} of */
export function cameraOf({ viewmat, K, width, height }) {
  return { viewmat: new Float32Array(viewmat), K: new Float32Array(K), width, height };
}

/** What a canvas shows, as base64 of its RGBA bytes: in the task that draws it. @param {HTMLCanvasElement} canvas */
export function pictureOf(canvas) {
  const picture = new OffscreenCanvas(canvas.width, canvas.height).getContext("2d");
  if (!picture) throw new Error("no 2D context");
  picture.drawImage(canvas, 0, 0);
  return base64(picture.getImageData(0, 0, canvas.width, canvas.height).data);
}

/** RGBA bytes as base64. @param {Uint8Array | Uint8ClampedArray} data @returns {string} */
export function base64(data) {
  let text = "";
  for (let i = 0; i < data.length; i += 8192) text += String.fromCharCode(...data.subarray(i, i + 8192));
  return btoa(text);
}
