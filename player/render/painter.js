// Clause 13.5: Gaussians as quads, blended back to front in display space.

import { MIN_OPACITY } from "./level.js";
/** @import { Camera } from "../decode/tensors.js" */
/** @import { Splats } from "./evaluator.js" */
/** @import { Field, Gpu } from "./gl.js" */

/** The order in which a scene's Gaussians are drawn, in a texture of some rows. @typedef {{texture: WebGLTexture,
 * rows: number, count: number}} Order */

/** A scene in a picture. fill: RGB behind its Gaussians. near: scene units.
 * @typedef {{splats: Splats, order: Order, fill: ArrayLike<number>, near: number}} Drawn */

/** A picture of several views, as an XRWebGLLayer describes it. @typedef {{framebuffer: WebGLFramebuffer | null,
 * framebufferWidth: number, framebufferHeight: number}} Target */

/** Variance added to every Gaussian, pixels squared. */
const BLUR = 0.3;
/** Share of the picture beyond its sides to which the projection's slope is clamped. */
const MARGIN = 0.15;
const MAX_ALPHA = 0.999;

/** Quads of an instance. Instances of a single quad are slow on real GPUs and slower in software ones. */
const BATCH = 128;
/** Width of the texture of the order. */
const ORDER_WIDTH = 1024;

/** One quad per Gaussian, which ends where alpha falls to 1/255 along the ellipse's axes. The covariance is U·Uᵀ + blur
 * with U = J·W·R·S, and its determinant |u0 × u1|² + blur·trace + blur²: without cancellation for needles. */
const VERTEX = `
uniform sampler2DArray splats;
uniform usampler2D order;
uniform int count;
uniform vec4 view[3];
uniform vec4 lens; // fx, fy, cx, cy
uniform vec4 slopes; // least and largest x/z, y/z
uniform vec2 size;
uniform float near;
flat out vec4 paint;
out vec2 place;
void main() {
  gl_Position = vec4(2, 2, 2, 1); // outside
  int number = gl_InstanceID * ${BATCH} + (gl_VertexID >> 2);
  if (number >= count) return;
  int index = int(texelFetch(order, ivec2(number % ${ORDER_WIDTH}, number / ${ORDER_WIDTH}), 0).r);
  int width = textureSize(splats, 0).x;
  ivec2 g = ivec2(index % width, index / width);
  vec4 head = texelFetch(splats, ivec3(g, 0), 0);
  vec4 p = vec4(head.xyz, 1);
  vec3 c = vec3(dot(view[0], p), dot(view[1], p), dot(view[2], p));
  if (!(c.z > near && head.w > ${MIN_OPACITY} && head.w <= 1.)) return;
  float iz = 1. / c.z;
  vec2 slope = clamp(c.xy * iz, slopes.xz, slopes.yw);
  vec3 j0 = lens.x * iz * (view[0].xyz - slope.x * view[2].xyz);
  vec3 j1 = lens.y * iz * (view[1].xyz - slope.y * view[2].xyz);
  vec4 q = texelFetch(splats, ivec3(g, 2), 0);
  vec3 s = texelFetch(splats, ivec3(g, 1), 0).xyz;
  vec3 r0 = vec3(1. - 2. * (q.z * q.z + q.w * q.w), 2. * (q.y * q.z + q.x * q.w), 2. * (q.y * q.w - q.x * q.z));
  vec3 r1 = vec3(2. * (q.y * q.z - q.x * q.w), 1. - 2. * (q.y * q.y + q.w * q.w), 2. * (q.z * q.w + q.x * q.y));
  vec3 r2 = vec3(2. * (q.y * q.w + q.x * q.z), 2. * (q.z * q.w - q.x * q.y), 1. - 2. * (q.y * q.y + q.z * q.z));
  vec3 u = vec3(dot(j0, r0), dot(j0, r1), dot(j0, r2)) * s;
  vec3 v = vec3(dot(j1, r0), dot(j1, r1), dot(j1, r2)) * s;
  vec3 w = cross(u, v);
  float a = dot(u, u), b = dot(u, v), d = dot(v, v);
  float det = dot(w, w) + ${BLUR} * (a + d) + ${BLUR * BLUR};
  float half_ = .5 * (a - d), root = sqrt(half_ * half_ + b * b);
  float long_ = .5 * (a + d) + ${BLUR} + root;
  if (!(long_ < 1e18 && det < 1e36)) return; // also what is not a number
  vec2 axis = root > 0. ? half_ >= 0. ? vec2(half_ + root, b) : vec2(b, root - half_) : vec2(1, 0);
  axis = dot(axis, axis) > 0. ? normalize(axis) : vec2(1, 0);
  float reach = sqrt(2. * log(255. * head.w));
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1 & 1) * 2. - 1.;
  vec2 extent = reach * sqrt(vec2(long_, det / long_));
  vec2 pixel = c.xy * iz * lens.xy + lens.zw
    + corner.x * extent.x * axis + corner.y * extent.y * vec2(-axis.y, axis.x);
  vec4 color = texelFetch(splats, ivec3(g, 3), 0);
  if (!(dot(color.rgb, vec3(1)) < 1e9)) return;
  paint = vec4(color.rgb, head.w);
  place = corner * reach;
  gl_Position = vec4(pixel / size * vec2(2, -2) + vec2(-1, 1), 0, 1);
}`;

