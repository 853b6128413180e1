// What the decoder yields. Arrays are in C order; units and axes are those of the specification.

/**
 * Linear layers from the input side, ReLU between them and none after the last. weight: row-major [outputs][inputs].
 *
 * @typedef {{weight: Float32Array, bias: Float32Array, inputs: number, outputs: number}[]} Network
 */

/**
 * A plane ab of a HexPlane, [channels, height, width]: rows follow b, columns a.
 *
 * @typedef {{data: Float32Array, channels: number, height: number, width: number}} Plane
 */

/** Planes in the order of the file. @typedef {Record<(typeof PLANES)[number], Plane>} Scale */

/**
 * networks: `trunk`, which reads the planes of the layers below before these, and those of the heads position, feature,
 * offset, scaling that are there, in this order.
 *
 * key: the key instant t* in normalised time if the residuals are those at t minus those at t* (13.4), else null.
 *
 * @typedef {{planes: Scale[], networks: Record<string, Network>, key: number | null}} Deformation
 */

/**
 * A pinhole camera with the axes x right, y down, z forward. viewmat: world to camera, row-major [4][4]. K: row-major
 * [3][3], pixels.
 *
 * @typedef {{viewmat: Float32Array, K: Float32Array, width: number, height: number}} Camera
 */

/**
 * The properties of the whole scene (clause 5.1).
 *
 * @typedef {object} Info
 * @property {number} voxelSize scene units
 * @property {[[number, number, number], [number, number, number]]} box lower and upper corner
 * @property {[number, number]} timeRange seconds at normalised time 0 and 1
 * @property {[number, number, number]} background RGB, 0..1
 * @property {number} near
 * @property {number} far
 * @property {[number, number, number]} up
 * @property {number} unit metres per scene unit, 0 if unknown
 * @property {Camera | null} camera
 */

/**
 * Quantisation steps, of attributes those of step class 0; those of tensors that the scene does not have are absent.
 *
 * @typedef {object} Steps
 * @property {number} feature
 * @property {number} scalingLog
 * @property {number} offset
 * @property {number} [weightsScaffold]
 * @property {number} [planesGlobal]
 * @property {number} [weightsGlobal]
 * @property {number} [planesLocal]
 * @property {number} [weightsLocal]
 */

/**
 * A prefix of a scene, with N anchors.
 *
 * @typedef {object} Scene
 * @property {Info} info
 * @property {import("./header.js").Widths} widths
 * @property {Steps} steps
 * @property {number[]} layers numbers of the layers that are there, ascending, 0 first
 * @property {number[]} rows rows[i]: number of anchors in the prefix that ends with layers[i]
 * @property {Int32Array} anchorQ [N, 3] voxel indices
 * @property {Float32Array} anchor [N, 3] positions, scene units
 * @property {Float32Array} feature [N, D]
 * @property {Float32Array} scalingLog [N, 6]
 * @property {Float32Array} offset [N, G, 3]
 * @property {Uint8Array[]} mask per layer the codes of its rows[i] rows: the gate times 255; 0 is inactive
 * @property {{opacity: Network, covariance: Network, color: Network}} networks of D inputs, the feature, or of D + 3, the
 * view direction behind it
 * @property {Deformation | null} globalDeformation of layer 1; null where it has none or is not there
 * @property {Deformation | null} localDeformation of layer 2, likewise
 */

/** The planes of a scale. */
export const PLANES = /** @type {const} */ (["xy", "xz", "xt", "yz", "yt", "zt"]);
