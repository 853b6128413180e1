// Clause 10: the positions section. Its contexts come from sums over the 27 cells around a node's cell.

import { AnsDecoder } from "./ans.js";
import { ByteReader } from "./bytes.js";
import { limitExceeded, malformed } from "./errors.js";
import { MAX_VOXEL } from "./limits.js";

const MAX_DEPTH = 21;
const USED_GRIDS = 3;
/** A box holds enough nodes with more than these. */
const FEW = 7;
/** A cell's side in the units of 10.4. */
const CELL = 512;

/** @param {number} n */
const bitsOf = (n) => 32 - Math.clz32(n);

/**
 * @param {Uint8Array} bytes the section @param {number} rows at least 1
 * @returns {Int32Array} [rows, 3] voxel indices, in Morton order of their offsets from the minimum
 */
export function decodePositions(bytes, rows) {
  const reader = new ByteReader(bytes);
  const axes = [0, 1, 2];
  const minimum = axes.map(() => reader.int32("the minimum of the voxel indices"));
  const depths = axes.map(() => reader.byte("the depths of the axes"));
  for (const depth of depths) if (depth > MAX_DEPTH) throw limitExceeded(`a depth of ${depth}, limit ${MAX_DEPTH}`);
  const box = 2 ** (depths[0] + depths[1] + depths[2]);
  if (rows > box) throw malformed(`${rows} anchors in a box of ${box} voxels`);
  const stream = new AnsDecoder(reader.rest());
  const nodes = walk(stream, depths, rows);
  stream.finish();
  const voxels = new Int32Array(3 * rows);
  for (const axis of axes) {
    const coordinates = nodes[axis];
    let least = Infinity;
    let largest = 0;
    for (let i = 0; i < rows; i++) {
      least = Math.min(least, coordinates[i]);
      largest = Math.max(largest, coordinates[i]);
      voxels[3 * i + axis] = minimum[axis] + coordinates[i];
    }
    if (least !== 0 || bitsOf(largest) !== depths[axis]) {
      throw malformed(`coordinates ${least}..${largest} along an axis of depth ${depths[axis]}`);
    }
    if (minimum[axis] < -MAX_VOXEL || minimum[axis] + largest > MAX_VOXEL) {
      throw malformed(`voxel indices ${minimum[axis]}..${minimum[axis] + largest}, limit ${MAX_VOXEL} in magnitude`);
    }
  }
  return voxels;
}

/**
 * The tree of 10.2.
 *
 * @param {AnsDecoder} stream @param {number[]} depths @param {number} rows
 * @returns {Int32Array[]} the nodes' coordinates along x, y, z
 */
function walk(stream, depths, rows) {
  let nodes = [0, 1, 2].map(() => new Int32Array(rows));
  let halves = [0, 1, 2].map(() => new Int32Array(rows));
  let count = 1;
  /** @type {Grid[]} the finest last */
  let grids = [];
  const flags = new AdaptiveBits(FLAGS);
  const sides = new AdaptiveBits(SIDES);
  const found = {
    flags: new Uint16Array(rows),
    sides: new Uint16Array(rows),
    upper: new Uint8Array(rows),
  };
  const both = new Uint8Array(rows);
  const hits = new Uint8Array(rows);
  const places = new Int32Array(rows + 1);
  for (let level = Math.max(...depths); level > 0; level--) {
    if (!grids.length || grids[grids.length - 1].dense) {
      grids = [...grids.slice(1 - USED_GRIDS), new Grid(nodes, count, level, grids[grids.length - 1] ?? null)];
    }
    for (let axis = 2; axis >= 0; axis--) {
      const along = nodes[axis];
      if (level > depths[axis]) {
        for (let i = 0; i < count; i++) along[i] *= 2;
        continue;
      }
      const unknown = [0, 1, 2].map((a) => (a > axis ? level - 1 : level));
      findContexts(grids, nodes, unknown, axis, found);
      if (count < rows) flags.decode(stream, found.flags, count, both);
      else both.fill(0);
      let singles = 0;
      for (let i = 0; i < count; i++) if (!both[i]) found.sides[singles++] = found.sides[i];
      if (2 * count - singles > rows) throw malformed(`more than the ${rows} voxels declared`);
      sides.decode(stream, found.sides, singles, hits);
      const [x, y, z] = nodes;
      const [x2, y2, z2] = halves;
      const along2 = halves[axis];
      let at = 0;
      for (let i = 0, single = 0; i < count; i++, at++) {
        places[i] = at;
        x2[at] = x[i];
        y2[at] = y[i];
        z2[at] = z[i];
        const p = 2 * along[i];
        along2[at] = p;
        if (both[i]) {
          at++;
          x2[at] = x[i];
          y2[at] = y[i];
          z2[at] = z[i];
          along2[at] = p + 1;
        } else if (hits[single++] === found.upper[i]) along2[at] = p + 1;
      }
      places[count] = at;
      for (const grid of grids) grid.move(places);
      [nodes, halves] = [halves, nodes];
      count = at;
    }
  }
  if (count !== rows) throw malformed(`${count} voxels, ${rows} declared`);
  return nodes;
}

