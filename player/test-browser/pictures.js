// What the harnesses share.

/** RGBA bytes as base64. @param {Uint8Array | Uint8ClampedArray} data @returns {string} */
export function base64(data) {
  let text = "";
  for (let i = 0; i < data.length; i += 8192) text += String.fromCharCode(...data.subarray(i, i + 8192));
  return btoa(text);
}
