// Decodes files as a line on stdin names them, and answers with a line of JSON each: for programs that compare.
//
//     {"time": FILE}          -> {"wall", "cpu"}, seconds of decoding it once, the file being read before
//     {"hashes": BASE64}      -> {"hashes": [...]} or {"error": kind, "message", "offset", "chunk"}
//
// An exception that is no DecodeError ends in {"crash": stack}.

import { readFileSync } from "node:fs";
import { createInterface } from "node:readline";

import { DecodeError, decode, hashes } from "../decode/index.js";

/** @type {Map<string, Uint8Array>} */
const files = new Map();

/** @param {string} path */
function time(path) {
  const bytes = files.get(path) ?? readFileSync(path);
  files.set(path, bytes);
  const cpu = process.cpuUsage();
  const wall = performance.now();
  decode(bytes);
  const used = process.cpuUsage(cpu);
  return { wall: (performance.now() - wall) / 1000, cpu: (used.user + used.system) / 1e6 };
}

for await (const line of createInterface({ input: process.stdin })) {
  const asked = JSON.parse(line);
  let answer;
  try {
    answer = asked.time ? time(asked.time) : { hashes: hashes(Buffer.from(asked.hashes, "base64")) };
  } catch (error) {
    if (error instanceof DecodeError) {
      const { kind, message, offset, chunk } = error;
      answer = { error: kind, message, offset, chunk };
    } else answer = { crash: error instanceof Error ? error.stack : String(error) };
  }
  process.stdout.write(JSON.stringify(answer) + "\n");
}
