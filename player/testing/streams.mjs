// What streams of a file cost, as a line of JSON.
//
//     node streams.mjs FILE              by the way it is split: processor time as a multiple of `decode`'s, and the bytes
//                                        of the arrays that all scenes have together as a multiple of the last one's
//     node streams.mjs FILE WAY SIZE URL [seconds of processor time, bytes of the process's peak] of one way of splits.js

import { readFileSync } from "node:fs";

import { decode } from "../decode/index.js";
import { every, fed, fetched, least, working } from "./splits.js";
import { endsOf } from "./vectors.mjs";
/** @import { Scene } from "../decode/index.js" */

const [, , file, way, size, url] = process.argv;
const bytes = new Uint8Array(readFileSync(file));

/** Seconds of processor time. */
function clock() {
  const { user, system } = process.cpuUsage();
  return (user + system) / 1e6;
}

/** @param {Scene[]} scenes */
function held(scenes) {
  const arrays = scenes.flatMap((s) => [...Object.values(s), ...s.mask].filter((values) => ArrayBuffer.isView(values)));
  return [...new Set(arrays.map(({ buffer }) => buffer))].reduce((sum, { byteLength }) => sum + byteLength, 0);
}

async function splits() {
  const ends = endsOf(bytes).map(({ end }) => end);
  const ways = {
    whole: () => fed(bytes, []),
    slices: () => fed(bytes, ends),
    "within slices": () => fed(bytes, ends.map((end) => end - 5)),
    tens: () => fed(bytes, every(bytes, 10)),
    "a source": () => fetched(bytes, 1 << 16),
  };
  for (let i = 0; i < 3; i++) decode(bytes); // compiled by then
  const seconds = await least(() => decode(bytes), clock, 3);
  /** @type {Record<string, {time: number, memory: number, scenes: number}>} */
  const found = {};
  for (const [name, way] of Object.entries(ways)) {
    /** @type {Scene[]} */
    let scenes = [];
    const own = await least(async () => {
      scenes = [];
      for await (const scene of way()) scenes.push(scene);
    }, clock, 3);
    found[name] = { time: own / seconds, memory: held(scenes) / held([decode(bytes)]), scenes: scenes.length };
  }
  return found;
}

/** The least of seven runs, of which the first ones are compiled. */
async function one() {
  const work = working(bytes, /** @type {import("./splits.js").Way} */ (way), Number(size), url);
  return [await least(work, clock, 7), 1024 * process.resourceUsage().maxRSS];
}

console.log(JSON.stringify(await (way ? one() : splits())));