/** By the way from a cell to one around it, (dx + 1) + 3 (dy + 1) + 9 (dz + 1), how far its corner lies, 1/512 of a cell. */
const WAYS = 27;
const FAR_X = Float64Array.from({ length: WAYS }, (_, way) => CELL * ((way % 3) - 1));
const FAR_Y = Float64Array.from({ length: WAYS }, (_, way) => CELL * ((Math.floor(way / 3) % 3) - 1));
const FAR_Z = Float64Array.from({ length: WAYS }, (_, way) => CELL * (Math.floor(way / 9) - 1));

/** A way out of child x + 2 y + 4 z of a cell, at 27 child + way: the way out of that cell, and the child there. */
const OUTER_WAY = new Uint8Array(8 * WAYS);
const OUTER_CHILD = new Uint8Array(8 * WAYS);
for (let child = 0, at = 0; child < 8; child++) {
  for (let way = 0; way < WAYS; way++, at++) {
    for (let axis = 0, three = 1; axis < 3; axis++, three *= 3) {
      const place = ((child >> axis) & 1) + (Math.floor(way / three) % 3) - 1;
      OUTER_WAY[at] += three * ((place >> 1) + 1);
      OUTER_CHILD[at] += (place & 1) << axis;
    }
  }
}

/** How many bits are set. */
const ONES = Uint8Array.from({ length: 256 }, (_, byte) => byte.toString(2).replaceAll("0", "").length);

/**
 * The nodes of one level as the cells of a grid (10.3), with the run of nodes of now that lie in each, and the sums of
 * 10.4 over those in a cell's box of 27 cells: first and second moments, in the order x y z xx xy xz yy yz zz, of the
 * centres in units of 1/512 of a cell, relative to the cell's lower corner. They stay below 2^46.
 */
class Grid {
  /** @param {Int32Array[]} nodes @param {number} count @param {number} level
   * @param {Grid | null} coarser the grid of the level before, as there are no gaps; null for the root alone */
  constructor(nodes, count, level, coarser) {
    this.level = level;
    this.cells = count;
    /** Of each cell its first node; one more for the end. @type {Int32Array} */
    this.start = new Int32Array(count + 1);
    for (let c = 0; c <= count; c++) this.start[c] = c;
    /** Of each cell the cell of the coarser grid around it. @type {Int32Array} */
    this.parent = new Int32Array(count);
    /** Of cell c the cells around it that have nodes, itself included, are around[first[c] .. first[c + 1] - 1].
     * @type {Int32Array} */
    this.first = new Int32Array(count + 1);
    /** @type {Int32Array} */
    this.around = new Int32Array(1);
    /** The ways there. @type {Uint8Array} */
    this.ways = Uint8Array.of(Math.floor(WAYS / 2));
    this.first[count] = 1;
    if (coarser) this._connect(nodes, coarser);
    this.dense = count < 100 || this.first[count] - count >= 5 * count;
    /** The sums over the box of the cell asked for last. Cells are asked for in order, each a few times on end. */
    this.sums = new Float64Array(9);
    this._summed = -1;
    this._counted = -1;
    this._count = 0;
    this._ready = false;
    this._nodes = nodes;
    this._unknown = [0, 0, 0];
    /** The places of the nodes' centres in their cells, 0..511, [node][axis]. */
    this.places = new Float64Array(0);
    /** Of this split: what is added to C_ii, h, the density without neighbours, and the scale (10.4). */
    this.priors = [0, 0, 0];
    this.h = 0;
    this.emptiness = 0;
    this.scale = 0;
  }

