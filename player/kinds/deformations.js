// Clause 17.1: the kinds of deformations, by number.

import { hexplane } from "./hexplane.js";
import { tracks } from "./tracks.js";

export const DEFORMATIONS = [hexplane, tracks];

/** What a deformation of splats is, by its name in `kind`: the one that gives it `width`, `basesAt` and `coefficients`.
 * @param {{kind: string}} motion @returns {typeof tracks} */
export const splatMotion = (motion) => /** @type {typeof tracks} */ (DEFORMATIONS.find(({ name }) => name === motion.kind));
