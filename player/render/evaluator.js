// Clauses 13.3 and 13.4 on the GPU, as fragment passes into float textures.
//
// Per anchor, when time changes: the deformation; the features' share of the scaffold's first layers. Per anchor, when
// the camera's centre changes: opacities. They tell which Gaussians are visible, about a fifth of all, and only these
// are evaluated further, when time or the camera's centre changes. Opacities and shapes that do not take the view
// direction change with time alone.

import { FieldPass } from "./field.js";
import { blocksOf, Linear, pack, repeat, targets, TooLarge } from "./layers.js";
import { eachAttribute, GAUSSIAN_COLUMNS, levelOf } from "./level.js";
import { anchorColumns } from "./record.js";
import { ANCHOR_BITS, NO_ENTRY } from "./sort.js";
/** @import { Network } from "../decode/tensors.js" */
/** @import { Deformation, AnchorScene } from "../kinds/index.js" */
/** @import { Field, Gpu } from "./gl.js" */
/** @import { List, Lister } from "./sort.js" */

/**
 * Visible Gaussians for the renderer: their records in texels of SPLAT_BLOCKS blocks. A texel without a Gaussian has
 * opacity −1. shapes: stands for the time and the list of which they have the opacities and shapes. still: as in Texels.
 *
 * @typedef {{field: Field, shapes?: object, still?: number}} Splats
 */

/**
 * The result of an evaluation. means: [texels, 4], mean and opacity; null if means and list are unchanged.
 *
 * @typedef {{splats: Splats, means: Float32Array | null}} Evaluated
 */

/** Block of an anchor's record where its features begin. */
const FEATURE_BLOCK = 1;
/** Block of a Gaussian's record that is its colour. */
const COLOR_BLOCK = 3;
/** Blocks of a Gaussian's record. */
export const SPLAT_BLOCKS = GAUSSIAN_COLUMNS / 4;
/** Limit of the textures of all anchors, bytes: beyond it devices fail in ways that cannot be distinguished. */
const MAX_BYTES = 2 ** 30;
/** A texture's width for `n` texels. @param {number} n */
const widthFor = (n) => 2 ** Math.max(4, Math.ceil(Math.log2(Math.sqrt(n))));

/** A network of the scaffold: a hidden layer, split by its inputs into features and direction, and the last layer. */
class Scaffold {
  /** @param {Gpu} gpu @param {Network} network @param {number} features @param {number} firstBlock in `before` */
  constructor(gpu, network, features, firstBlock) {
    if (network.length !== 2) throw new TooLarge(`a network of ${network.length} layers, expected 2`);
    const [first, last] = network;
    this.first = first;
    this.firstBlock = firstBlock;
    this.blocks = blocksOf(first.outputs);
    /** Inputs that are the view direction: 3 or 0. */
    this.views = first.inputs - features;
    const data = new Float32Array(12 * this.blocks);
    for (let o = 0; o < first.outputs; o++) {
      const from = o * first.inputs + features;
      for (let k = 0; k < this.views; k++) data[((o >> 2) * 3 + k) * 4 + (o & 3)] = first.weight[from + k];
    }
    /** The weights of the direction. */
    this.direction = gpu.uniforms(data);
    this.last = last;
  }

  /** Source that declares the weights of the direction. @param {number} index of the uniform block */
  declare(index) {
    return this.views ? `layout(std140) uniform U${index} { vec4 v${index}[${3 * this.blocks}]; };\n` : "";
  }

  /** Source of the hidden activations at anchor p, seen in direction d. @param {number} index @param {string} to */
  compute(index, to) {
    return repeat(this.blocks, (k) => {
      const terms = [..."xyz"].slice(0, this.views).map((axis, i) => ` + v${index}[${3 * k + i}] * d.${axis}`);
      return `vec4 ${to}${k} = max(texelFetch(before, ivec3(p, ${this.firstBlock + k}), 0)${terms.join("")}, 0.);`;
    });
  }
}

/** Layers, for the first of their inputs, as one; each is padded to whole blocks.
 * @param {Network[number][]} layers @param {number} inputs how many */
