// Deformation kind 1 (clause 13.8), tracks: what is added to Gaussians over time, sums of trajectories that they share.

import { malformed } from "../decode/errors.js";
import { checkAlike, describedRows, rowsOf } from "./rules.js";
/** @import { Header } from "../decode/header.js" */
/** @import { LayerTables } from "../decode/reader.js" */
/** @import { LayerTensors } from "../decode/tensors.js" */

/**
 * bases: [K, c, T], trajectories of c components at the instants. coefficients: [rows, K], of all rows up to those of
 * the layer.
 *
 * @typedef {{components: number, bases: Float32Array, coefficients: Float32Array}} Head
 *
 * The tracks of one layer. instants: [T] ascending from 0 to 1, normalised time. heads: by what they add to, position,
 * rotation, scale, opacity, color; null where there is none.
 *
 * @typedef {{instants: Float64Array, heads: (Head | null)[]}} Tracks
 */

/** Components of the heads position, rotation (w x y z), scale, opacity and color, by id. */
export const COMPONENTS = [3, 4, 3, 1, 3];

/** @param {number} id @param {number} channels @param {number[]} sides */
const gridOf = (id, channels, sides) => `grid ${id} of ${channels} channels on ${sides.join(" x ")}`;

export const tracks = {
  name: "tracks",
  scene: "splats",
  forms: ["grids", "rows"],

  /** @param {Header} _header @param {LayerTables[]} layers up to that of the deformation, which has grids and rows */
  check(_header, layers) {
    const { layer, grids, rowTensors, kind } = layers[layers.length - 1];
    const where = `layer ${layer}: tracks`;
    const parameters = (kind?.length ?? 1) - 1;
    if (parameters) throw malformed(`${where} of ${parameters} parameters, expected none`);
    const heads = rowTensors.filter(({ id }) => id in COMPONENTS);
    checkAlike(where, rowTensors.map(describedRows), heads.map(({ id, channels }) => rowsOf(id, channels)));
    const sides = grids[0].sides.slice(0, 1);
    const bases = heads.map(({ id, channels }) => gridOf(1 + id, channels * COMPONENTS[id], sides));
    const found = grids.map((grid) => gridOf(grid.id, grid.channels, grid.sides));
    checkAlike(where, found, [gridOf(0, 1, sides), ...bases]);
    const [{ data }] = grids[0].planes;
    const ascending = data[0] === 0 && data.every((value, i) => !i || value > data[i - 1]);
    if (data.length < 2 || !ascending) throw malformed(`${where}: instants that do not ascend from 0, or less than two`);
  },

  /** The tracks of all these layers. @param {Header} _header @param {LayerTensors[]} layers @returns {Tracks[]} */
  deformationOf(_header, layers) {
    const tracked = layers.filter(({ kind }) => kind);
    return tracked.map(({ grids: [{ planes: [{ data }] }, ...bases], rowTensors, rows }) => {
      const heads = COMPONENTS.map((components, head) => {
        const i = rowTensors.findIndex(({ id }) => id === head);
        return i < 0 ? null : { components, bases: bases[i].planes[0].data, coefficients: rows[i] };
      });
      return { instants: Float64Array.from(data, (value) => value / data[data.length - 1]), heads };
    });
  },
};
