// Clauses 13.1 and 17.1: the kinds, which say what tensors mean, by number.

import { malformed, unsupported } from "../decode/errors.js";
import { hexplane } from "./hexplane.js";
import { scaffold } from "./scaffold.js";
/** @import { Header } from "../decode/header.js" */
/** @import { Rules } from "../decode/reader.js" */
/** @import { Tensors } from "../decode/tensors.js" */
/** @import { Anchors } from "./scaffold.js" */

/** @typedef {import("./hexplane.js").Deformation} Deformation */
/** @typedef {import("./hexplane.js").Scale} Scale */
/** @typedef {import("./scaffold.js").Widths} Widths */

/**
 * A prefix of a scene, with N anchors. Arrays in units and axes of the specification.
 *
 * @typedef {Anchors & SceneLayers} Scene
 *
 * @typedef {object} SceneLayers
 * @property {import("../decode/tensors.js").Info} info
 * @property {number[]} layers numbers of the layers that are there, ascending, 0 first
 * @property {number[]} rows rows[i]: number of anchors in the prefix that ends with layers[i]
 * @property {Int32Array} anchorQ [N, 3] voxel indices
 * @property {Uint8Array[]} mask per layer the codes of its rows[i] rows: the gate times 255; 0 is inactive
 * @property {number[][]} fill per layer the colour behind its Gaussians, RGB, 0..1
 * @property {(Deformation | null)[]} motion per layer what moves its level: the deformation of the highest layer up to
 * this one that has one; null if none has
 */

const SCENES = [scaffold];
const DEFORMATIONS = [hexplane];

/** @template {{name: string}} K @param {K[]} kinds @param {string} what @param {number[]} kind */
function registered(kinds, what, [number]) {
  if (number in kinds) return kinds[number];
  const known = kinds.map(({ name }, i) => `${i} (${name})`).join(", ");
  throw unsupported(`${what} of kind ${number}, expected ${known}`);
}

/** @param {Header} header */
const sceneKind = ({ kind }) => registered(SCENES, "scene", kind);

/** What a scene demands of tensors. @type {Rules} */
export const RULES = {
  checkHeader: (header) => sceneKind(header).checkHeader(header),

  checkLayer(header, layers) {
    const { layer, grids, chains, kind } = layers[layers.length - 1];
    const where = `layer ${layer}`;
    if (!layer) {
      if (kind) throw malformed(`${where}: a kind of deformation, expected none`);
      sceneKind(header).checkFirstLayer(header, layers[0]);
      return;
    }
    if (!kind && !grids.length && !chains.length) return; // no deformation
    const rules = kind && registered(DEFORMATIONS, `${where}: deformation`, kind);
    const lacks = Object.entries({ kind, grids: grids.length, chains: chains.length }).find(([, there]) => !there);
    if (!rules || lacks) throw malformed(`${where}: a deformation without ${lacks?.[0]}`);
    rules.check(header, layers);
  },
};

/** The scene of tensors that were read under RULES. @param {Tensors} tensors @returns {Scene} */
export function sceneOf(tensors) {
  const { header, layers, voxels } = tensors;
  /** @type {Deformation | null} */
  let motion = null;
  return {
    ...sceneKind(header).anchorsOf(tensors),
    info: header.info,
    layers: layers.map(({ layer }) => layer),
    rows: layers.map(({ codes }) => codes.length),
    anchorQ: voxels,
    mask: layers.map(({ codes }) => codes),
    fill: layers.map(({ fill }) => fill),
    motion: layers.map(({ kind }, i) => {
      if (kind) motion = registered(DEFORMATIONS, "deformation", kind).deformationOf(header, layers.slice(0, i + 1));
      return motion;
    }),
  };
}
