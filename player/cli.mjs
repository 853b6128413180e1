#!/usr/bin/env node
// The decoder as a command.

import { readFileSync } from "node:fs";

import { DecodeError, decode, hashes } from "./decode/index.js";

const USAGE = `usage: node player/cli.mjs hashes FILE            SHA-256 per layer of its integers and of its float32 tensors, as JSON
       node player/cli.mjs time FILE [-n RUNS]    how long it takes to decode it, warm (default: 9 runs), as JSON
FILE - reads stdin. Exit: 0 ok, 1 bad data or I/O, 2 usage.
`;
/** Decodes that are not timed: the first ones also compile the decoder. */
const WARM_UP = 5;

/** @param {string} file */
function read(file) {
  return readFileSync(file === "-" ? 0 : file);
}

/** @param {string} file @param {number} runs */
function time(file, runs) {
  const bytes = read(file);
  /** @type {{wall: number, cpu: number}[]} */
  const times = [];
  let first = 0;
  for (let i = 0; i < WARM_UP + runs; i++) {
    const cpu = process.cpuUsage();
    const start = performance.now();
    decode(bytes);
    const wall = performance.now() - start;
    const used = process.cpuUsage(cpu);
    if (i === 0) first = wall;
    if (i >= WARM_UP) times.push({ wall, cpu: (used.user + used.system) / 1000 });
  }
  /** @param {number[]} values */
  const median = (values) => values.sort((a, b) => a - b)[values.length >> 1] / 1000;
  return {
    file,
    bytes: bytes.length,
    runs,
    first_wall_seconds: first / 1000,
    median_wall_seconds: median(times.map(({ wall }) => wall)),
    median_cpu_seconds: median(times.map(({ cpu }) => cpu)),
  };
}

/** @param {string[]} args @returns {number} the exit code */
function main([verb, file, option, count, ...more]) {
  if (verb === "-h" || verb === "--help") {
    process.stdout.write(USAGE);
    return 0;
  }
  const runs = option === undefined ? 9 : Number(count);
  const usable = file !== undefined && !more.length && (option === undefined || (verb === "time" && option === "-n"));
  if (!["hashes", "time"].includes(verb) || !usable || !Number.isInteger(runs) || runs < 1 || runs > 10000) {
    process.stderr.write(USAGE);
    return 2;
  }
  try {
    const result = verb === "hashes" ? hashes(read(file)) : time(file, runs);
    process.stdout.write(JSON.stringify(result) + "\n");
    return 0;
  } catch (error) {
    if (!(error instanceof Error)) throw error;
    const what = error instanceof DecodeError ? `${error.kind}: ${error.message}` : error.message;
    process.stderr.write(`pd4-player: ${file}: ${what.replaceAll("\n", " ")}\n`);
    return 1;
  }
}

process.exitCode = main(process.argv.slice(2));
