// Clause 10: positions, an octree, level by level.

import { groupByClass } from "./channels.js";
import { limitExceeded, malformed } from "./errors.js";
/** @import { ChannelReader } from "./channels.js" */

const MAX_DEPTH = 21;
const MAX_VOXEL = 2 ** 20;
/** Children of a full node. */
const ALL = 8;

/** PATTERNS[k]: the bytes with k + 1 bits set, ascending. @type {number[][]} */
const PATTERNS = Array.from({ length: ALL }, () => []);
for (let byte = 1; byte < 256; byte++) PATTERNS[byte.toString(2).replaceAll("0", "").length - 1].push(byte);

/** The voxel indices, [rows, 3], in Morton order of their offsets from the minimum. @param {ChannelReader} reader
 * @param {number} rows at least 1 */
export function decodePositions(reader, rows) {
  const { codes } = reader;
  const minimum = [0, 1, 2].map(() => codes.zigzag(MAX_VOXEL, "the minimum of the voxel indices"));
  const depth = codes.byte("the depth of the octree");
  if (depth > MAX_DEPTH) throw limitExceeded(`a depth of ${depth}, limit ${MAX_DEPTH}`);
  const voxels = grow(reader, readLevels(reader, depth, rows), rows);
  let bits = 0;
  for (let axis = 0; axis < 3; axis++) {
    let least = Infinity;
    let largest = 0;
    for (let at = axis; at < voxels.length; at += 3) {
      least = Math.min(least, voxels[at]);
      largest = Math.max(largest, voxels[at]);
      voxels[at] += minimum[axis];
    }
    if (least !== 0) throw malformed(`voxel offsets begin at ${least} on an axis, expected 0`);
    const last = minimum[axis] + largest;
    if (last > MAX_VOXEL) throw malformed(`a voxel index of ${last}, limit ${MAX_VOXEL}`);
    bits = Math.max(bits, 32 - Math.clz32(largest));
  }
  if (bits !== depth) throw malformed(`voxel offsets of ${bits} bits, expected the octree's depth ${depth}`);
  return voxels;
}

/** How many children each node has less one, level by level from the root on. @param {ChannelReader} reader
 * @param {number} depth @param {number} rows */
function readLevels(reader, depth, rows) {
  const levels = [];
  let nodes = 1;
  for (let level = depth; level > 0; level--) {
    const coded = nodes < rows; // else each node has one child
    const further = coded ? reader.read(nodes, 0, ALL - 1, "a number of children less one") : new Int32Array(rows);
    levels.push(further);
    nodes = further.reduce((sum, more) => sum + more, nodes);
    if (nodes > rows) throw malformed(`${nodes} nodes below level ${level} of the octree, of ${rows} anchors`);
  }
  if (nodes !== rows) throw malformed(`${nodes} nodes after ${depth} levels, expected ${rows}`);
  return levels;
}

/** The offsets of all anchors, [rows, 3]. @param {ChannelReader} reader @param {Int32Array[]} levels
 * @param {number} rows */
function grow(reader, levels, rows) {
  let [parents, nodes] = [new Int32Array(3 * rows), new Int32Array(3 * rows)];
  for (const further of levels) {
    const indices = new Int32Array(further.length);
    reader.fill(indices, groupByClass(further, ALL));
    let at = 0;
    for (let i = 0; i < indices.length; i++) {
      const pattern = PATTERNS[further[i]][indices[i]];
      if (pattern === undefined) throw malformed(`pattern ${indices[i]} of a node with ${further[i] + 1} children`);
      for (let child = 0; child < ALL; child++) {
        if (!((pattern >> child) & 1)) continue;
        for (let axis = 0; axis < 3; axis++) nodes[at++] = 2 * parents[3 * i + axis] + ((child >> axis) & 1);
      }
    }
    [parents, nodes] = [nodes, parents];
  }
  return parents;
}
