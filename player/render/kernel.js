// Linear layers over many rows, for evaluating without a GPU: in WebAssembly with vectors of four, and the same in
// plain JavaScript for where a page's policy forbids the former.

/** @import { Network } from "../decode/tensors.js" */

/** Vectors of outputs that are summed up together: with four, no addition waits for the one before it. */
const VECTORS = 4;
/** Outputs of a group. */
export const GROUP = 4 * VECTORS;
const PAGE_FLOATS = 1 << 14;

/**
 * A layer in an arena. at: of its first float; per group of outputs their biases, then for each input their weights.
 * stride: how far apart its rows of outputs are.
 *
 * @typedef {{at: number, inputs: number, groups: number, stride: number, relu: boolean}} Packed
 */

/** Floats that both sides see; what was taken lasts until `reset`. */
export class Arena {
  /** @param {boolean} [wasm] default: if the machine allows it */
  constructor(wasm = true) {
    this._top = 0;
    this._wasm = wasm ? start() : null;
    /** Taking more may replace it. */
    this.floats = this._wasm ? new Float32Array(this._wasm.memory.buffer) : new Float32Array(0);
  }

  /** Whether layers run in WebAssembly. */
  get fast() {
    return !!this._wasm;
  }

  reset() {
    this._top = 0;
  }

  /** Room for so many floats. @param {number} count @returns {number} the index of the first, a multiple of 4 */
  take(count) {
    const at = this._top;
    this._top += (count + 3) & ~3;
    if (this._top > this.floats.length) {
      const pages = Math.ceil((this._top - this.floats.length) / PAGE_FLOATS);
      const old = this.floats;
      if (this._wasm) {
        this._wasm.memory.grow(pages);
        this.floats = new Float32Array(this._wasm.memory.buffer);
      } else {
        this.floats = new Float32Array(old.length + pages * PAGE_FLOATS);
        this.floats.set(old);
      }
    }
    return at;
  }

  /** Takes a layer in. @param {Network[number]} layer @param {boolean} relu whether ReLU follows @returns {Packed} */
  pack({ weight, bias, inputs, outputs }, relu) {
    const groups = Math.ceil(outputs / GROUP);
    const stride = groups * GROUP;
    const at = this.take(stride * (inputs + 1));
    this.floats.fill(0, at, at + stride * (inputs + 1));
    for (let o = 0; o < outputs; o++) {
      let to = at + Math.floor(o / GROUP) * GROUP * (inputs + 1) + (o % GROUP);
      this.floats[to] = bias[o];
      for (let i = 0; i < inputs; i++) this.floats[(to += GROUP)] = weight[o * inputs + i];
    }
    return { at, inputs, groups, stride, relu };
  }

  /**
   * out[r, :] = layer(x[r, :]) for `rows` rows that lie `stride` floats apart.
   *
   * @param {Packed} layer @param {number} rows @param {number} x @param {number} stride @param {number} out
   */
  linear(layer, rows, x, stride, out) {
    if (!rows) return;
    const { at, inputs, groups, relu } = layer;
    const floor = relu ? 0 : -Infinity;
    if (this._wasm) this._wasm.linear(rows, 4 * x, 4 * stride, 4 * at, inputs, groups, 4 * out, floor);
    else linear(this.floats, layer, rows, x, stride, out);
  }
}

/**
 * The reference of the kernel below.
 *
 * @param {Float32Array} floats @param {Packed} layer @param {number} rows @param {number} x @param {number} stride
 * @param {number} out
 */
function linear(floats, { at, inputs, groups, relu }, rows, x, stride, out) {
  const sums = new Float64Array(GROUP);
  for (let r = 0; r < rows; r++, x += stride) {
    let w = at;
    for (let g = 0; g < groups; g++) {
      for (let k = 0; k < GROUP; k++) sums[k] = floats[w++];
      for (let i = 0; i < inputs; i++, w += GROUP) {
        const value = floats[x + i];
        for (let k = 0; k < GROUP; k++) sums[k] += floats[w + k] * value;
      }
      for (let k = 0; k < GROUP; k++) floats[out++] = relu && sums[k] < 0 ? 0 : sums[k];
    }
  }
}

// -- WebAssembly, byte by byte ----------------------------------------------------------------------------------------

const [I32, F32, V128] = [0x7f, 0x7d, 0x7b];
/** @typedef {number[]} Bytes */

/** @param {number} n unsigned @returns {Bytes} LEB128 */
const leb = (n) => (n < 128 ? [n] : [(n & 127) | 128, ...leb(n >> 7)]);
/** @param {number} id @param {Bytes[]} entries @returns {Bytes} a section that is a list */
const section = (id, entries) => sized(id, [...leb(entries.length), ...entries.flat()]);
/** @param {number} id @param {Bytes} content @returns {Bytes} */
const sized = (id, content) => [id, ...leb(content.length), ...content];
/** @param {string} text @returns {Bytes} */
const name = (text) => [...leb(text.length), ...new TextEncoder().encode(text)];

