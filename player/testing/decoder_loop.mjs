// Decodes the file that each line on stdin holds as base64, for programs that compare, and answers with a line of JSON:
// {"hashes": [...]}, {"error": kind, "message", "offset", "chunk"}, or {"crash": stack} of any other exception.

import { createInterface } from "node:readline";

import { DecodeError, hashes } from "../decode/index.js";

for await (const line of createInterface({ input: process.stdin })) {
  let answer;
  try {
    answer = { hashes: hashes(Buffer.from(line, "base64")) };
  } catch (error) {
    if (error instanceof DecodeError) {
      const { kind, message, offset, chunk } = error;
      answer = { error: kind, message, offset, chunk };
    } else answer = { crash: error instanceof Error ? error.stack : String(error) };
  }
  process.stdout.write(JSON.stringify(answer) + "\n");
}
