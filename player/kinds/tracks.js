// Deformation kind 1 (clause 13.8), tracks: what is added to Gaussians over time, sums of trajectories that they share.
// Gaussians that move alike may be in a group, which adds to their coefficients what is linear in their positions.

import { malformed } from "../decode/errors.js";
import { checkAlike, COMPONENTS, describedRows, rowsOf } from "./rules.js";
/** @import { Header } from "../decode/header.js" */
/** @import { LayerTables } from "../decode/reader.js" */
/** @import { LayerTensors } from "../decode/tensors.js" */

/**
 * bases: [K, c, T], trajectories of c components at the instants. coefficients: [rows, K], of all rows up to those of
 * the layer. maps: [4, K, M], null if groups add nothing.
 *
 * @typedef {{components: number, bases: Float32Array, coefficients: Float32Array, maps: Float32Array | null}} Head
 *
 * M groups. of: [rows], the group of each; numbers outside 0..M - 1 stand for none. centres: [3, M].
 *
 * @typedef {{of: Float32Array, centres: Float32Array}} Groups
 *
 * The tracks of one layer. instants: [T] ascending from 0 to 1, normalised time. heads: by what they add to, in the order
 * of COMPONENTS; null where there is none.
 *
 * @typedef {{kind: "tracks", instants: Float64Array, heads: (Head | null)[], groups: Groups | null}} Tracks
 */

/** Ids of the layer rows of groups, of the grid of their centres, and of the maps of head 0. */
const [GROUP, CENTRES, MAPS] = [5, 6, 7];

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
    const own = heads.map(({ id, channels }) => rowsOf(id, channels));
    const groups = rowTensors.find(({ id }) => id === GROUP);
    if (!heads.length) throw malformed(`${where} without heads`);
    if (groups && groups.step !== 1) throw malformed(`${where}: groups of step ${groups.step}, expected 1`);
    checkAlike(where, rowTensors.map(describedRows), [...own, ...(groups ? [rowsOf(GROUP, 1)] : [])]);
    const sides = grids[0].sides.slice(0, 1);
    const bases = heads.map(({ id, channels }) => gridOf(1 + id, channels * COMPONENTS[id], sides));
    const expected = [gridOf(0, 1, sides), ...bases];
    if (groups) {
      const along = grids.find(({ id }) => id === CENTRES)?.sides.slice(0, 1) ?? [];
      const mapped = heads.filter((head) => grids.some(({ id }) => id === MAPS + head.id));
      const maps = mapped.map(({ id, channels }) => gridOf(MAPS + id, 4 * channels, along));
      expected.push(gridOf(CENTRES, 3, along), ...maps);
    }
    checkAlike(where, grids.map((grid) => gridOf(grid.id, grid.channels, grid.sides)), expected);
    const [{ data }] = grids[0].planes;
    const ascending = data[0] === 0 && data.every((value, i) => !i || value > data[i - 1]);
    if (data.length < 2 || !ascending) throw malformed(`${where}: instants that do not ascend from 0, or less than two`);
  },

  /** The tracks of the last of these layers. @param {Header} _header @param {LayerTensors[]} layers @returns {Tracks} */
  deformationOf(_header, layers) {
    const { grids, rowTensors, rows } = layers[layers.length - 1];
    /** @param {number} wanted @returns {Float32Array | null} */
    const plane = (wanted) => grids.find(({ id }) => id === wanted)?.planes[0].data ?? null;
    /** @param {number} wanted @returns {Float32Array | null} */
    const rowsOfId = (wanted) => rows[rowTensors.findIndex(({ id }) => id === wanted)] ?? null;
    const heads = COMPONENTS.map((components, head) => {
      const [bases, coefficients] = [plane(1 + head), rowsOfId(head)];
      return bases && coefficients && { components, bases, coefficients, maps: plane(MAPS + head) };
    });
    const [of, centres, [{ planes: [{ data }] }]] = [rowsOfId(GROUP), plane(CENTRES), grids];
    const instants = Float64Array.from(data, (value) => value / data[data.length - 1]);
    return { kind: "tracks", instants, heads, groups: of && centres && { of, centres } };
  },

  /** How many bases it adds to a quantity: the sum of each times a Gaussian's coefficient. @param {Tracks} motion
   * @param {number} head */
  width({ instants, heads }, head) {
    const found = heads[head];
    return found ? found.bases.length / COMPONENTS[head] / instants.length : 0;
  },

  /** The bases at a time. @param {Tracks} motion @param {number} head one that it has @param {number} t 0..1
   * @param {(basis: number, component: number, value: number) => void} put takes each component of each basis */
  basesAt({ instants, heads }, head, t, put) {
    const { bases, components } = /** @type {Head} */ (heads[head]);
    const { length } = instants;
    let j = 0;
    while (j < length - 2 && instants[j + 1] <= t) j++;
    const f = (t - instants[j]) / (instants[j + 1] - instants[j]);
    for (let from = j, c = 0; from < bases.length; from += length, c++) {
      put(Math.floor(c / components), c % components, bases[from] * (1 - f) + bases[from + 1] * f);
    }
  },

  /** Those of some rows, [count, width]. @param {Tracks} motion @param {number} head one that it has
   * @param {Uint32Array} rows @param {Float32Array} rest their positions, in every four numbers the first three
   * @param {number} scale of positions to units of a quarter of the box */
  coefficients(motion, head, rows, rest, scale) {
    const width = tracks.width(motion, head);
    const { groups, heads } = motion;
    const { coefficients, maps } = /** @type {Head} */ (heads[head]);
    const own = new Float32Array(width * rows.length);
    for (let i = 0; i < rows.length; i++) {
      // layers have nothing for the rows of later ones
      for (let k = 0; k < width; k++) own[width * i + k] = coefficients[width * rows[i] + k] ?? 0;
    }
    if (!groups || !maps) return own;
    const { of, centres } = groups;
    const count = centres.length / 3;
    for (let i = 0; i < rows.length; i++) {
      const group = of[rows[i]];
      if (!(group >= 0 && group < count)) continue;
      const [x, y, z] = [0, 1, 2].map((axis) => rest[4 * i + axis] * scale - centres[axis * count + group]);
      for (let k = 0, from = group, step = width * count; k < width; k++, from += count) {
        const turned = x * maps[from] + y * maps[from + step] + z * maps[from + 2 * step];
        own[width * i + k] += turned + maps[from + 3 * step];
      }
    }
    return own;
  },
};
