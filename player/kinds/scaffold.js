// Scene kind 0 (clause 13.2), scaffold: anchors that spawn G Gaussians each, by three networks.

import { malformed } from "../decode/errors.js";
import { chainOf, checkAlike, described, describedRows, rowsOf } from "./rules.js";
/** @import { Header } from "../decode/header.js" */
/** @import { LayerTensors, Network, Tensors } from "../decode/tensors.js" */
/** @import { Deformation } from "./index.js" */

/** D, scalars of a feature, G, Gaussians of an anchor, and V, bit i: network i of layer 0 takes the view direction.
 * @typedef {{feature: number, slots: number, views: number}} Widths */

/**
 * What N anchors hold.
 *
 * @typedef {object} Anchors
 * @property {"scaffold"} kind
 * @property {boolean} sees whether Gaussians depend on the camera's centre
 * @property {Widths} widths
 * @property {Float32Array} anchor [N, 3] positions, scene units
 * @property {Float32Array} feature [N, D]
 * @property {Float32Array} scalingLog [N, 6]
 * @property {Float32Array} offset [N, G, 3]
 * @property {{opacity: Network, covariance: Network, color: Network}} networks ReLU between their layers and none after
 * the last; of D inputs, the feature, or of D + 3, the view direction behind it
 */

const MAX_FEATURE = 64;
const MAX_SLOTS = 16;
const MAX_VIEWS = 7;
/** Outputs of the networks opacity, covariance and color for one Gaussian. */
const OUTPUTS = [1, 7, 3];

export const scaffold = {
  name: "scaffold",

  /** @param {Header} header */
  checkHeader({ kind, rows }) {
    const [, slots, views] = kind;
    if (kind.length !== 3 || slots < 1 || slots > MAX_SLOTS || views > MAX_VIEWS) {
      const expected = `G of 1..${MAX_SLOTS} and V of 0..${MAX_VIEWS}`;
      throw malformed(`header: a scaffold of the parameters [${kind.slice(1).join(", ")}], expected ${expected}`);
    }
    const widths = [Math.min(rows[0].channels, MAX_FEATURE), 6, 3 * slots];
    checkAlike("header: rows of a scaffold", rows.map(describedRows), widths.map((width, id) => rowsOf(id, width)));
  },

  /** @param {Header} header @param {Pick<LayerTensors, "chains">} layer 0 */
  checkFirstLayer({ kind: [, slots, views], rows }, { chains }) {
    const inputs = OUTPUTS.map((_, id) => rows[0].channels + (views & (1 << id) ? 3 : 0));
    const expected = OUTPUTS.map((each, id) => chainOf(id, inputs[id], each * slots));
    checkAlike("layer 0", chains.map(described), expected);
  },

  /** @param {Tensors} tensors @returns {Anchors} */
  anchorsOf({ header: { kind: [, slots, views] , rows: [{ channels }] }, layers: [{ chains }], positions, rows }) {
    const [opacity, covariance, color] = chains.map(({ network }) => network);
    const [feature, scalingLog, offset] = rows;
    const networks = { opacity, covariance, color };
    const widths = { feature: channels, slots, views };
    return { kind: "scaffold", sees: views > 0, widths, anchor: positions, feature, scalingLog, offset, networks };
  },

  /** What moves the next level: the deformation of its own layer alone. @param {unknown} _below
   * @param {Deformation} own */
  moved: (_below, own) => own,
};
