// Clauses 13.7 and 13.8 on the GPU, as one fragment pass: a texel for each Gaussian of a level, of opacity -1 where it is
// not seen. What a time needs of the CPU are the bases; what the order needs, means and opacities, a worker evaluates.

import { COMPONENTS } from "../kinds/rules.js";
import { TooLarge, blocksOf, repeat, targets } from "./layers.js";
import { MIN_OPACITY, levelOf } from "./level.js";
import { basesOf, eachBasis } from "./splats.js";
/** @import { SplatScene } from "../kinds/index.js" */
/** @import { CpuEvaluator } from "./cpu.js" */
/** @import { Evaluated, Splats } from "./evaluator.js" */
/** @import { Gpu, Program } from "./gl.js" */

/** Vectors of uniforms beside those of the bases, about. */
const OTHER_UNIFORMS = 16;

/** Y, Co and Cg to red, green and blue; the harmonics of a direction, in the order and with the signs of 3DGS. */
const COLORS = `
vec3 rgb(vec3 c) { return vec3(c.x - c.z + c.y, c.x + c.z, c.x - c.z - c.y); }
void harmonicsOf(vec3 d, out float h[15]) {
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  h = float[15](-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x,
    1.0925484305920792 * x * y, -1.0925484305920792 * y * z, 0.31539156525252005 * (2. * zz - xx - yy),
    -1.0925484305920792 * x * z, 0.5462742152960396 * (xx - yy), -0.5900435899266435 * y * (3. * xx - yy),
    2.890611442640554 * x * y * z, -0.4570457994644658 * y * (4. * zz - xx - yy),
    0.3731763325901154 * z * (2. * zz - 3. * xx - 3. * yy), -0.4570457994644658 * x * (4. * zz - xx - yy),
    1.445305721320277 * z * (xx - yy), -0.5900435899266435 * x * (xx - 3. * yy));
}`;

/** @param {number[]} blocks of coefficients, by head @param {boolean} windows @param {number} shine harmonics */
function source(blocks, windows, shine) {
  let first = 0;
  const [position, rotation, scale, opacity, color] = blocks.map((count) => {
    const terms = Array.from({ length: count }, (_, b) => {
      return `bases[${first + b}] * texelFetch(coefficients, ivec3(g, ${first + b}), 0)`;
    });
    first += count;
    return terms.join(" + ");
  });
  return `
uniform sampler2DArray rest;
${first ? `uniform sampler2DArray coefficients;\nuniform mat4 bases[${first}];` : ""}
${windows ? "uniform sampler2DArray windows;\nuniform float t;" : ""}
${shine ? "uniform sampler2D harmonics;\nuniform vec3 eye;" : ""}
${targets(4)}${COLORS}
void main() {
  ivec2 g = ivec2(gl_FragCoord.xy);
  vec4 mean = texelFetch(rest, ivec3(g, 0), 0), size = texelFetch(rest, ivec3(g, 1), 0);
  vec4 q = texelFetch(rest, ivec3(g, 2), 0), shade = texelFetch(rest, ivec3(g, 3), 0);
  ${position ? `mean.xyz += (${position}).xyz;` : ""}
  ${opacity ? `mean.w = size.w / (1. + exp(-mean.w - (${opacity}).x));` : ""}
  ${windows ? `vec3 window = texelFetch(windows, ivec3(g, 0), 0).xyz;
  float excess = min(max(abs(t - window.x) - window.y, 0.) * window.z, 1e9);
  mean.w *= exp(-.5 * excess * excess);` : ""}
  ${scale ? `size.xyz = exp(size.xyz + (${scale}).xyz) * size.w;` : ""}
  ${rotation ? `vec4 r = ${rotation} + vec4(1, 0, 0, 0);
  q = vec4(r.x * q.x - dot(r.yzw, q.yzw), r.x * q.yzw + q.x * r.yzw + cross(r.yzw, q.yzw));
  float norm = length(q);
  q = norm > 0. ? q / norm : vec4(1, 0, 0, 0);` : ""}
  ${color ? `shade.rgb += rgb((${color}).xyz) * 0.28209479177387814;` : ""}
  ${shine ? `vec3 way = mean.xyz - eye, sum = vec3(0);
  float h[15];
  harmonicsOf(way / max(length(way), 1e-30), h);
  int at = int(shade.w) * ${shine}, wide = textureSize(harmonics, 0).x;
  ${repeat(shine, (j) => `sum += h[${j}] * texelFetch(harmonics, ivec2((at + ${j}) % wide, (at + ${j}) / wide), 0).rgb;`)}
  shade.rgb += rgb(sum);` : ""}
  out0 = vec4(mean.xyz, mean.w >= ${MIN_OPACITY} ? mean.w : -1.);
  out1 = size;
  out2 = q;
  out3 = vec4(max(shade.rgb, 0.), 0);
}`;
}