  /** Finds the cells around each cell among the children of those around its parent. @param {Int32Array[]} nodes
   * @param {Grid} coarser */
  _connect([x, y, z], coarser) {
    const { cells, parent, first } = this;
    const { start } = coarser;
    /** Of each coarser cell, which children it has: they stand in this order. */
    const children = new Uint8Array(coarser.cells);
    for (let p = 0; p < coarser.cells; p++) {
      for (let c = start[p]; c < start[p + 1]; c++) {
        parent[c] = p;
        children[p] |= 1 << ((x[c] & 1) + 2 * (y[c] & 1) + 4 * (z[c] & 1));
      }
    }
    let around = new Int32Array(8 * cells + WAYS);
    let ways = new Uint8Array(8 * cells + WAYS);
    const near = new Int32Array(WAYS);
    let at = 0;
    for (let p = 0; p < coarser.cells; p++) {
      near.fill(-1);
      for (let k = coarser.first[p]; k < coarser.first[p + 1]; k++) near[coarser.ways[k]] = coarser.around[k];
      for (let c = start[p]; c < start[p + 1]; c++) {
        if (at + WAYS > around.length) {
          [around, ways] = [grown(around), grown(ways)];
        }
        const from = WAYS * ((x[c] & 1) + 2 * (y[c] & 1) + 4 * (z[c] & 1));
        for (let way = 0; way < WAYS; way++) {
          const other = near[OUTER_WAY[from + way]];
          if (other < 0) continue;
          const child = 1 << OUTER_CHILD[from + way];
          if (!(children[other] & child)) continue;
          around[at] = start[other] + ONES[children[other] & (child - 1)];
          ways[at++] = way;
        }
        first[c + 1] = at;
      }
    }
    this.around = around;
    this.ways = ways;
  }

  /** After a split: node i has become node places[i], and the next one if it was halved. @param {Int32Array} places */
  move(places) {
    const { start } = this;
    for (let c = 0; c <= this.cells; c++) start[c] = places[start[c]];
  }

  /** Before a split along `axis`: the nodes, and the number of unknown bits along each axis.
   * @param {Int32Array[]} nodes @param {number[]} unknown @param {number} axis */
  begin(nodes, unknown, axis) {
    const { level } = this;
    this._summed = this._counted = -1;
    this._ready = false;
    this._nodes = nodes;
    this._unknown = unknown;
    this.priors = unknown.map((bits) => Math.max(2 ** (2 * Math.max(9 - level + bits, 0) - 3), 1));
    this.h = Math.max(8 - level + unknown[axis], 0);
    this.emptiness = 16 * (3 * level - unknown[0] - unknown[1] - unknown[2]);
    this.scale = Math.min(level - unknown[axis], SCALES - 1);
  }

  /** The number of nodes in a cell's box. @param {number} cell */
  count(cell) {
    if (this._counted === cell) return this._count;
    const { start, around } = this;
    let n = 0;
    for (let k = this.first[cell], end = this.first[cell + 1]; k < end; k++) {
      const other = around[k];
      n += start[other + 1] - start[other];
    }
    this._counted = cell;
    this._count = n;
    return n;
  }

  /** Finds `places`, if they are not those of this split. */
  _prepare() {
    if (this._ready) return;
    this._ready = true;
    const { level } = this;
    const count = this.start[this.cells];
    if (this.places.length < 3 * count) this.places = new Float64Array(3 * Math.min(2 * count, this._nodes[0].length));
    const places = this.places;
    const mask = (2 << level) - 1;
    const up = Math.max(8 - level, 0), down = Math.max(level - 8, 0);
    for (let axis = 0; axis < 3; axis++) {
      const nodes = this._nodes[axis];
      const shift = this._unknown[axis] + 1;
      const half = 1 << (shift - 1);
      for (let i = 0, at = axis; i < count; i++, at += 3) {
        places[at] = ((((nodes[i] << shift) + half) & mask) << up) >> down;
      }
    }
  }

