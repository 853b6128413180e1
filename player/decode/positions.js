// Clause 10: positions, an octree, level by level.

import { limitExceeded, malformed } from "./errors.js";
import { MAX_COUNT, MAX_VOXEL } from "./limits.js";
/** @import { ByteReader } from "./bytes.js" */
/** @import { ChannelReader } from "./channels.js" */
/** @import { Prior } from "./tables.js" */

const MAX_DEPTH = 21;
/** Children of a full node, whose pattern needs no symbol. */
const ALL = 8;

/** PATTERNS[k]: the bytes with k bits set, ascending. @type {number[][]} */
const PATTERNS = Array.from({ length: 9 }, () => []);
for (let byte = 0; byte < 256; byte++) {
  let bits = 0;
  for (let rest = byte; rest; rest >>= 1) bits += rest & 1;
  PATTERNS[bits].push(byte);
}

/** Nodes of a level, and those of them with one child. @typedef {{nodes: number, single: number}} Level */

/**
 * @param {ChannelReader} channels @param {number} rows at least 1 @param {Prior[]} priors see ChannelReader
 * @returns {Int32Array} [rows, 3] voxel indices, in Morton order of their offsets from the minimum
 */
export function decodePositions(channels, rows, priors) {
  const { codes } = channels;
  const minimum = [0, 1, 2].map(() => codes.zigzag(MAX_VOXEL, "the minimum of the voxel indices"));
  const depth = codes.byte("the depth of the octree");
  if (depth > MAX_DEPTH) throw limitExceeded(`a depth of ${depth}, limit ${MAX_DEPTH}`);
  const levels = readLevels(codes, depth, rows);
  const counts = rows > 1 ? readPatternCounts(codes, levels) : [];
  const lengths = [];
  let only = 0;
  for (const { nodes, single } of levels) {
    if (nodes < rows) lengths.push(only, nodes - only, single);
    else lengths.push(single);
    only = single;
  }
  const symbols = channels.read(lengths, priors, 0, ALL - 1, "a symbol of the octree");
  const patterns = PATTERNS.map(({ length }, k) => {
    return channels.read([counts[k - 2] ?? 0], priors, 0, length - 1, "a pattern of children");
  });
  return placed(grow(levels, symbols, patterns, rows), minimum, depth);
}

/** 10.2, level by level. @param {ByteReader} reader @param {number} depth @param {number} rows @returns {Level[]} */
function readLevels(reader, depth, rows) {
  const levels = [];
  let nodes = 1;
  for (let level = depth; level > 0; level--) {
    if (nodes === rows) {
      levels.push({ nodes, single: nodes });
      continue;
    }
    const single = reader.varint(MAX_COUNT, "the number of nodes with one child");
    const further = reader.varint(MAX_COUNT, "the number of further children");
    const next = 2 * nodes - single + further;
    if (single > nodes || further > 6 * (nodes - single) || next > rows) {
      throw malformed(`${single} of ${nodes} nodes with one child and ${further} further children, of ${rows} anchors`);
    }
    levels.push({ nodes, single });
    nodes = next;
  }
  if (nodes !== rows) throw malformed(`${nodes} nodes after ${depth} levels, expected ${rows}`);
  return levels;
}

/** 10.2: how many nodes have 2, 3, .. 7 children. @param {ByteReader} reader @param {Level[]} levels */
function readPatternCounts(reader, levels) {
  const counts = [];
  for (let k = 2; k < ALL; k++) counts.push(reader.varint(MAX_COUNT, `the number of nodes with ${k} children`));
  const stated = counts.reduce((sum, count) => sum + count, 0);
  const several = levels.reduce((sum, { nodes, single }) => sum + nodes - single, 0);
  if (stated > several) throw malformed(`${stated} nodes with 2 to 7 children, expected at most ${several}`);
  return counts;
}

/**
 * The offsets of all anchors along x, y, z. Where the tree is not as its counts say, a level takes symbols that are none,
 * and is refused at its end.
 *
 * @param {Level[]} levels @param {Int32Array} symbols of all levels @param {Int32Array[]} patterns of k children
 * @param {number} rows
 */
function grow(levels, symbols, patterns, rows) {
  let parents = [0, 1, 2].map(() => new Int32Array(rows));
  let children = [0, 1, 2].map(() => new Int32Array(rows));
  let parentAlone = new Uint8Array(rows); // 1 where a node is its parent's only child
  let childAlone = new Uint8Array(rows);
  const used = patterns.map(() => 0);
  let at = 0;
  let only = 0;
  levels.forEach(({ nodes, single }, l) => {
    const branches = nodes < rows;
    let ofOnly = at;
    let ofOthers = at + only;
    let ofChild = branches ? at + nodes : at;
    at = ofChild + single;
    only = single;
    let made = 0;
    for (let i = 0; i < nodes; i++) {
      const count = branches ? 1 + symbols[parentAlone[i] ? ofOnly++ : ofOthers++] : 1;
      let pattern = 255;
      if (count === 1) pattern = 1 << symbols[ofChild++];
      else if (count < ALL) pattern = PATTERNS[count][patterns[count][used[count]++]];
      for (let child = 0; child < ALL; child++) {
        if (!((pattern >> child) & 1)) continue;
        for (let axis = 0; axis < 3; axis++) children[axis][made] = 2 * parents[axis][i] + ((child >> axis) & 1);
        childAlone[made++] = count === 1 ? 1 : 0;
      }
    }
    const after = levels[l + 1]?.nodes ?? rows;
    if (made !== after) throw malformed(`${made} nodes behind level ${l} of the octree, stated are ${after}`);
    if (ofChild !== at) throw malformed(`more or fewer nodes with one child than stated, in level ${l} of the octree`);
    [parents, children] = [children, parents];
    [parentAlone, childAlone] = [childAlone, parentAlone];
  });
  patterns.forEach(({ length }, k) => {
    if (used[k] !== length) throw malformed(`${used[k]} nodes with ${k} children, stated are ${length}`);
  });
  return parents;
}

/** 10.1: the voxels at these offsets. @param {Int32Array[]} offsets @param {number[]} minimum @param {number} depth */
function placed(offsets, minimum, depth) {
  const rows = offsets[0].length;
  const voxels = new Int32Array(3 * rows);
  let largestOfAll = 0;
  for (let axis = 0; axis < 3; axis++) {
    const along = offsets[axis];
    let least = Infinity;
    let largest = 0;
    for (let i = 0; i < rows; i++) {
      least = Math.min(least, along[i]);
      largest = Math.max(largest, along[i]);
      voxels[3 * i + axis] = minimum[axis] + along[i];
    }
    if (least !== 0) throw malformed(`voxel offsets begin at ${least} on an axis, expected 0`);
    if (minimum[axis] + largest > MAX_VOXEL) {
      throw malformed(`a voxel index of ${minimum[axis] + largest}, limit ${MAX_VOXEL}`);
    }
    largestOfAll = Math.max(largestOfAll, largest);
  }
  const bits = 32 - Math.clz32(largestOfAll);
  if (bits !== depth) throw malformed(`voxel offsets of ${bits} bits, expected the octree's depth ${depth}`);
  return voxels;
}
