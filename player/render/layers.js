// Linear layers as shader source and uniform blocks. A fragment computes four outputs per target, so weights are stored
// as 4 × 4 matrices: block b of the outputs takes block k of the inputs through matrix b · K + k.

/** @import { Network } from "../decode/tensors.js" */
/** @import { Field, Gpu } from "./gl.js" */

/** Matrices of one shader, about: compilers unroll them, and take longer than in proportion. */
const MAX_MATRICES = 64;
/** Bytes of a 4 × 4 matrix, and of a vector of 4. */
const MATRIX_BYTES = 64;
const VECTOR_BYTES = 16;

/** @param {number} n */
export const blocksOf = (n) => Math.ceil(n / 4);

/** A linear layer on the GPU. Its outputs are cut into chunks of `chunkBlocks` blocks, one draw call each. */
export class Linear {
  /** @param {Gpu} gpu @param {Network[number]} layer */
  constructor(gpu, layer) {
    this._gpu = gpu;
    this.inputBlocks = blocksOf(layer.inputs);
    const blocks = blocksOf(layer.outputs);
    const fitting = Math.floor(gpu.maxUniformBytes / (this.inputBlocks * MATRIX_BYTES + VECTOR_BYTES));
    const most = Math.min(gpu.maxTargets, fitting, Math.max(1, Math.floor(MAX_MATRICES / this.inputBlocks)));
    if (most < 1 || this.inputBlocks > MAX_MATRICES) throw new TooLarge(`a network of ${layer.inputs} inputs`);
    this.chunks = Math.ceil(blocks / most);
    this.chunkBlocks = Math.ceil(blocks / this.chunks);
    this._bytes = this.chunkBlocks * (VECTOR_BYTES + this.inputBlocks * MATRIX_BYTES);
    this._stride = Math.ceil(this._bytes / gpu.uniformAlignment) * gpu.uniformAlignment;
    const data = new Float32Array((this._stride * this.chunks) / 4);
    for (let c = 0; c < this.chunks; c++) {
      const at = (this._stride * c) / 4;
      pack(layer, c * this.chunkBlocks * 4, this.chunkBlocks, data.subarray(at, at + this._bytes / 4));
    }
    this.buffer = gpu.uniforms(data);
  }

  /** Output blocks with those that only pad the last chunk. */
  get paddedBlocks() {
    return this.chunks * this.chunkBlocks;
  }

  /** Runs the current program, whose uniform block 0 has the weights, on rows of a field. @param {Field} field
   * @param {number} row @param {number} rows */
  cover(field, row, rows) {
    const { gl } = this._gpu;
    for (let c = 0; c < this.chunks; c++) {
      gl.bindBufferRange(gl.UNIFORM_BUFFER, 0, this.buffer, this._stride * c, this._bytes);
      this._gpu.cover(field, c * this.chunkBlocks, this.chunkBlocks, row, rows);
    }
  }

  /** Source that declares uniform block 0 and the targets out0, out1, .. */
  declare() {
    const { inputBlocks: K, chunkBlocks: B } = this;
    return `layout(std140) uniform U0 { vec4 b0[${B}]; mat4 w0[${B * K}]; };\n` + targets(B);
  }

  /** Source that computes y0, y1, .. from x0, x1, .. @param {boolean} relu whether ReLU follows */
  apply(relu) {
    return repeat(this.chunkBlocks, (b) => {
      const terms = repeat(this.inputBlocks, (k) => `y${b} += w0[${b * this.inputBlocks + k}] * x${k};`);
      return `vec4 y${b} = b0[${b}];\n${terms}${relu ? `y${b} = max(y${b}, 0.);` : ""}`;
    });
  }
}

/** What the GPU evaluator cannot hold; the one in JavaScript can. */
export class TooLarge extends Error {
  /** @param {string} what */
  constructor(what) {
    super(`${what}: more than this GPU's shaders take`);
  }
}

/**
 * Biases, then matrices, of the outputs first .. first + 4 · blocks − 1; what the layer does not have is 0.
 *
 * @param {Network[number]} layer @param {number} first @param {number} blocks @param {Float32Array} out
 */
export function pack({ weight, bias, inputs, outputs }, first, blocks, out) {
  const inputBlocks = blocksOf(inputs);
  const count = Math.min(4 * blocks, outputs - first);
  for (let o = 0; o < count; o++) {
    out[o] = bias[first + o];
    const row = 4 * blocks + (o >> 2) * inputBlocks * 16 + (o & 3);
    for (let i = 0; i < inputs; i++) out[row + (i >> 2) * 16 + (i & 3) * 4] = weight[(first + o) * inputs + i];
  }
}

/** Lines of source. @param {number} count @param {(i: number) => string} line */
export const repeat = (count, line) => Array.from({ length: count }, (_, i) => `${line(i)}\n`).join("");

/** Source that declares out0, out1, .. as targets. @param {number} count */
export const targets = (count) => repeat(count, (i) => `layout(location = ${i}) out vec4 out${i};`);