  /** Forms `sums` of a cell. @param {number} cell */
  sum(cell) {
    if (this._summed === cell) return;
    this._summed = cell;
    this._prepare();
    const { start, around, ways, places } = this;
    let x = 0, y = 0, z = 0, xx = 0, xy = 0, xz = 0, yy = 0, yz = 0, zz = 0;
    for (let k = this.first[cell], last = this.first[cell + 1]; k < last; k++) {
      const other = around[k];
      const way = ways[k];
      const dx = FAR_X[way], dy = FAR_Y[way], dz = FAR_Z[way];
      for (let i = 3 * start[other], end = 3 * start[other + 1]; i < end; i += 3) {
        const a = places[i] + dx, b = places[i + 1] + dy, c = places[i + 2] + dz;
        x += a;
        y += b;
        z += c;
        xx += a * a;
        xy += a * b;
        xz += a * c;
        yy += b * b;
        yz += b * c;
        zz += c * c;
      }
    }
    const { sums } = this;
    sums[0] = x;
    sums[1] = y;
    sums[2] = z;
    sums[3] = xx;
    sums[4] = xy;
    sums[5] = xz;
    sums[6] = yy;
    sums[7] = yz;
    sums[8] = zz;
  }
}

/** Twice as long. @template {Int32Array | Uint8Array} A @param {A} array @returns {A} */
function grown(array) {
  const longer = /** @type {A} */ (array instanceof Int32Array ? new Int32Array(2 * array.length) : new Uint8Array(2 * array.length));
  longer.set(array);
  return longer;
}

/** Of a quotient up to 512, how many of the steps of `pull` are at most as large. */
const PULLS = /* @__PURE__ */ (() => {
  const pulls = new Uint8Array(513);
  for (const step of [1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256, 512]) {
    for (let q = step; q < pulls.length; q++) pulls[q]++;
  }
  return pulls;
})();

/** L of 10.4 for N = 0..4096: the floor of 8 log2 N. */
const EIGHTHS = /* @__PURE__ */ (() => {
  const eighths = new Uint8Array(4097);
  for (let l = 1; l <= 96; l++) {
    const least = l % 8 ? Math.ceil(2 ** (l / 8)) : 2 ** (l / 8);
    eighths.fill(l, least);
  }
  return eighths;
})();

const SHARPNESSES = 10;
const DENSITIES = 40;
const PULL_GROUPS = 5;
const SCALES = 5;

/** Where the second moment of two axes stands among the sums. */
const PAIR = [
  [3, 4, 5],
  [4, 6, 7],
  [5, 7, 8],
];

/**
 * The contexts of 10.5 of every node, and whether its upper half is the expected one (10.4).
 *
 * @param {Grid[]} grids the finest last @param {Int32Array[]} nodes @param {number[]} unknown bits along each axis
 * @param {number} axis @param {{flags: Uint16Array, sides: Uint16Array, upper: Uint8Array}} out
 */
