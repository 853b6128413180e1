#!/usr/bin/env node
// The decoder as a command.

import { readFileSync } from "node:fs";

import { DecodeError, hashes } from "./decode/index.js";

const USAGE = `usage: node player/cli.mjs hashes FILE [BASE]

SHA-256 of each layer's integers and float32 tensors, as JSON. BASE: the file that FILE names as its base.
FILE - reads stdin. Exit: 0 ok, 1 bad data or I/O, 2 usage.
`;

/** @param {string[]} args @returns {number} the exit code */
function main([verb, file, under, ...more]) {
  if (verb === "-h" || verb === "--help") {
    process.stdout.write(USAGE);
    return 0;
  }
  if (verb !== "hashes" || file === undefined || more.length) {
    process.stderr.write(USAGE);
    return 2;
  }
  try {
    const base = under === undefined ? null : readFileSync(under);
    process.stdout.write(JSON.stringify(hashes(readFileSync(file === "-" ? 0 : file), { base })) + "\n");
    return 0;
  } catch (error) {
    if (!(error instanceof Error)) throw error;
    const message = error instanceof DecodeError ? `${error.kind}: ${error.message}` : error.message;
    process.stderr.write(`pd4-player: ${file}: ${message.replaceAll("\n", " ")}\n`);
    return 1;
  }
}

process.exitCode = main(process.argv.slice(2));
