// Lists and orders of Gaussians: plain loops that run in a worker.

/** A list's texel without a Gaussian. */
export const NO_ENTRY = 0xffffffff;
/** Bits of an anchor's number in an entry of a list; the slot lies above. */
export const ANCHOR_BITS = 24;

/**
 * Visible Gaussians, slot after slot. entries: [height, width] texels, an anchor's number and above it the slot, or
 * NO_ENTRY. starts: the row of texels where each slot starts, and where the last one ends. rows: that end.
 *
 * @typedef {{width: number, rows: number, entries: Uint32Array, starts: Uint32Array, count: number}} List
 */

/** Calls listGaussians, in a worker.
 * @typedef {(...args: Parameters<typeof listGaussians>) => Promise<List | null>} Lister */

/**
 * The list of Gaussians whose opacity is above 0, or that `previous` has; null if it would be `previous`.
 *
 * Rows of texels are short where there are few Gaussians, since each slot starts on a new one. Heights are rounded up,
 * so that textures are not made anew for every time.
 *
 * @param {Float32Array} opacities [ceil(slots / 4), anchors, 4] @param {number} slots @param {number} anchors
 * @param {List | null} previous
 * @returns {List | null}
 */
export function listGaussians(opacities, slots, anchors, previous) {
  const kept = new Uint8Array(slots * anchors);
  const counts = new Uint32Array(slots);
  let count = 0;
  for (let i = 0; i < slots; i++) {
    const base = (i >> 2) * anchors * 4 + (i & 3);
    let n = 0;
    for (let a = 0; a < anchors; a++) if (opacities[base + 4 * a] > 0) n += kept[i * anchors + a] = 1;
    counts[i] = n;
    count += n;
  }
  if (previous) {
    let news = count;
    for (const entry of previous.entries) {
      if (entry === NO_ENTRY) continue;
      const i = entry >>> ANCHOR_BITS;
      const at = i * anchors + (entry & (2 ** ANCHOR_BITS - 1));
      if (kept[at]) {
        news--;
      } else {
        kept[at] = 1;
        counts[i]++;
        count++;
      }
    }
    if (news === 0) return null;
  }
  const width = 2 ** Math.max(4, Math.ceil(Math.log2(Math.sqrt(count / 8 + 1))));
  const starts = new Uint32Array(slots + 1);
  for (let i = 0; i < slots; i++) starts[i + 1] = starts[i] + Math.ceil(counts[i] / width);
  const rows = starts[slots];
  const height = Math.max(64, Math.ceil(rows / 64) * 64);
  const entries = new Uint32Array(width * height).fill(NO_ENTRY);
  for (let i = 0; i < slots; i++) {
    let at = starts[i] * width;
    const tag = (i << ANCHOR_BITS) >>> 0;
    for (let a = 0; a < anchors; a++) if (kept[i * anchors + a]) entries[at++] = tag | a;
  }
  return { width, rows, entries, starts, count };
}

const HALF = 65536;

/** Orders Gaussians back to front. It keeps its buffers from call to call. */
export class DepthSort {
  constructor() {
    this._counts = new Uint32Array(HALF);
    this._keys = new Uint32Array(0);
    this._first = new Uint32Array(0);
    this._second = new Uint32Array(0);
  }

  /**
   * The Gaussians in front of the near plane whose opacity is not negative, back to front; of equal depths, the later
   * ones first. Two counting sorts, over 16 bits of the depth's binary32 each.
   *
   * @param {Float32Array} means [n, 4], mean and opacity @param {ArrayLike<number>} row of the view matrix, depth =
   * row · (mean, 1) @param {number} near scene units
   * @returns {Uint32Array}
   */
  sort(means, row, near) {
    const n = means.length / 4;
    if (this._keys.length < n) {
      this._keys = new Uint32Array(n);
      this._first = new Uint32Array(n);
      this._second = new Uint32Array(n);
    }
    const depths = new Float32Array(this._keys.buffer);
    const { _keys: keys, _first: first, _second: second, _counts: counts } = this;
    const [a, b, c, d] = [row[0], row[1], row[2], row[3]];
    let count = 0;
    for (let i = n - 1; i >= 0; i--) {
      const at = 4 * i;
      const depth = a * means[at] + b * means[at + 1] + c * means[at + 2] + d;
      if (!(depth > near && depth < Infinity && means[at + 3] >= 0)) continue;
      depths[i] = depth; // positive: its bits rise with it
      first[count++] = i;
    }
    const out = new Uint32Array(count);
    for (const shift of [0, 16]) {
      const [from, to] = shift ? [second, out] : [first, second];
      counts.fill(0);
      for (let i = 0; i < count; i++) counts[(~keys[from[i]] >>> shift) & 0xffff]++; // descending, hence the complement
      for (let k = 0, place = 0; k < HALF; k++) {
        place += counts[k];
        counts[k] = place - counts[k];
      }
      for (let i = 0; i < count; i++) to[counts[(~keys[from[i]] >>> shift) & 0xffff]++] = from[i];
    }
    return out;
  }
}
