// A deformation on the GPU: planes, trunk and heads at points that lie in a texture.

import { blocksOf, Linear, repeat, targets, TooLarge } from "./layers.js";
import { cellsOf, headsIn, sliceAt, SPATIAL } from "./level.js";
import { anchorColumns } from "./record.js";
/** @import { Network } from "../decode/tensors.js" */
/** @import { Deformation, Scale, AnchorScene } from "../kinds/index.js" */
/** @import { Field, Gpu } from "./gl.js" */

/** Source of the functions that sample planes. */
const SAMPLER = `uniform sampler2DArray points, planes, rows;
uniform vec3 low, high, cells;
uniform int firstRow, shift, block;
vec3 place(vec3 p) {
  vec3 u = (p - low) / (high - low);
  return vec3(p.x > low.x ? p.x >= high.x ? 1. : u.x : 0., p.y > low.y ? p.y >= high.y ? 1. : u.y : 0.,
    p.z > low.z ? p.z >= high.z ? 1. : u.z : 0.);
}
vec4 plane(int z, ivec2 a, ivec2 b, vec2 f) {
  return mix(mix(texelFetch(planes, ivec3(a, z), 0), texelFetch(planes, ivec3(b.x, a.y, z), 0), f.x),
    mix(texelFetch(planes, ivec3(a.x, b.y, z), 0), texelFetch(planes, ivec3(b, z), 0), f.x), f.y);
}
vec4 row(int y, int a, int b, float f, int z) {
  return mix(texelFetch(rows, ivec3(a, y, z), 0), texelFetch(rows, ivec3(b, y, z), 0), f);
}
`;

export class FieldPass {
  /** @param {Gpu} gpu @param {Deformation} deformation @param {AnchorScene} scene */
  constructor(gpu, deformation, scene) {
    this._gpu = gpu;
    this._deformation = deformation;
    this._box = scene.info.box;
    const { channels } = deformation.planes[0].xy;
    this._scales = deformation.planes.length;
    this._channelBlocks = blocksOf(channels);
    const { trunk } = deformation;
    // a scale's channels are padded to whole blocks; so are the columns that take them
    const first = padInputs(trunk[0], channels, this._scales);
    const layers = [first, ...trunk.slice(1), joinHeads(deformation, scene)];
    this._linears = layers.map((layer) => new Linear(gpu, layer));
    this._scratchBlocks = Math.max(
      this._scales * this._channelBlocks,
      ...this._linears.slice(0, -1).map((linear) => linear.paddedBlocks),
    );
    if (this._scratchBlocks > gpu.maxLayers) throw new TooLarge(`a network of ${4 * this._scratchBlocks} outputs`);
    /** What the outputs' field must have room for. */
    this.outputBlocks = this._linears[this._linears.length - 1].paddedBlocks;
    this._planes = deformation.planes.map((planes) => this._upload(planes));
    this._cells = Math.max(...deformation.planes.flatMap(cellsOf));
    if (this._cells > gpu.maxSide) throw new TooLarge(`${this._cells} cells`);
    this._rowData = new Float32Array(this._channelBlocks * 3 * this._scales * this._cells * 4);
    this._rows = gpu.field(this._cells, 3 * this._scales, this._channelBlocks);
    /** @type {number | null} */
    this._time = null;
    /** @type {Field[]} */
    this._scratch = [];
  }

  /** The three spatial planes of a scale, block after block. @param {Scale} planes */
  _upload(planes) {
    const gpu = this._gpu;
    const width = Math.max(...SPATIAL.map(([name]) => planes[name].width));
    const height = Math.max(...SPATIAL.map(([name]) => planes[name].height));
    const layers = 3 * this._channelBlocks;
    const fits = Math.max(width, height) <= gpu.maxSide && layers <= gpu.maxLayers;
    if (!fits) throw new TooLarge(`planes of ${width} × ${height} × ${4 * this._channelBlocks}`);
    const data = new Float32Array(layers * width * height * 4);
    SPATIAL.forEach(([name], p) => {
      const plane = planes[name];
      for (let c = 0; c < plane.channels; c++) {
        const to = (p * this._channelBlocks + (c >> 2)) * height * width * 4 + (c & 3);
        const from = c * plane.height * plane.width;
        for (let j = 0; j < plane.height; j++) {
          for (let i = 0; i < plane.width; i++) data[to + (j * width + i) * 4] = plane.data[from + j * plane.width + i];
        }
      }
    });
    return gpu.field(width, height, layers, data);
  }

  /** Brings the rows to time t. @param {number} t 0..1 */
  _setTime(t) {
    if (t === this._time) return;
    this._time = t;
    const { _cells: cells, _scales: scales, _rowData: data } = this;
    this._deformation.planes.forEach((planes, s) =>
      [0, 1, 2].forEach((axis) =>
        sliceAt(planes, axis, t, (c, i, value) => {
          data[(((c >> 2) * 3 * scales + 3 * s + axis) * cells + i) * 4 + (c & 3)] = value;
        }),
      ),
    );
    this._gpu.write(this._rows, data);
  }

  /**
   * Residuals at points, into a field of at least `outputBlocks` blocks. Block 0 of `points` holds their positions.
   *
   * @param {number} t 0..1 @param {Field} points @param {number} rows rows of texels that count @param {Field} out of
   * the points' size
   */
  run(t, points, rows, out) {
    this._setTime(t);
    const band = Math.max(1, Math.floor(this._gpu.bandPoints / points.width));
    for (let row = 0; row < rows; row += band) this._runBand(points, row, Math.min(band, rows - row), out);
  }