function stack(layers, inputs) {
  const outputs = layers.reduce((sum, layer) => sum + 4 * blocksOf(layer.outputs), 0);
  const weight = new Float32Array(inputs * outputs);
  const bias = new Float32Array(outputs);
  let at = 0;
  for (const layer of layers) {
    bias.set(layer.bias, at);
    for (let o = 0; o < layer.outputs; o++) {
      const from = o * layer.inputs;
      weight.set(layer.weight.subarray(from, from + inputs), (at + o) * inputs);
    }
    at += 4 * blocksOf(layer.outputs);
  }
  return { weight, bias, inputs, outputs };
}

/**
 * A deformation on the GPU, and the field of its residuals. rest: if it has a key instant, the anchors' records without
 * the residuals there.
 *
 * @typedef {{deformation: Deformation, pass: FieldPass, residual: Field, rest: Field | null}} Motion
 */

export class GpuEvaluator {
  /**
   * Throws TooLarge where the scene's networks or planes are larger than shaders take.
   *
   * @param {Gpu} gpu @param {AnchorScene} scene
   */
  constructor(gpu, scene) {
    this._gpu = gpu;
    this.scene = scene;
    const anchors = scene.anchor.length / 3;
    const { feature, slots } = scene.widths;
    this._slots = slots;
    this._blocks = anchorColumns(scene.widths) / 4;
    this._offsetBlock = this._blocks - slots;
    this._width = widthFor(anchors);
    this._height = Math.ceil(anchors / this._width);
    if (this._width > gpu.maxSide) throw new TooLarge(`${anchors} anchors`);
    if (this._blocks > gpu.maxLayers) throw new TooLarge(`${slots} Gaussians of an anchor`);

    let firstBlock = 0;
    const { opacity, covariance, color } = scene.networks;
    /** @param {Network} network */
    const scaffold = (network) => {
      const made = new Scaffold(gpu, network, feature, firstBlock);
      firstBlock += made.blocks;
      return made;
    };
    this._opacity = scaffold(opacity);
    this._covariance = scaffold(covariance);
    this._color = scaffold(color);
    const scaffolds = [this._opacity, this._covariance, this._color];
    this._first = new Linear(gpu, stack(scaffolds.map(({ first }) => first), feature));
    if (this._first.paddedBlocks > gpu.maxLayers) throw new TooLarge("the networks' first layers");
    const tables = levelOf(scene, 2).motion ? 3 : 1; // anchors, residuals, and anchors without those at the key instant
    const blocks = this._blocks * tables + this._first.paddedBlocks + blocksOf(slots);
    if (16 * this._width * this._height * blocks > MAX_BYTES) throw new TooLarge(`${anchors} anchors`);
    this._anchors = gpu.field(this._width, this._height, this._blocks, this._attributes());
    this._before = gpu.field(this._width, this._height, this._first.paddedBlocks);
    this._opacityLast = new Linear(gpu, this._opacity.last);
    this._opacities = gpu.field(this._width, this._height, this._opacityLast.paddedBlocks);
    this._shapes = this._uploadShapes();

    /** Of the level. @type {Motion | null} */
    this._motion = null;
    /** @type {WebGLTexture | null} */
    this._codes = null;
    /** Of the level whose codes these are. */
    this._spread = 1;
    /** @type {WebGLTexture | null} */
    this._list = null;
    /** @type {List} */
    this._listed = { width: 16, rows: 0, entries: new Uint32Array(0), starts: new Uint32Array(slots + 1), count: 0 };
    /** What the textures hold. @type {{level: number, t: number, eye: number[]} | null} */
    this._held = null;
    /** Stands for the time and the list. */
    this._shape = {};
  }

  /** The anchors' records, [blocks, height, width, 4]. */
  _attributes() {
    const plane = this._width * this._height * 4;
    const out = new Float32Array(plane * this._blocks);
    eachAttribute(this.scene, (values, width, columns) => {
      columns.forEach((column, k) => {
        const to = (column >> 2) * plane + (column & 3);
        for (let a = 0; width * a < values.length; a++) out[to + 4 * a] = values[width * a + k];
      });
    });
    return out;
  }

  /** Makes a deformation the one that moves the anchors. @param {Deformation | null} deformation */
  _setMotion(deformation) {
    if (deformation === (this._motion?.deformation ?? null)) return;
    this._freeMotion();
    if (!deformation) return;
    const gpu = this._gpu;
    const pass = new FieldPass(gpu, deformation, this.scene);
    const residual = gpu.field(this._width, this._height, pass.outputBlocks);
    this._motion = { deformation, pass, residual, rest: null };
    if (deformation.key !== null) this._motion.rest = this._withoutStill(this._motion, deformation.key);
  }