/** @param {number} local @returns {Bytes} */
const get = (local) => [0x20, local];
/** @param {number} local @returns {Bytes} */
const set = (local) => [0x21, local];
/** @param {number} op @param {Bytes} [rest] @returns {Bytes} */
const simd = (op, rest = []) => [0xfd, ...leb(op), ...rest];
/** @param {number} offset bytes @returns {Bytes} aligned to 4 bytes */
const place = (offset) => [2, ...leb(offset)];
/** @param {number} local @param {Bytes} amount @returns {Bytes} */
const advance = (local, amount) => [...get(local), ...amount, 0x6a, ...set(local)];
/** @param {number} n of -64 to 8191 @returns {Bytes} i32.const, in signed LEB128 */
const constant = (n) => [0x41, ...(n < 64 ? [n & 127] : [(n & 127) | 128, n >> 7])];
/** Repeats until a counter is down at 0. @param {number} counter @param {Bytes[]} body @returns {Bytes} */
const countdown = (counter, body) => {
  const again = [...advance(counter, constant(-1)), ...get(counter), 0x0d, 0];
  return [0x03, 0x40, ...body.flat(), ...again, 0x0b];
};

/** linear(rows, x, stride, weights, inputs, groups, out, floor): addresses in bytes; sums below `floor` become it. */
function program() {
  const [ROWS, X, STRIDE, WEIGHTS, INPUTS, GROUPS, OUT, FLOOR, GROUP_LEFT, LEFT, AT, W, VALUE] = Array(13).keys();
  const SUMS = [13, 14, 15, 16];
  const [LOAD, LOAD_SPLAT, STORE, SPLAT, ADD, MUL, MAX] = [0x00, 0x09, 0x0b, 0x13, 0xe4, 0xe6, 0xe9];
  const vectorBytes = 16;
  const groupBytes = constant(VECTORS * vectorBytes);

  const input = [
    [...get(AT), ...simd(LOAD_SPLAT, place(0)), ...set(VALUE)],
    ...SUMS.map((sum, k) => [
      ...[...get(sum), ...get(VALUE), ...get(W), ...simd(LOAD, place(k * vectorBytes))],
      ...[...simd(MUL), ...simd(ADD), ...set(sum)],
    ]),
    advance(W, groupBytes),
    advance(AT, constant(4)),
  ];
  const group = [
    ...SUMS.map((sum, k) => [...get(W), ...simd(LOAD, place(k * vectorBytes)), ...set(sum)]),
    advance(W, groupBytes),
    [...get(X), ...set(AT), ...get(INPUTS), ...set(LEFT)],
    countdown(LEFT, input),
    ...SUMS.map((sum, k) => [
      ...[...get(OUT), ...get(sum), ...get(FLOOR), ...simd(SPLAT), ...simd(MAX)],
      ...simd(STORE, place(k * vectorBytes)),
    ]),
    advance(OUT, groupBytes),
  ];
  const row = [
    [...get(WEIGHTS), ...set(W), ...get(GROUPS), ...set(GROUP_LEFT)],
    countdown(GROUP_LEFT, group),
    advance(X, get(STRIDE)),
  ];
  const locals = [2, 4, I32, 1 + VECTORS, V128]; // two runs: GROUP_LEFT to W, VALUE and the sums
  const body = [...locals, ...countdown(ROWS, row), 0x0b];
  return new Uint8Array([
    ...[0x00, 0x61, 0x73, 0x6d, 1, 0, 0, 0],
    ...section(1, [[0x60, 8, ...Array(7).fill(I32), F32, 0]]),
    ...section(2, [[...name("e"), ...name("m"), 2, 0, 1]]),
    ...section(3, [[0]]),
    ...section(7, [[...name("linear"), 0, 0]]),
    ...section(10, [[...leb(body.length), ...body]]),
  ]);
}

/**
 * The program and its memory; null where there is no WebAssembly with vectors, or a content security policy without
 * 'wasm-unsafe-eval'.
 *
 * @returns {{memory: WebAssembly.Memory, linear: (...args: number[]) => void} | null}
 */
function start() {
  try {
    const memory = new WebAssembly.Memory({ initial: 1 });
    const { exports } = new WebAssembly.Instance(new WebAssembly.Module(program()), { e: { m: memory } });
    return { memory, linear: /** @type {(...args: number[]) => void} */ (exports.linear) };
  } catch {
    return null;
  }
}
