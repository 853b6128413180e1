// Linear layers as shader source and uniform blocks. A fragment computes four outputs per target, so weights are stored
// as 4 × 4 matrices: block b of the outputs takes block k of the inputs through matrix b · K + k.

/** @import { Network } from "../decode/scene.js" */
/** @import { Gpu } from "./gl.js" */

/** Matrices of one shader, about: compilers unroll them, and take longer than in proportion. */
const MAX_MATRICES = 64;
/** Bytes of a 4 × 4 matrix, and of a vector of 4. */
const MATRIX_BYTES = 64;
const VECTOR_BYTES = 16;

/** @param {number} n */
export const blocksOf = (n) => Math.ceil(n / 4);

/**
 * A linear layer on the GPU. Its outputs are cut into chunks of `chunkBlocks` blocks, one draw call each.
 */
export class Linear {
  /** @param {Gpu} gpu @param {Network[number]} layer */
  constructor(gpu, layer) {
    this._gpu = gpu;
    this.inputBlocks = blocksOf(layer.inputs);
    this.outputBlocks = blocksOf(layer.outputs);
    const fitting = Math.floor(gpu.maxUniformBytes / (this.inputBlocks * MATRIX_BYTES + VECTOR_BYTES));
    const most = Math.min(gpu.maxTargets, fitting, Math.max(1, Math.floor(MAX_MATRICES / this.inputBlocks)));
    if (most < 1 || this.inputBlocks > MAX_MATRICES) throw new TooLarge(`a network of ${layer.inputs} inputs`);
    this.chunks = Math.ceil(this.outputBlocks / most);
    this.chunkBlocks = Math.ceil(this.outputBlocks / this.chunks);
    this._bytes = this.chunkBlocks * (VECTOR_BYTES + this.inputBlocks * MATRIX_BYTES);
    this._stride = Math.ceil(this._bytes / gpu.uniformAlignment) * gpu.uniformAlignment;
    const data = new Float32Array((this._stride * this.chunks) / 4);
    for (let c = 0; c < this.chunks; c++) {
      const at = (this._stride * c) / 4;
      pack(layer, c * this.chunkBlocks * 4, this.chunkBlocks, data.subarray(at, at + this._bytes / 4));
    }
    this._buffer = gpu.uniforms(data);
  }

  /** Output blocks with those that only pad the last chunk. */
  get paddedBlocks() {
    return this.chunks * this.chunkBlocks;
  }

  /** Makes the weights of a chunk uniform block `index`. @param {number} index @param {number} chunk */
  bind(index, chunk) {
    const { gl } = this._gpu;
    gl.bindBufferRange(gl.UNIFORM_BUFFER, index, this._buffer, this._stride * chunk, this._bytes);
  }

  /** Source that declares uniform block `index`. @param {number} index */
  declare(index) {
    const { inputBlocks: K, chunkBlocks: B } = this;
    return `layout(std140) uniform U${index} { vec4 b${index}[${B}]; mat4 w${index}[${B * K}]; };\n`;
  }

  /**
   * Source that computes `to`0, `to`1, .. from `from`0, `from`1, ..
   *
   * @param {number} index of the uniform block @param {string} from @param {string} to
   * @param {boolean} relu whether ReLU follows
   */
  apply(index, from, to, relu) {
    let source = "";
    for (let b = 0; b < this.chunkBlocks; b++) {
      source += `vec4 ${to}${b} = b${index}[${b}];\n`;
      for (let k = 0; k < this.inputBlocks; k++) {
        source += `${to}${b} += w${index}[${b * this.inputBlocks + k}] * ${from}${k};\n`;
      }
      if (relu) source += `${to}${b} = max(${to}${b}, 0.);\n`;
    }
    return source;
  }

  free() {
    this._gpu.gl.deleteBuffer(this._buffer);
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

/** Source that declares out0, out1, .. as targets. @param {number} count */
export function targets(count) {
  let source = "";
  for (let i = 0; i < count; i++) source += `layout(location = ${i}) out vec4 out${i};\n`;
  return source;
}

/** @param {number} count @param {(i: number) => string} line */
export function repeat(count, line) {
  let source = "";
  for (let i = 0; i < count; i++) source += line(i) + "\n";
  return source;
}