function findContexts(grids, nodes, unknown, axis, out) {
  for (const grid of grids) grid.begin(nodes, unknown, axis);
  const b = (axis + 1) % 3;
  const c = (axis + 2) % 3;
  const atAA = PAIR[axis][axis], atAB = PAIR[axis][b], atAC = PAIR[axis][c];
  const atBB = PAIR[b][b], atBC = PAIR[b][c], atCC = PAIR[c][c];
  const finest = grids[grids.length - 1];
  const { flags, sides, upper } = out;
  for (let first = 0; first < finest.cells; first++) {
    let grid = finest;
    let cell = first;
    let n = grid.count(cell);
    for (let g = grids.length - 2; g >= 0 && n <= FEW; g--) {
      cell = grid.parent[cell];
      grid = grids[g];
      n = grid.count(cell);
    }
    grid.sum(cell);
    const { places, h, scale } = grid;
    const divisor = Math.max(n - 1, 1);
    const fullness = 3 * EIGHTHS[Math.min(n - 1, 4096)] - grid.emptiness;
    const density = clip(Math.floor(fullness / 12) + 30, 0, DENSITIES - 1);
    const priorA = grid.priors[axis], priorB = grid.priors[b], priorC = grid.priors[c];
    const { sums } = grid;
    const sa = sums[axis], sb = sums[b], sc = sums[c];
    const saa = sums[atAA], sab = sums[atAB], sac = sums[atAC];
    const sbb = sums[atBB], sbc = sums[atBC], scc = sums[atCC];
    for (let i = finest.start[first]; i < finest.start[first + 1]; i++) {
      const ra = places[3 * i + axis], rb = places[3 * i + b], rc = places[3 * i + c];
      const da = sa - n * ra, db = sb - n * rb, dc = sc - n * rc;
      const ma = Math.floor((da * 16) / divisor);
      const mb = Math.floor((db * 16) / divisor);
      const mc = Math.floor((dc * 16) / divisor);
      const caa = ((Math.floor(((saa - ra * (sa + da)) * 256) / divisor) - ma * ma) >> 8) + priorA;
      const cbb = ((Math.floor(((sbb - rb * (sb + db)) * 256) / divisor) - mb * mb) >> 8) + priorB;
      const ccc = ((Math.floor(((scc - rc * (sc + dc)) * 256) / divisor) - mc * mc) >> 8) + priorC;
      const cab = (Math.floor(((sab - ra * sb - rb * da) * 256) / divisor) - ma * mb) >> 8;
      const cac = (Math.floor(((sac - ra * sc - rc * da) * 256) / divisor) - ma * mc) >> 8;
      const cbc = (Math.floor(((sbc - rb * sc - rc * db) * 256) / divisor) - mb * mc) >> 8;
      const aa = cbb * ccc - cbc * cbc;
      const ab = cac * cbc - cab * ccc;
      const ac = cab * cbc - cac * cbb;
      const code = judge(caa, cab, cac, aa, ab, ac, ma, mb, mc, h);
      const pull = (code >> 1) & 31;
      const sharpness = code >> 6;
      upper[i] = code & 1;
      flags[i] = (density * SHARPNESSES + sharpness) * PULL_GROUPS + Math.min((pull / 3) | 0, PULL_GROUPS - 1);
      sides[i] = (pull * SHARPNESSES + sharpness) * SCALES + scale;
    }
  }
}

/** @param {number} value @param {number} least @param {number} most */
const clip = (value, least, most) => Math.min(Math.max(value, least), most);

/**
 * Whether P > 0, pull and sharpness of 10.4, as upper + 2 pull + 64 sharpness. D and P may pass 2^53: where binary64
 * does not decide, whole numbers do. (Without neighbours P is 0 and so is pull.)
 *
 * @param {number} caa @param {number} cab @param {number} cac @param {number} aa @param {number} ab @param {number} ac
 * @param {number} ma @param {number} mb @param {number} mc @param {number} h
 */
function judge(caa, cab, cac, aa, ab, ac, ma, mb, mc, h) {
  const d = caa * aa + cab * ab + cac * ac;
  const p = aa * ma + ab * mb + ac * mc;
  const scale = 1 << h; // h is at most 8
  const sharp = aa * (16 * scale * scale);
  const mostD = Math.abs(caa * aa) + Math.abs(cab * ab) + Math.abs(cac * ac);
  const mostP = Math.abs(aa * ma) + Math.abs(ab * mb) + Math.abs(ac * mc);
  if (mostD < 2 ** 52 && mostP < 2 ** 52) {
    const whole = Math.max(d, 1);
    const pull = Math.floor(Math.abs(p) / Math.max(Math.floor(whole / scale), 1));
    return verdict(p > 0, pull, Math.floor(sharp / whole));
  }
  // The sums of three rounded products err by less than 2^-50 of the sum of magnitudes.
  const errorD = mostD * 2 ** -50;
  const errorP = mostP * 2 ** -50;
  const least = d - errorD;
  const leastHigh = least / scale - 1;
  if (leastHigh >= 1 && Math.abs(p) > errorP) {
    const most = d + errorD;
    const low = verdict(p > 0, ((Math.abs(p) - errorP) / (most / scale)) * (1 - 2 ** -50), (sharp / most) * (1 - 2 ** -50));
    const high = verdict(p > 0, ((Math.abs(p) + errorP) / leastHigh) * (1 + 2 ** -50), (sharp / least) * (1 + 2 ** -50));
    if (low === high) return low;
  }
  return exactly([caa, cab, cac], [aa, ab, ac], [ma, mb, mc], h);
}

