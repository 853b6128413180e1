// What streams of a file cost: seconds of processor time as a multiple of `decode`, and the bytes of the arrays that all
// scenes have together as a multiple of the last one's. For tests: node streams.mjs FILE prints a line of JSON.

import { readFileSync } from "node:fs";

import { SceneSource } from "../decode/fetch.js";
import { decode, openStream } from "../decode/index.js";
/** @import { Scene } from "../decode/index.js" */

const bytes = new Uint8Array(readFileSync(process.argv[2]));

/** The least of three times, for a collection of garbage may fall into one, and the scenes.
 * @param {() => Scene[] | Promise<Scene[]>} work @returns {Promise<[number, Scene[]]>} */
async function timed(work) {
  let least = Infinity;
  /** @type {Scene[]} */
  let scenes = [];
  for (let i = 0; i < 3; i++) {
    const start = process.cpuUsage();
    scenes = await work();
    const { user, system } = process.cpuUsage(start);
    least = Math.min(least, user + system);
  }
  return [least, scenes];
}

/** @param {Scene[]} scenes */
function held(scenes) {
  const arrays = scenes.flatMap((s) => [s.anchorQ, s.anchor, s.feature, s.scalingLog, s.offset, ...s.mask]);
  return [...new Set(arrays.map(({ buffer }) => buffer))].reduce((sum, { byteLength }) => sum + byteLength, 0);
}

/** All scenes of a stream fed these pieces. @param {number[]} cuts */
function fed(cuts) {
  const stream = openStream();
  const scenes = [];
  let at = 0;
  for (const end of [...cuts, bytes.length]) scenes.push(...stream.feed(bytes.subarray(at, (at = end))));
  stream.finish();
  return scenes;
}

/** All scenes of a source whose bytes come in blocks. @param {number} size */
async function fetched(size) {
  const blocks = Array.from({ length: Math.ceil(bytes.length / size) }, (_, i) => bytes.slice(i * size, (i + 1) * size));
  const headers = { "Content-Length": String(bytes.length), ETag: '"a"' };
  const answer = () => new Response(new Blob(blocks).stream(), { headers });
  const scenes = [];
  for await (const scene of new SceneSource("http://x/", { fetch: async () => answer() }).scenes()) scenes.push(scene);
  return scenes;
}

const probe = openStream();
probe.feed(bytes);
const ends = probe.layerEnds.map(({ end }) => end);
const ways = {
  whole: () => fed([]),
  slices: () => fed(ends),
  "within slices": () => fed(ends.map((end) => end - 5)),
  tens: () => fed(Array.from({ length: Math.floor(bytes.length / 10) }, (_, i) => 10 * i)),
  "a source": () => fetched(1 << 16),
};
for (let i = 0; i < 3; i++) decode(bytes); // compiled by then
const [seconds, [last]] = await timed(() => [decode(bytes)]);
/** @type {Record<string, {time: number, memory: number, scenes: number}>} */
const found = {};
for (const [name, way] of Object.entries(ways)) {
  const [own, scenes] = await timed(way);
  found[name] = { time: own / seconds, memory: held(scenes) / held([last]), scenes: scenes.length };
}
console.log(JSON.stringify(found));
