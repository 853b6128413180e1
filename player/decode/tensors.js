// What the decoder yields: tensors in three forms (clause 6.3), by id. Arrays are in C order. A kind (13.1) says what
// they mean.

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

/** A pinhole camera with the axes x right, y down, z forward. viewmat: world to camera, row-major [4][4]. K: row-major
 * [3][3], pixels. @typedef {{viewmat: Float32Array, K: Float32Array, width: number, height: number}} Camera */

/** A tensor of rows: so many numbers of each anchor, multiples of the step.
 * @typedef {{id: number, channels: number, step: number, predictor: number}} RowTensor */

/** A plane of a grid, [channels, height, width].
 * @typedef {{data: Float32Array, channels: number, height: number, width: number, predictor: number}} Plane */

/** A grid with one plane for each pair of its sides in order: 01, 02, .. 12, 13, .. Samples are multiples of the step.
 * @typedef {{id: number, channels: number, step: number, sides: number[], planes: Plane[]}} Grid */

/** Linear layers from the input side. weight: row-major [outputs][inputs].
 * @typedef {{weight: Float32Array, bias: Float32Array, inputs: number, outputs: number}[]} Network */

/** Weights are multiples of the step. @typedef {{id: number, step: number, network: Network}} Chain */

/**
 * A layer as far as it has been read.
 *
 * @typedef {object} LayerTensors
 * @property {number} layer its number
 * @property {Uint8Array} codes the mask codes (11.1) of all anchors up to its own, whose number is their length
 * @property {number[]} fill the colour behind a prefix that ends here (13.6), RGB, 0..1
 * @property {number} spread the factor on its scales (13.6), 1 in whole files
 * @property {Grid[]} grids
 * @property {Chain[]} chains
 * @property {number[] | null} kind of its deformation: its number, then its parameters
 * @property {RowTensor[]} rowTensors its own, which have a row for each anchor that `codes` has one for
 * @property {Float32Array[]} rows [anchors, channels] of each of them
 */

/**
 * A prefix of a file, with N anchors.
 *
 * @typedef {object} Tensors
 * @property {import("./header.js").Header} header
 * @property {LayerTensors[]} layers those that are there, ascending, layer 0 first
 * @property {Int32Array} voxels [N, 3] indices
 * @property {Float32Array} positions [N, 3] scene units
 * @property {Float32Array[]} rows [N, channels] of each tensor of the header's
 * @property {Uint8Array | null} classes [N] step classes, null if rows have none
 */
