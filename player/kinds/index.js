// Clauses 13.1 and 17.1: the kinds, which say what tensors mean, by number.

import { malformed, unsupported } from "../decode/errors.js";
import { DEFORMATIONS } from "./deformations.js";
import { scaffold } from "./scaffold.js";
import { splats } from "./splats.js";
/** @import { Header } from "../decode/header.js" */
/** @import { Rules } from "../decode/reader.js" */
/** @import { Tensors } from "../decode/tensors.js" */
/** @import { Anchors } from "./scaffold.js" */
/** @import { ExplicitGaussians } from "./splats.js" */

/** @typedef {import("./hexplane.js").Deformation} Deformation */
/** @typedef {import("./hexplane.js").Scale} Scale */
/** @typedef {import("./scaffold.js").Widths} Widths */
/** @typedef {import("./tracks.js").Tracks} Tracks */

/**
 * A prefix of a scene, with N anchors, or N Gaussians that need none. Arrays in units and axes of the specification.
 *
 * motion: per layer what moves its level, null if nothing does: the deformation of the highest layer up to this one that
 * has one, or those of all of these (none where only windows open and close).
 *
 * @typedef {Anchors & SceneLayers & {motion: (Deformation | null)[]}} AnchorScene
 * @typedef {ExplicitGaussians & SceneLayers & {motion: (Tracks[] | null)[]}} SplatScene
 * @typedef {AnchorScene | SplatScene} Scene
 *
 * @typedef {object} SceneLayers
 * @property {import("../decode/tensors.js").Info} info
 * @property {number[]} layers numbers of the layers that are there, ascending, 0 first
 * @property {number[]} rows rows[i]: number of anchors in the prefix that ends with layers[i]
 * @property {Int32Array} anchorQ [N, 3] voxel indices
 * @property {Uint8Array[]} mask per layer the codes of its rows[i] rows: the gate times 255; 0 is inactive
 * @property {number} baseRows so many of the first anchors are those of the file's base, the same in all files over it
 * @property {number[][]} fill per layer the colour behind its Gaussians, RGB, 0..1
 * @property {number[]} spread per layer the factor on their scales, 1 in whole files
 */

const SCENES = [scaffold, splats];

/** The kind of a scene. @param {Scene} scene */
export const kindOf = (scene) => SCENES.find(({ name }) => name === scene.kind);

/** @template {{name: string}} K @param {K[]} kinds @param {string} what @param {number[]} kind */
function registered(kinds, what, [number]) {
  if (number in kinds) return kinds[number];
  const known = kinds.map(({ name }, i) => `${i} (${name})`).join(", ");
  throw unsupported(`${what} of kind ${number}, expected ${known}`);
}

/** @param {Header} header */
const sceneKind = ({ kind }) => registered(SCENES, "scene", kind);

/** What a scene demands of tensors. @type {Rules} */
export function checkKinds(header, layers) {
  const scene = sceneKind(header);
  scene.checkHeader(header);
  if (!layers.length) return;
  const { layer, grids, chains, rowTensors, kind } = layers[layers.length - 1];
  const where = `layer ${layer}`;
  /** @type {Record<string, number>} */
  const forms = { grids: grids.length, chains: chains.length, rows: rowTensors.length };
  if (!layer) {
    if (kind) throw malformed(`${where}: a kind of deformation, expected none`);
    checkForms(where, forms, ["chains"]);
    scene.checkFirstLayer(header, layers[0]);
    return;
  }
  if (!kind && !Object.values(forms).some(Boolean)) return; // no deformation
  if (!kind) throw malformed(`${where}: a deformation without kind`);
  const rules = registered(DEFORMATIONS, `${where}: deformation`, kind);
  if (rules.scene !== scene.name) throw malformed(`${where}: ${rules.name} in a scene of kind ${scene.name}`);
  for (const form of rules.forms) if (!forms[form]) throw malformed(`${where}: ${rules.name} without ${form}`);
  checkForms(where, forms, rules.forms);
  rules.check(header, layers);
}

/** Malformed if a layer has tensors of its own in other forms. @param {string} where
 * @param {Record<string, number>} forms how many of each @param {string[]} allowed */
function checkForms(where, forms, allowed) {
  for (const [form, count] of Object.entries(forms)) {
    if (count && !allowed.includes(form)) throw malformed(`${where}: ${count} ${form}, expected none`);
  }
}

/** The scene of tensors that were read under checkKinds. @param {Tensors} tensors @returns {Scene} */
export function sceneOf(tensors) {
  const { header, layers, voxels } = tensors;
  const kinds = sceneKind(header);
  const anchors = kinds.anchorsOf(tensors);
  let motion = /** @type {any} */ (anchors).motion ?? null;
  const scene = {
    ...anchors,
    info: header.info,
    layers: layers.map(({ layer }) => layer),
    rows: layers.map(({ codes }) => codes.length),
    anchorQ: voxels,
    baseRows: header.base?.rows ?? 0,
    mask: layers.map(({ codes }) => codes),
    fill: layers.map(({ fill }) => fill),
    spread: layers.map(({ spread }) => spread),
    motion: layers.map(({ kind }, i) => {
      if (!kind) return motion;
      const own = registered(DEFORMATIONS, "deformation", kind).deformationOf(header, layers.slice(0, i + 1));
      return (motion = kinds.moved(motion, /** @type {any} */ (own)));
    }),
  };
  return /** @type {Scene} */ (scene); // checkKinds sees to it that kinds of deformations fit that of the scene
}
