// Scene kind 1 (clause 13.7), splats: Gaussians as they are, one in each voxel.

import { malformed } from "../decode/errors.js";
import { checkAlike, describedRows, rowsOf } from "./rules.js";
/** @import { Header } from "../decode/header.js" */
/** @import { LayerTensors, Tensors } from "../decode/tensors.js" */
/** @import { Tracks } from "./index.js" */

/**
 * What N Gaussians hold.
 *
 * @typedef {object} ExplicitGaussians
 * @property {"splats"} kind
 * @property {boolean} sees whether colours depend on the camera's centre
 * @property {Float32Array} anchor [N, 3] corners of their voxels, scene units
 * @property {Float32Array} offset [N, 3] positions from there, in voxels
 * @property {Float32Array} color [N, 3] Y, Co, Cg of the harmonic of degree 0
 * @property {Float32Array} opacity [N] logits
 * @property {Float32Array} scale [N, 3] natural logarithms of the standard deviations along own axes, scene units
 * @property {Float32Array} rotation [N, 3] x, y, z of a quaternion whose w is not negative
 * @property {Float32Array | null} harmonics [N, H, 3] Y, Co, Cg of those of higher degrees, H = 3, 8 or 15
 * @property {Float32Array | null} window [N, 3] in normalised time: centre, half its width, logarithm of its softness
 */

/** Channels of the tensors of rows, by id. */
const WIDTHS = [3, 3, 1, 3, 3];
const HARMONICS = { id: 5, widths: [9, 24, 45] };
const WINDOW = { id: 6, width: 3 };

export const splats = {
  name: "splats",

  /** @param {Header} header */
  checkHeader({ kind, rows }) {
    if (kind.length > 1) throw malformed(`header: splats of ${kind.length - 1} parameters, expected none`);
    const expected = WIDTHS.map((width, id) => rowsOf(id, width));
    for (const { id, channels } of rows) {
      const [least] = HARMONICS.widths;
      if (id === HARMONICS.id) expected.push(rowsOf(id, HARMONICS.widths.includes(channels) ? channels : least));
      if (id === WINDOW.id) expected.push(rowsOf(id, WINDOW.width));
    }
    checkAlike("header: rows of splats", rows.map(describedRows), expected);
  },

  /** @param {Header} _header @param {Pick<LayerTensors, "chains">} layer 0 */
  checkFirstLayer(_header, { chains }) {
    if (chains.length) throw malformed(`layer 0: ${chains.length} chains, expected none`);
  },

  /** @param {Tensors} tensors @returns {ExplicitGaussians & {motion: Tracks[] | null}} motion: below any deformation */
  anchorsOf({ header, positions, rows }) {
    const [offset, color, opacity, scale, rotation] = rows;
    const [harmonics, window] = [HARMONICS, WINDOW].map(({ id: wanted }) => {
      return rows[header.rows.findIndex(({ id }) => id === wanted)] ?? null;
    });
    const motion = window && /** @type {Tracks[]} */ ([]); // time opens and closes windows
    const seen = { kind: /** @type {"splats"} */ ("splats"), sees: !!harmonics, motion };
    return { ...seen, anchor: positions, offset, color, opacity, scale, rotation, harmonics, window };
  },

  /** What moves the next level: deformations add up. @param {Tracks[] | null} below @param {Tracks} own */
  moved: (below, own) => [...(below ?? []), own],
};
