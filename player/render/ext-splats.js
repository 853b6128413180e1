// Gaussians as Spark's ExtSplats hold them (2.2): two arrays of four 32-bit numbers each. First the centre as floats and
// the opacity; then colour, logarithms of scales, and the rotation's axis, as a point on an octahedron, and angle. What is
// no float of 32 bits is one of 16, two in a number, the first in its lower half.

/** @import { Texels } from "./level.js" */

/** extArrays: [splats, 4] each, whole rows of ROW. still: as in Texels.
 * @typedef {{count: number, extArrays: Uint32Array[], still: number}} Packed */

/** Splats in a row of Spark's textures. */
const ROW = 2048;
/** Room for more Gaussians than there are, as their number changes with time. */
const SPARE = 1.25;

const float = new Float32Array(1);
const bits = new Uint32Array(float.buffer);

/** The bits of the nearest 16-bit float, the largest one instead of infinity. @param {number} x */
function half(x) {
  float[0] = x;
  const sign = (bits[0] >>> 16) & 0x8000;
  const size = bits[0] & 0x7fffffff;
  if (size < 0x38800000) return sign | Math.round(Math.abs(x) * 2 ** 24);
  return sign | Math.min(0x7bff, (size - 0x38000000 + 0x0fff + ((size >>> 13) & 1)) >>> 13);
}

/** @param {number} low @param {number} high */
const halves = (low, high) => (half(low) | (half(high) << 16)) >>> 0;

/** @param {number} w @param {number} x @param {number} y @param {number} z of a quaternion of length 1 */
function rotation(w, x, y, z) {
  const sign = w < 0 ? -1 : 1;
  const sine = Math.sqrt(x * x + y * y + z * z);
  const reach = (Math.abs(x) + Math.abs(y) + Math.abs(z)) * sign;
  let u = sine < 1e-6 ? 1 : x / reach;
  let v = sine < 1e-6 ? 0 : y / reach;
  if (sine >= 1e-6 && z * sign < 0) {
    const along = 1 - Math.abs(v);
    v = (1 - Math.abs(u)) * (v < 0 ? -1 : 1);
    u = along * (u < 0 ? -1 : 1);
  }
  const angle = Math.round(2 * Math.acos(Math.min(1, Math.abs(w))) * (4095 / Math.PI));
  return ((angle << 20) | (Math.round((v / 2 + 0.5) * 1023) << 10) | Math.round((u / 2 + 0.5) * 1023)) >>> 0;
}

/** @param {Texels} texels @param {Packed | null} [spare] earlier ones, whose room is taken if it fits @returns {Packed} */
export function packed({ count, data, still, changing }, spare = null) {
  const fits = spare && 4 * count <= spare.extArrays[0].length && spare.extArrays[0].length <= 4 * (2 * SPARE * count + ROW);
  const room = 4 * ROW * Math.ceil((SPARE * count) / ROW);
  const extArrays = fits ? spare.extArrays : [new Uint32Array(room), new Uint32Array(room)];
  const blocks = fits && still && spare.still === still ? changing : [0, 1, 2, 3];
  const [first, second] = extArrays;
  const [size, turn, color] = [1, 2, 3].map((block) => (block * data.length) / 4);
  const end = 4 * count;
  if (blocks.includes(0)) {
    new Float32Array(first.buffer).set(data.subarray(0, end));
    for (let i = 3; i < end; i += 4) first[i] = half(data[i]);
  }
  if (blocks.includes(1) || blocks.includes(3)) {
    for (let i = 0, s = size, c = color; i < end; i += 4, s += 4, c += 4) {
      second[i] = halves(data[c], data[c + 1]);
      second[i + 1] = halves(data[c + 2], Math.log(data[s]));
      second[i + 2] = halves(Math.log(data[s + 1]), Math.log(data[s + 2]));
    }
  }
  if (blocks.includes(2)) {
    for (let i = 3, q = turn; i < end; i += 4, q += 4) {
      second[i] = rotation(data[q], data[q + 1], data[q + 2], data[q + 3]);
    }
  }
  return { count, extArrays, still };
}
