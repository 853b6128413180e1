// Decodes the file that each line on stdin holds as base64, and its base behind a space if it has one, for programs that
// compare, and answers with a line of JSON:
// {"hashes": [...], "scene": null} where tensors and scene decode, with "scene": {"error": kind, "message", "offset",
// "chunk"} where the tensors alone do; else {"error": kind, ...}, or {"crash": stack} of any other exception.

import { createInterface } from "node:readline";

import { DecodeError, decode, hashes } from "../decode/index.js";

/** The fault of a function as the answer has it, or null. @param {() => void} run */
function faultOf(run) {
  try {
    run();
  } catch (error) {
    if (!(error instanceof DecodeError)) throw error;
    const { kind, message, offset, chunk } = error;
    return { error: kind, message, offset, chunk };
  }
  return null;
}

for await (const line of createInterface({ input: process.stdin })) {
  const [bytes, base] = line.split(" ").map((part) => Buffer.from(part, "base64"));
  let answer;
  try {
    /** @type {object} */
    let found = {};
    answer = faultOf(() => (found = { hashes: hashes(bytes, { base }) })) ?? { ...found, scene: faultOf(() => decode(bytes, { base })) };
  } catch (error) {
    answer = { crash: error instanceof Error ? error.stack : String(error) };
  }
  process.stdout.write(JSON.stringify(answer) + "\n");
}