  _freeMotion() {
    if (!this._motion) return;
    const { pass, residual, rest } = this._motion;
    this._motion = null;
    pass.free();
    this._gpu.free(residual, rest);
  }

  /** The anchors' records without F(x, t*). @param {Motion} motion @param {number} key t* */
  _withoutStill({ pass, residual }, key) {
    const gpu = this._gpu;
    const rest = gpu.field(this._width, this._height, this._blocks);
    pass.run(key, this._anchors, this._height, residual);
    const program = gpu.program(`${targets(1)}uniform sampler2DArray anchors, residual;
uniform int block;
void main() {
  ivec3 p = ivec3(gl_FragCoord.xy, block);
  out0 = texelFetch(anchors, p, 0) - texelFetch(residual, p, 0);
}`);
    gpu.use(program, { anchors: this._anchors, residual });
    for (let block = 0; block < this._blocks; block++) {
      gpu.gl.uniform1i(program.uniform("block"), block);
      gpu.cover(rest, block, 1, 0, this._height);
    }
    return rest;
  }

  /** Last layers of shape and colour, one chunk per slot: v 0..3, v 3..6, w 0..3. */
  _uploadShapes() {
    const gpu = this._gpu;
    const { last: covariance } = this._covariance;
    const { last: color } = this._color;
    const blockFloats = 4 + 16 * blocksOf(covariance.inputs);
    const shapeBytes = 8 * blockFloats;
    const colorBytes = 16 + 64 * blocksOf(color.inputs);
    /** @param {number} bytes */
    const align = (bytes) => Math.ceil(bytes / gpu.uniformAlignment) * gpu.uniformAlignment;
    if (Math.max(shapeBytes, colorBytes) > gpu.maxUniformBytes) throw new TooLarge("the networks' last layers");
    const colorAt = align(shapeBytes);
    const stride = colorAt + align(colorBytes);
    const data = new Float32Array((stride * this._slots) / 4);
    for (let i = 0; i < this._slots; i++) {
      const at = (stride * i) / 4;
      pack(covariance, 7 * i, 1, data.subarray(at));
      pack(covariance, 7 * i + 3, 1, data.subarray(at + blockFloats));
      pack(color, 3 * i, 1, data.subarray(at + colorAt / 4));
    }
    return { buffer: gpu.uniforms(data), stride, shapeBytes, colorAt, colorBytes };
  }

  /**
   * Evaluates a level at a time for a camera's centre.
   *
   * @param {number} level 0, 1 or 2 @param {number} t normalised time @param {number[]} eye
   * @param {Splats | null} into what may be overwritten
   * @param {Lister} lister
   * @returns {Promise<Evaluated>}
   */
  async evaluate(level, t, eye, into, lister) {
    const gpu = this._gpu;
    const { number, rows, codes, spread, motion } = levelOf(this.scene, level);
    const lines = Math.ceil(rows / this._width);
    const held = this._held;
    const levelMoved = number !== held?.level;
    const anchorsMoved = levelMoved || (t !== held.t && !!motion);
    const eyeMoved = levelMoved || eye.some((x, k) => x !== held.eye[k]);
    this._held = null; // until all is done, the textures hold nothing in particular
    if (levelMoved) {
      const padded = new Uint8Array(this._width * this._height);
      padded.set(codes);
      gpu.free(this._codes);
      this._codes = gpu.plain(this._width, this._height, padded);
      this._spread = spread;
      this._setMotion(motion);
    }
    if (anchorsMoved) {
      this._motion?.pass.run(t, this._anchors, lines, this._motion.residual);
      this._runFirst(lines);
    }
    let gaussiansMoved = anchorsMoved;
    if (anchorsMoved || (eyeMoved && this._opacity.views)) {
      this._runOpacities(eye, lines);
      const opacities = await gpu.read(this._opacities, blocksOf(this._slots), lines);
      const previous = anchorsMoved ? null : this._listed;
      const list = await lister(opacities, this._slots, lines * this._width, previous);
      if (list) this._setList(list);
      gaussiansMoved ||= !!list;
    }
    if (gaussiansMoved) this._shape = {};
    const splats = this._runShapes(eye, into);
    this._held = { level: number, t, eye };
    return { splats, means: gaussiansMoved ? await gpu.read(splats.field, 1, this._listed.rows) : null };
  }