/** @param {boolean} upper @param {number} pull quotient @param {number} sharpness quotient */
function verdict(upper, pull, sharpness) {
  return (upper ? 1 : 0) + 2 * PULLS[Math.min(pull, 512) | 0] + 64 * bitsOf(clip(sharpness, 0, 256));
}

/** @param {number[]} row @param {number[]} adjugate @param {number[]} means @param {number} h */
function exactly(row, adjugate, means, h) {
  /** @param {number[]} values */
  const against = (values) => values.reduce((sum, v, i) => sum + BigInt(v) * BigInt(adjugate[i]), 0n);
  const most = (/** @type {bigint} */ a, /** @type {bigint} */ b) => (a > b ? a : b);
  const d = most(against(row), 1n);
  const p = against(means);
  const pull = (p < 0n ? -p : p) / most(d >> BigInt(h), 1n);
  const sharpness = (BigInt(adjugate[0]) << BigInt(2 * h + 4)) / d;
  return verdict(p > 0n, Number(pull), Number(sharpness));
}

/** Of each context of a family of sequences its parent and grandparent. @typedef {{parents: Uint16Array, grands: Uint16Array}} Family */

/** Sequence 1: (density, sharpness, pull group). */
const FLAGS = /* @__PURE__ */ family(DENSITIES * SHARPNESSES * PULL_GROUPS, (context) => {
  const group = context % PULL_GROUPS;
  const half = Math.floor(context / PULL_GROUPS / 2) % (SHARPNESSES / 2);
  const grand = half * PULL_GROUPS + group;
  const density = Math.floor(context / PULL_GROUPS / SHARPNESSES);
  return [(density >> 1) * (SHARPNESSES / 2) * PULL_GROUPS + grand, grand];
});

/** Sequence 2: (pull, sharpness, scale). */
const SIDES = /* @__PURE__ */ family(18 * SHARPNESSES * SCALES, (context) => {
  const pull = Math.floor(context / SCALES / SHARPNESSES);
  return [pull * SCALES + (context % SCALES), pull];
});

/** @param {number} contexts @param {(context: number) => number[]} ancestors @returns {Family} */
function family(contexts, ancestors) {
  const parents = new Uint16Array(contexts);
  const grands = new Uint16Array(contexts);
  for (let context = 0; context < contexts; context++) [parents[context], grands[context]] = ancestors(context);
  return { parents, grands };
}

/** A long sequence's passes: of each 16 elements the first of a pass, one more for the end; a short one has one pass. */
const PASSES = [0, 1, 3, 7, 16];
const PERIOD = 16;
const ONE_PASS = [0, PERIOD];
const LONG = 64;
const MOST = 12288;
/** Probabilities are one of these many; in their order they stand for P(1) ascending. */
const LEVELS = 89;
const EVEN = 44;

/** P(0) · 2^24 of each. */
const ZEROS = /* @__PURE__ */ Int32Array.from({ length: LEVELS }, (_, index) => {
  const i = index <= EVEN ? index : 2 * EVEN - index;
  const k = (i >> 2) + 2;
  const q = Math.min(((4 + (i & 3)) << k) + (1 << (k - 1)), 32768);
  return (index <= EVEN ? 65536 - q : q) << 8;
});

