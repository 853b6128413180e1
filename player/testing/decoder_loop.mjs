// Decodes the file that each line on stdin holds, and answers with a line of JSON: for programs that compare.
//
//     {"hashes": BASE64} -> {"hashes": [...]} or {"error": kind, "message", "offset", "chunk"}
//
// An exception that is no DecodeError ends in {"crash": stack}.

import { createInterface } from "node:readline";

import { DecodeError, hashes } from "../decode/index.js";

for await (const line of createInterface({ input: process.stdin })) {
  let answer;
  try {
    answer = { hashes: hashes(Buffer.from(JSON.parse(line).hashes, "base64")) };
  } catch (error) {
    if (error instanceof DecodeError) {
      const { kind, message, offset, chunk } = error;
      answer = { error: kind, message, offset, chunk };
    } else answer = { crash: error instanceof Error ? error.stack : String(error) };
  }
  process.stdout.write(JSON.stringify(answer) + "\n");
}