  /** First layers. @param {number} lines */
  _runFirst(lines) {
    const gpu = this._gpu;
    const linear = this._first;
    const program = gpu.program(
      linear.declare() +
        this._anchorSource() +
        `void main() {
ivec2 p = ivec2(gl_FragCoord.xy);
${repeat(linear.inputBlocks, (k) => `vec4 x${k} = anchorBlock(p, ${FEATURE_BLOCK + k});`)}
${linear.apply(false)}
${repeat(linear.chunkBlocks, (i) => `out${i} = y${i};`)}}`,
    );
    gpu.use(program, this._anchorTextures());
    linear.cover(this._before, 0, lines);
  }

  /** Source that reads anchors' attributes, moved if something moves them. */
  _anchorSource() {
    return `uniform vec3 eye;
uniform sampler2DArray anchors${this._motion ? ", residual" : ""};
vec4 anchorBlock(ivec2 p, int block) {
  return texelFetch(anchors, ivec3(p, block), 0)${this._motion ? " + texelFetch(residual, ivec3(p, block), 0)" : ""};
}
vec3 directionTo(ivec2 p) {
  vec3 d = anchorBlock(p, 0).xyz - eye;
  return d / max(length(d), 1e-30);
}
`;
  }

  /** @returns {Record<string, Field>} */
  _anchorTextures() {
    if (!this._motion) return { anchors: this._anchors };
    const { rest, residual } = this._motion;
    return { anchors: rest ?? this._anchors, residual };
  }

  /** @param {number[]} eye @param {number} lines */
  _runOpacities(eye, lines) {
    const gpu = this._gpu;
    const linear = this._opacityLast;
    const program = gpu.program(
      linear.declare() +
        this._opacity.declare(1) +
        this._anchorSource() +
        `uniform sampler2DArray before;
uniform sampler2D codes;
void main() {
ivec2 p = ivec2(gl_FragCoord.xy);
vec3 d = directionTo(p);
${this._opacity.compute(1, "x")}
${linear.apply(false)}
float gate = texelFetch(codes, p, 0).r;
${repeat(linear.chunkBlocks, (i) => `y${i} = tanh(clamp(y${i}, -15., 15.));`)}
${repeat(linear.chunkBlocks, (i) => `out${i} = y${i} * vec4(greaterThanEqual(y${i} * gate, vec4(1. / 255.)));`)}}`,
    );
    const codes = /** @type {WebGLTexture} */ (this._codes);
    gpu.use(program, { ...this._anchorTextures(), before: this._before, codes });
    gpu.gl.uniform3fv(program.uniform("eye"), eye);
    gpu.gl.bindBufferBase(gpu.gl.UNIFORM_BUFFER, 1, this._opacity.direction);
    linear.cover(this._opacities, 0, lines);
  }

  /** @param {List} list */
  _setList(list) {
    const gpu = this._gpu;
    const height = list.entries.length / list.width;
    if (Math.max(list.width, height) > gpu.maxSide) throw new TooLarge(`${list.count} Gaussians`);
    gpu.free(this._list);
    this._list = gpu.plain(list.width, height, list.entries);
    this._listed = list;
  }

  /** @param {number[]} eye @param {Splats | null} into @returns {Splats} */
  _runShapes(eye, into) {
    const gpu = this._gpu;
    const { gl } = gpu;
    const { width, starts, rows } = this._listed;
    const height = Math.max(this._listed.entries.length / width, 1);
    const field = gpu.renewed(into?.field, width, height, SPLAT_BLOCKS);
    const blind = !this._opacity.views && !this._covariance.views;
    const kept = blind && into?.field === field && into.shapes === this._shape;
    const splats = { field, shapes: this._shape };
    if (!rows || !this._list || !this._codes) return splats;
    const shapes = this._shapes;
    const program = gpu.program(kept ? this._colorSource() : this._shapeSource());
    const { _before: before, _list: list, _opacities: opacities, _codes: codes } = this;
    gpu.use(program, { ...this._anchorTextures(), before, list, opacities, codes });
    gl.uniform3fv(program.uniform("eye"), eye);
    gl.uniform1f(program.uniform("spread"), this._spread);
    gl.bindBufferBase(gl.UNIFORM_BUFFER, 1, this._covariance.direction);
    gl.bindBufferBase(gl.UNIFORM_BUFFER, 2, this._color.direction);
    for (let i = 0; i < this._slots; i++) {
      if (starts[i + 1] === starts[i]) continue;
      gl.bindBufferRange(gl.UNIFORM_BUFFER, 3, shapes.buffer, shapes.stride * i, shapes.shapeBytes);
      gl.bindBufferRange(gl.UNIFORM_BUFFER, 4, shapes.buffer, shapes.stride * i + shapes.colorAt, shapes.colorBytes);
      const [first, count] = kept ? [COLOR_BLOCK, 1] : [0, SPLAT_BLOCKS];
      gpu.cover(field, first, count, starts[i], starts[i + 1] - starts[i]);
    }
    return splats;
  }