/** The bits of 10.5: counts per context, and sequences decoded with them. */
class AdaptiveBits {
  /** @param {Family} family */
  constructor({ parents, grands }) {
    this._parents = parents;
    this._grands = grands;
    // (c0, c1) one behind the other; in a pass they may pass 2^32
    this._own = new Float64Array(2 * parents.length);
    this._ofParents = new Float64Array(2 * parents.length);
    this._ofGrands = new Float64Array(2 * parents.length);
    /** Of each context its probability in this pass, and the pass it is of. */
    this._level = new Uint8Array(parents.length);
    this._pass = new Int32Array(parents.length);
    this._passes = 0;
    this._touched = new Uint16Array(parents.length);
    this._order = new Int32Array(0);
  }

  /**
   * A sequence of `count` bits.
   *
   * @param {AnsDecoder} stream @param {Uint16Array} contexts of its elements @param {number} count
   * @param {Uint8Array} out
   */
  decode(stream, contexts, count, out) {
    if (this._order.length < count) this._order = new Int32Array(Math.max(count, 2 * this._order.length));
    const passes = count < LONG ? ONE_PASS : PASSES;
    for (let k = 0; k + 1 < passes.length; k++) {
      this._decodePass(stream, contexts, count, passes[k], passes[k + 1], out);
    }
  }

  /** The elements whose index modulo 16 is in begin..end - 1. @param {AnsDecoder} stream @param {Uint16Array} contexts
   * @param {number} count @param {number} begin @param {number} end @param {Uint8Array} out */
  _decodePass(stream, contexts, count, begin, end, out) {
    const levels = this._level;
    const order = this._order;
    const stamp = ++this._passes;
    let touched = 0;
    const next = new Int32Array(LEVELS + 1);
    for (let block = 0; block < count; block += PERIOD) {
      const stop = Math.min(block + end, count);
      for (let i = block + begin; i < stop; i++) {
        const context = contexts[i];
        if (this._pass[context] !== stamp) {
          this._pass[context] = stamp;
          levels[context] = this._levelOf(context);
          this._touched[touched++] = context;
        }
        next[levels[context] + 1]++;
      }
    }
    for (let level = 0; level < LEVELS; level++) next[level + 1] += next[level];
    for (let block = 0; block < count; block += PERIOD) {
      const stop = Math.min(block + end, count);
      for (let i = block + begin; i < stop; i++) order[next[levels[contexts[i]]]++] = i;
    }
    for (let level = 0, from = 0; level < LEVELS; level++) { // next[level] has moved to the level's end
      if (next[level] > from) stream.bits(ZEROS[level], order, from, next[level], out);
      from = next[level];
    }
    const own = this._own, parents = this._ofParents, grands = this._ofGrands;
    for (let k = 0; k < next[LEVELS]; k++) {
      const context = contexts[order[k]];
      const bit = out[order[k]];
      own[2 * context + bit] += 256;
      parents[2 * this._parents[context] + bit] += 256;
      grands[2 * this._grands[context] + bit] += 256;
    }
    for (let k = 0; k < touched; k++) {
      const context = this._touched[k];
      limit(own, context);
      limit(parents, this._parents[context]);
      limit(grands, this._grands[context]);
    }
  }

  /** The place of a context's P(1) among the probabilities. @param {number} context */
  _levelOf(context) {
    let p = blend(32768, this._ofGrands, this._grands[context], 1);
    p = blend(p, this._ofParents, this._parents[context], 16);
    p = blend(p, this._own, context, 16);
    const q = Math.max(Math.min(p, 65536 - p), 16);
    const k = bitsOf(q) - 3;
    const level = 4 * (k - 2) + (q >> k) - 4;
    return p < 32768 ? level : 2 * EVEN - level;
  }
}

/** @param {number} p @param {Float64Array} counts @param {number} context @param {number} weight */
function blend(p, counts, context, weight) {
  const c0 = counts[2 * context];
  const c1 = counts[2 * context + 1];
  return Math.floor((65536 * c1 + 256 * weight * p) / (c0 + c1 + 256 * weight));
}

/** Keeps a context's counts small. @param {Float64Array} counts @param {number} context */
function limit(counts, context) {
  const c0 = counts[2 * context];
  const c1 = counts[2 * context + 1];
  const sum = c0 + c1;
  if (sum <= MOST) return;
  counts[2 * context] = Math.floor((MOST * c0) / sum);
  counts[2 * context + 1] = Math.floor((MOST * c1) / sum);
}