/** A level on the GPU. heads: their bases with those of the coefficients' blocks before.
 * @typedef {{number: number, program: Program, textures: Record<string, import("./gl.js").Field | WebGLTexture>,
 *   heads: (ReturnType<typeof basesOf> & {block: number})[], bases: Float32Array, width: number, height: number}} OnGpu */

/** Evaluates a scene, as GpuEvaluator does one of the other kind. */
export class SplatPass {
  /** @param {Gpu} gpu @param {SplatScene} scene @param {CpuEvaluator} cpu */
  constructor(gpu, scene, cpu) {
    this._gpu = gpu;
    this.scene = scene;
    this._cpu = cpu;
    /** @type {OnGpu | null} */
    this._level = null;
    /** The time of the latest means. */
    this._time = NaN;
  }

  /**
   * The Gaussians of a level. Throws TooLarge where there are more bases than shaders take.
   *
   * @param {number} level @param {number} t normalised time @param {number[]} eye the camera's centre
   * @param {Splats | null} into what may be overwritten
   * @returns {Promise<Evaluated>}
   */
  async evaluate(level, t, eye, into) {
    const { _gpu: gpu, _cpu: cpu, scene } = this;
    const { gl } = gpu;
    if (this._level?.number !== level) {
      const parts = await cpu.parts(scene, level);
      this.free();
      this._level = this._upload(level, parts);
      this._time = NaN;
    }
    const { program, textures, heads, bases, width, height } = this._level;
    const means = t === this._time ? null : await cpu.means(scene, level, t);
    this._time = t;
    for (const { block, parts } of heads) {
      eachBasis(parts, t, (basis, c, value) => (bases[16 * block + 4 * basis + c] = value));
    }
    const field = gpu.renewed(into?.field, width, height, 4);
    gpu.use(program, textures);
    if (bases.length) gl.uniformMatrix4fv(program.uniform("bases"), false, bases);
    gl.uniform1f(program.uniform("t"), t);
    gl.uniform3f(program.uniform("eye"), eye[0], eye[1], eye[2]);
    gpu.cover(field, 0, 4, 0, height);
    return { splats: { field }, means };
  }

  /** @param {number} number of the level @param {import("./splats.js").Parts} parts @returns {OnGpu} */
  _upload(number, { width, height, rest, coefficients, windows }) {
    const { _gpu: gpu, scene: { harmonics, anchor } } = this;
    const { gl } = gpu;
    const tracks = levelOf(this.scene, number).motion ?? [];
    let blocks = 0;
    const heads = COMPONENTS.map((_, head) => {
      const found = { block: blocks, ...basesOf(tracks, head) };
      blocks += blocksOf(found.inputs);
      return found;
    });
    if (4 * blocks + OTHER_UNIFORMS > gl.getParameter(gl.MAX_FRAGMENT_UNIFORM_VECTORS)) throw new TooLarge(`tracks`);
    const shine = harmonics ? harmonics.length / anchor.length : 0;
    const program = gpu.program(source(heads.map(({ inputs }) => blocksOf(inputs)), !!windows, shine));
    const textures = {
      rest: gpu.field(width, height, 4, rest),
      ...(blocks && { coefficients: gpu.field(width, height, blocks, coefficients) }),
      ...(windows && { windows: gpu.field(width, height, 1, windows) }),
      ...(harmonics && { harmonics: gpu.colors(harmonics) }),
    };
    return { number, program, textures, heads, bases: new Float32Array(16 * blocks), width, height };
  }

  free() {
    this._gpu.free(...Object.values(this._level?.textures ?? {}));
    this._level = null;
  }
}
