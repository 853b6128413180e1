// Deformation kind 0 (clause 13.3), HexPlane: planes over space and time, a trunk that reads them, and heads.

import { malformed } from "../decode/errors.js";
import { chainOf, checkAlike, described } from "./rules.js";
/** @import { Header } from "../decode/header.js" */
/** @import { LayerTables } from "../decode/reader.js" */
/** @import { Network, Plane } from "../decode/tensors.js" */

/** Plane ab: rows follow b, columns a. @typedef {Record<"xy" | "xz" | "xt" | "yz" | "yt" | "zt", Plane>} Scale */

/**
 * planes: of the layers up to this one, which the trunk reads. heads: networks of the trunk's outputs, by what they add
 * to: positions, then each tensor of rows; null where there is none.
 *
 * key: the key instant t* in normalised time if the residuals are those at t minus those at t* (13.4), else null.
 *
 * @typedef {{planes: Scale[], trunk: Network, heads: (Network | null)[], key: number | null}} Deformation
 */

const MAX_SCALES = 8;
/** Normalised times are multiples of 1 / INSTANTS. */
const INSTANTS = 65535;

export const hexplane = {
  name: "hexplane",
  scene: "scaffold",
  forms: ["grids", "chains"],

  /** @param {Header} header @param {LayerTables[]} layers up to that of the deformation, which has grids and chains */
  check({ rows }, layers) {
    const { layer, grids, chains, kind } = layers[layers.length - 1];
    const where = `layer ${layer}: a hexplane`;
    const parameters = (kind?.length ?? 1) - 1;
    if (parameters > 1) throw malformed(`${where} of ${parameters} parameters, expected a key instant or none`);
    if (grids.length > MAX_SCALES) throw malformed(`${where} of ${grids.length} grids, expected at most ${MAX_SCALES}`);
    const read = layers.flatMap((one) => one.grids);
    const [{ channels }] = read;
    const found = grids.map((grid) => `a grid of ${grid.sides.length} sides and ${grid.channels} channels`);
    checkAlike(where, found, grids.map(() => `a grid of 4 sides and ${channels} channels`));
    const [{ network: trunk }] = chains;
    const inner = trunk[trunk.length - 1].outputs;
    const outputs = [inner, 3, ...rows.map((tensor) => tensor.channels)];
    const heads = chains.slice(1).map(({ id }) => (id in outputs ? chainOf(id, inner, outputs[id]) : "nothing"));
    checkAlike(where, chains.map(described), [chainOf(0, read.length * channels, inner), ...heads]);
    if (chains.length < 2) throw malformed(`${where} of ${chains.length} chain, expected the trunk and a head at least`);
  },

  /** That of the last of these layers. @param {Header} header @param {LayerTables[]} layers @returns {Deformation} */
  deformationOf({ rows }, layers) {
    const { chains, kind } = layers[layers.length - 1];
    const scales = layers.flatMap(({ grids }) => grids);
    const ids = [1, ...rows.map((_, i) => i + 2)];
    return {
      planes: scales.map(({ planes: [xy, xz, xt, yz, yt, zt] }) => ({ xy, xz, xt, yz, yt, zt })),
      trunk: chains[0].network,
      heads: ids.map((id) => chains.find((chain) => chain.id === id)?.network ?? null),
      key: kind?.[1] === undefined ? null : Math.fround(kind[1] / INSTANTS),
    };
  },
};