const FRAGMENT = `
flat in vec4 paint;
in vec2 place;
out vec4 color;
void main() {
  float alpha = min(${MAX_ALPHA}, paint.a * exp(-.5 * dot(place, place)));
  if (alpha < ${MIN_OPACITY}) discard;
  color = vec4(paint.rgb * alpha, alpha);
}`;

/** Copies the float picture onto the canvas, blended with that of a second scene. */
const SHOW = `
uniform sampler2DArray picture, second;
uniform float share;
out vec4 color;
void main() {
  ivec3 p = ivec3(gl_FragCoord.xy, 0);
  color = vec4(texelFetch(picture, p, 0).rgb, 1);
  if (share > 0.) color.rgb = mix(min(color.rgb, 1.), min(texelFetch(second, p, 0).rgb, 1.), share);
}`;

export class Painter {
  /** @param {Gpu} gpu */
  constructor(gpu) {
    const { gl } = gpu;
    this._gpu = gpu;
    const corners = new Uint16Array(6 * BATCH);
    for (let q = 0; q < BATCH; q++) corners.set([0, 1, 2, 2, 1, 3].map((corner) => 4 * q + corner), 6 * q);
    this._array = gl.createVertexArray();
    gl.bindVertexArray(this._array);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    /** Pictures in floats, as eight bits would round at every blend: of a scene, and of a second one.
     * @type {(Field | null)[]} */
    this._pictures = [null, null];
    this._warm();
  }

  /** Draws an empty picture, which compiles the shaders before the first Gaussians arrive. */
  _warm() {
    const gpu = this._gpu;
    const { gl } = gpu;
    const nothing = gpu.field(1, 1, 4);
    const order = this.ordered(null, new Uint32Array(1));
    const K = new Float32Array([1, 0, 1, 0, 1, 1, 0, 0, 1]);
    const drawn = { splats: { field: nothing }, order, fill: [0, 0, 0], near: 1 };
    this.draw([drawn], [{ viewmat: new Float32Array(16), K, width: 2, height: 2 }]);
    gpu.free(nothing, order.texture);
    gl.flush();
  }

