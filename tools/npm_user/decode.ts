import { readFileSync } from "node:fs";
import { DecodeError, decode, openStream, type Scene } from "pd4-player/decode";

const bytes: Uint8Array = readFileSync(process.argv[2]);
const scene: Scene = decode(bytes, { maxLayer: 1 });
const anchors: Float32Array = scene.anchor;
const levels = openStream().feed(bytes).length;
let refused = "";
try {
  decode(bytes.subarray(0, 100));
} catch (error) {
  if (error instanceof DecodeError) refused = error.kind;
}
console.log(JSON.stringify({ layers: scene.layers, anchors: anchors.length / 3, levels, refused }));