  /** The listed Gaussians. */
  _shapeSource() {
    const K = this._covariance.blocks;
    return `${targets(SPLAT_BLOCKS) + this._listedSource() + this._covariance.declare(1)}
layout(std140) uniform U3 { vec4 vb; mat4 vw[${K}]; vec4 qb; mat4 qw[${K}]; };
uniform sampler2DArray opacities;
uniform sampler2D codes;
uniform float spread;
void main() {
  ivec2 g = ivec2(gl_FragCoord.xy);
  uint entry = texelFetch(list, g, 0).r;
  out0 = vec4(0, 0, 0, -1);
  out1 = out2 = out3 = vec4(0);
  if (entry == ${NO_ENTRY}u) return;
  ivec2 p = anchorOf(entry);
  int slot = int(entry >> ${ANCHOR_BITS});
  float opacity = texelFetch(opacities, ivec3(p, slot >> 2), 0)[slot & 3];
  vec3 offset = anchorBlock(p, ${this._offsetBlock} + slot).xyz;
  vec3 mean = anchorBlock(p, 0).xyz + offset * exp(anchorBlock(p, ${this._offsetBlock - 2}).xyz);
  out0 = vec4(mean, 0);
  if (!(opacity > 0.)) return;
  vec3 d = directionTo(p);
${this._covariance.compute(1, "x")}
  vec4 v = vb, q = qb;
${repeat(K, (k) => `v += vw[${k}] * x${k}; q += qw[${k}] * x${k};`)}
  float gate = texelFetch(codes, p, 0).r;
  float n = length(q);
  out0 = vec4(mean, opacity * gate);
  out1 = vec4(exp(anchorBlock(p, ${this._offsetBlock - 1}).xyz) / (1. + exp(-v.xyz)) * gate * spread, 0);
  out2 = n > 0. ? q / n : vec4(1, 0, 0, 0);
  out3 = colorOf(p, d);
}`;
  }

  /** Their colours alone. */
  _colorSource() {
    return `${targets(1) + this._listedSource()}
void main() {
  ivec2 g = ivec2(gl_FragCoord.xy);
  uint entry = texelFetch(list, g, 0).r;
  out0 = vec4(0);
  if (entry == ${NO_ENTRY}u) return;
  ivec2 p = anchorOf(entry);
  out0 = colorOf(p, directionTo(p));
}`;
  }

  /** What both take. */
  _listedSource() {
    const L = this._color.blocks;
    return `${this._anchorSource() + this._color.declare(2)}
layout(std140) uniform U4 { vec4 b4; mat4 w4[${L}]; };
uniform sampler2DArray before;
uniform usampler2D list;
ivec2 anchorOf(uint entry) {
  int a = int(entry & ${2 ** ANCHOR_BITS - 1}u);
  return ivec2(a % ${this._width}, a / ${this._width});
}
vec4 colorOf(ivec2 p, vec3 d) {
${this._color.compute(2, "c")}
  vec4 w = b4;
${repeat(L, (k) => `w += w4[${k}] * c${k};`)}
  return vec4(1. / (1. + exp(-w.xyz)), 0);
}
`;
  }

  free() {
    this._freeMotion();
    this._gpu.free(this._anchors, this._before, this._opacities, this._codes, this._list);
    this._gpu.free(this._first.buffer, this._opacityLast.buffer, this._shapes.buffer);
    this._gpu.free(...[this._opacity, this._covariance, this._color].map(({ direction }) => direction));
  }
}