  /** An order in place of an earlier one. @param {Order | null} had @param {Uint32Array} order texels of the splats, back
   * to front @returns {Order} */
  ordered(had, order) {
    const { gl } = this._gpu;
    const rows = Math.ceil(order.length / ORDER_WIDTH);
    if (!had || rows > had.rows) {
      this._gpu.free(had?.texture);
      const room = Math.ceil(1.25 * Math.max(rows, 1));
      had = { texture: this._gpu.plain(ORDER_WIDTH, room, new Uint32Array(ORDER_WIDTH * room)), rows: room, count: 0 };
    }
    gl.bindTexture(gl.TEXTURE_2D, had.texture);
    /** @param {number} row @param {number} height @param {number} width */
    const put = (row, height, width) => {
      const from = row * ORDER_WIDTH;
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, row, width, height, gl.RED_INTEGER, gl.UNSIGNED_INT, order, from);
    };
    const whole = Math.floor(order.length / ORDER_WIDTH);
    if (whole) put(0, whole, ORDER_WIDTH);
    if (whole < rows) put(whole, 1, order.length - whole * ORDER_WIDTH);
    had.count = order.length;
    return had;
  }

  /**
   * Draws onto the canvas, which has the camera's size, or for the eyes of a headset.
   *
   * @param {Drawn[]} scenes one, or two to blend @param {(Camera & {x?: number, y?: number})[]} views and where in the
   * picture they are, pixels @param {number} [share] of the second scene; without floats, the one of more is drawn
   * @param {Target} [target]
   */
  draw(scenes, views, share = 0, target) {
    const gpu = this._gpu;
    const { gl } = gpu;
    const width = target?.framebufferWidth ?? views[0].width;
    const height = target?.framebufferHeight ?? views[0].height;
    const framebuffer = target?.framebuffer ?? null;
    if (!gpu.pictureFormat) {
      gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
      this._drawScene(scenes[Math.round(share)], views);
      return;
    }
    const [picture, second = picture] = scenes.map((scene, i) => {
      const field = (this._pictures[i] = gpu.renewed(this._pictures[i], width, height, 1, gpu.pictureFormat));
      gpu.bindTarget(field, 0, 1);
      this._drawScene(scene, views);
      return field;
    });
    const program = gpu.program(SHOW);
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    gpu.use(program, { picture, second });
    gl.uniform1f(program.uniform("share"), share);
    gl.viewport(0, 0, width, height);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /** @param {Drawn} scene @param {(Camera & {x?: number, y?: number})[]} views */
  _drawScene(scene, views) {
    const { gl } = this._gpu;
    const { fill } = scene;
    gl.clearColor(fill[0], fill[1], fill[2], 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    for (const view of views) this._drawView(scene, view);
  }

  /** @param {Drawn} scene @param {Camera & {x?: number, y?: number}} view */
  _drawView({ splats, order, near }, { viewmat, K, width, height, x = 0, y = 0 }) {
    const { texture, count } = order;
    if (!count) return;
    const gpu = this._gpu;
    const { gl } = gpu;
    gl.viewport(x, y, width, height);
    const program = gpu.program(FRAGMENT, VERTEX);
    gpu.use(program, { splats: splats.field, order: texture });
    gl.uniform1i(program.uniform("count"), count);
    gl.uniform4fv(program.uniform("view"), viewmat.subarray(0, 12));
    gl.uniform4f(program.uniform("lens"), K[0], K[4], K[2], K[5]);
    gl.uniform4f(
      program.uniform("slopes"),
      (-K[2] - MARGIN * width) / K[0],
      (width - K[2] + MARGIN * width) / K[0],
      (-K[5] - MARGIN * height) / K[4],
      (height - K[5] + MARGIN * height) / K[4],
    );
    gl.uniform2f(program.uniform("size"), width, height);
    gl.uniform1f(program.uniform("near"), Math.max(near, 1e-6));
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(this._array);
    gl.drawElementsInstanced(gl.TRIANGLES, 6 * BATCH, gl.UNSIGNED_SHORT, 0, Math.ceil(count / BATCH));
    gl.bindVertexArray(null);
    gl.disable(gl.BLEND);
  }
}