  /** @param {Field} points @param {number} row @param {number} rows @param {Field} out */
  _runBand(points, row, rows, out) {
    const gpu = this._gpu;
    const { gl } = gpu;
    const B = this._channelBlocks;
    const some = Math.min(B, gpu.maxTargets);
    const program = gpu.program(
      targets(some) +
        SAMPLER +
        `void main() {
vec3 u = place(texelFetch(points, ivec3(gl_FragCoord.xy, 0) + ivec3(0, shift, 0), 0).xyz);
${this._sample(some)}
${repeat(some, (i) => `out${i} = h${i};`)}}`,
    );
    let from = this._room(0, points.width, rows);
    this._planes.forEach((planes, s) => {
      gpu.use(program, { points, planes, rows: this._rows });
      gl.uniform3fv(program.uniform("low"), this._box[0]);
      gl.uniform3fv(program.uniform("high"), this._box[1]);
      gl.uniform3fv(program.uniform("cells"), cellsOf(this._deformation.planes[s]));
      gl.uniform1i(program.uniform("firstRow"), 3 * s);
      gl.uniform1i(program.uniform("shift"), row);
      for (let b = 0; b < B; b += some) {
        const first = Math.min(b, B - some);
        gl.uniform1i(program.uniform("block"), first);
        gpu.cover(from, s * B + first, some, 0, rows);
      }
    });
    this._linears.forEach((linear, i) => {
      const last = i === this._linears.length - 1;
      const to = last ? out : this._room((i + 1) % 2, points.width, rows);
      runLinear(gpu, linear, from, to, last ? row : 0, rows, !last);
      from = to;
    });
  }

  /** A scratch field. @param {number} i 0 or 1 @param {number} width @param {number} rows */
  _room(i, width, rows) {
    const had = this._scratch[i];
    if (had && had.width === width && had.height >= rows) return had;
    this._gpu.free(had);
    return (this._scratch[i] = this._gpu.field(width, rows, this._scratchBlocks));
  }

  /** Source that samples the planes of a scale at u. @param {number} blocks of channels, from `block` on */
  _sample(blocks) {
    const B = this._channelBlocks;
    const names = ["x", "y", "z"];
    return `vec3 at = u * (cells - 1.);
ivec3 a = ivec3(at), b = min(a + 1, ivec3(cells) - 1);
vec3 f = at - vec3(a);
${repeat(blocks, (c) => {
  const spatial = SPATIAL.map(([, i, j], p) => {
    const ij = names[i] + names[j];
    return `plane(block + ${p * B + c}, a.${ij}, b.${ij}, f.${ij})`;
  });
  const rows = names.map((n, p) => `row(firstRow + ${p}, a.${n}, b.${n}, f.${n}, block + ${c})`);
  return `vec4 h${c} = ${[...spatial, ...rows].join("\n  * ")};`;
})}`;
  }

  free() {
    this._gpu.free(...this._planes, this._rows, ...this._scratch, ...this._linears.map(({ buffer }) => buffer));
  }
}

/**
 * One linear layer from the first rows of a field to rows of another.
 *
 * @param {Gpu} gpu @param {Linear} linear @param {Field} from @param {Field} to
 * @param {number} row @param {number} rows of texels, in `to` @param {boolean} relu
 */
function runLinear(gpu, linear, from, to, row, rows, relu) {
  const program = gpu.program(
    linear.declare() +
      `uniform sampler2DArray source;
uniform int row;
void main() {
ivec2 p = ivec2(gl_FragCoord.xy) - ivec2(0, row);
${repeat(linear.inputBlocks, (k) => `vec4 x${k} = texelFetch(source, ivec3(p, ${k}), 0);`)}
${linear.apply(relu)}
${repeat(linear.chunkBlocks, (i) => `out${i} = y${i};`)}}`,
  );
  gpu.use(program, { source: from });
  gpu.gl.uniform1i(program.uniform("row"), row);
  linear.cover(to, row, rows);
}

/**
 * The layer with the columns of each scale padded to whole blocks.
 *
 * @param {Network[number]} layer @param {number} channels @param {number} scales
 * @returns {Network[number]}
 */
function padInputs(layer, channels, scales) {
  const padded = 4 * blocksOf(channels);
  if (padded === channels) return layer;
  const weight = new Float32Array(layer.outputs * padded * scales);
  for (let o = 0; o < layer.outputs; o++) {
    for (let s = 0; s < scales; s++) {
      const from = o * layer.inputs + s * channels;
      weight.set(layer.weight.subarray(from, from + channels), (o * scales + s) * padded);
    }
  }
  return { weight, bias: layer.bias, inputs: padded * scales, outputs: layer.outputs };
}

/**
 * All heads as one layer, whose outputs are the columns of an anchor's record.
 *
 * @param {Deformation} deformation @param {AnchorScene} scene
 * @returns {Network[number]}
 */
function joinHeads(deformation, scene) {
  const heads = headsIn(deformation, scene);
  const outputs = anchorColumns(scene.widths);
  const { inputs } = heads[0].network[0];
  const weight = new Float32Array(inputs * outputs);
  const bias = new Float32Array(outputs);
  for (const { network: [layer, second], columns, unit } of heads) {
    if (second) throw new TooLarge("a head of several layers");
    columns.forEach((to, o) => {
      bias[to] = unit * layer.bias[o];
      for (let i = 0; i < inputs; i++) weight[to * inputs + i] = unit * layer.weight[o * inputs + i];
    });
  }
  return { weight, bias, inputs, outputs };
}
