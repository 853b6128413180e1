// WebGL2: array textures of float blocks, passes over them, asynchronous read-back.

const HEADER = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp sampler2DArray;
precision highp usampler2D;
`;

/** A triangle that covers the viewport. */
const COVER = `${HEADER}
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4. - 1., 0, 1); }`;

/** Between two looks at a fence, milliseconds. */
const POLL_MS = 1;

/**
 * Texels of four floats in `blocks` layers, all of one size.
 *
 * @typedef {{texture: WebGLTexture, width: number, height: number, blocks: number}} Field
 */

/**
 * A linked program. uniform: the location of a name.
 *
 * @typedef {{program: WebGLProgram, uniform: (name: string) => WebGLUniformLocation | null}} Program
 */

export class Gpu {
  /** @param {WebGL2RenderingContext} gl */
  constructor(gl) {
    this.gl = gl;
    /** Whether textures of floats can be rendered to. */
    this.floats = !!gl.getExtension("EXT_color_buffer_float");
    const halves = this.floats || !!gl.getExtension("EXT_color_buffer_half_float");
    const names = gl.getExtension("WEBGL_debug_renderer_info");
    /** The renderer as the driver names it. */
    this.renderer = String(gl.getParameter(names ? names.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
    /** Whether it is a software renderer. */
    this.software = /swiftshader|llvmpipe|software/i.test(this.renderer);
    /** What pictures are blended in, 0 where there are no floats for it. Half floats are slow in software. */
    this.pictureFormat =
      this.software && this.floats && gl.getExtension("EXT_float_blend") ? gl.RGBA32F : halves ? gl.RGBA16F : 0;
    this.maxTargets = Math.min(gl.getParameter(gl.MAX_DRAW_BUFFERS), gl.getParameter(gl.MAX_COLOR_ATTACHMENTS), 8);
    this.maxSide = /** @type {number} */ (gl.getParameter(gl.MAX_TEXTURE_SIZE));
    this.maxLayers = /** @type {number} */ (gl.getParameter(gl.MAX_ARRAY_TEXTURE_LAYERS));
    this.maxUniformBytes = /** @type {number} */ (gl.getParameter(gl.MAX_UNIFORM_BLOCK_SIZE));
    this.uniformAlignment = /** @type {number} */ (gl.getParameter(gl.UNIFORM_BUFFER_OFFSET_ALIGNMENT));
    /** @type {Map<string, Program>} */
    this._programs = new Map();
    /** Framebuffers by their targets, of each texture. @type {Map<WebGLTexture, Map<string, WebGLFramebuffer>>} */
    this._framebuffers = new Map();
    /** Points that a chain of passes takes at a time, about: what lies between two of them takes memory. */
    this.bandPoints = 1 << 15;
    gl.disable(gl.DITHER);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  }

  /**
   * The program of two shaders, `#version` and precisions left out; compiled once.
   *
   * @param {string} fragment @param {string} [vertex] default: covers the viewport
   * @returns {Program}
   */
  program(fragment, vertex) {
    const key = `${vertex}\0${fragment}`;
    let found = this._programs.get(key);
    if (!found) {
      found = this._link(vertex ? HEADER + vertex : COVER, HEADER + fragment);
      this._programs.set(key, found);
    }
    return found;
  }

  /** @param {string} vertex @param {string} fragment @returns {Program} */
  _link(vertex, fragment) {
    const { gl } = this;
    const program = gl.createProgram();
    for (const [type, source] of /** @type {[number, string][]} */ ([
      [gl.VERTEX_SHADER, vertex],
      [gl.FRAGMENT_SHADER, fragment],
    ])) {
      const shader = /** @type {WebGLShader} */ (gl.createShader(type));
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) {
        throw new Error(`a shader does not compile: ${gl.getShaderInfoLog(shader)}`);
      }
      gl.deleteShader(shader); // it lives as long as the program
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) {
      throw new Error(`shaders do not link: ${gl.getProgramInfoLog(program)}`);
    }
    /** @type {Map<string, WebGLUniformLocation | null>} */
    const locations = new Map();
    gl.useProgram(program);
    const blocks = gl.getProgramParameter(program, gl.ACTIVE_UNIFORM_BLOCKS);
    for (let i = 0; i < blocks; i++) {
      // blocks are named U0, U1, ..; each is bound to its number
      const name = gl.getActiveUniformBlockName(program, i) ?? "";
      gl.uniformBlockBinding(program, i, Number(name.slice(1)));
    }
    return {
      program,
      uniform: (name) => {
        let location = locations.get(name);
        if (location === undefined) locations.set(name, (location = gl.getUniformLocation(program, name)));
        return location;
      },
    };
  }

  /**
   * A field of zeros, or of `data`.
   *
   * @param {number} width @param {number} height @param {number} blocks
   * @param {Float32Array | null} [data] [blocks, height, width, 4]
   * @param {number} [format] of the texels; default RGBA32F
   * @returns {Field}
   */
  field(width, height, blocks, data = null, format = this.gl.RGBA32F) {
    const { gl } = this;
    const texture = this._texture(gl.TEXTURE_2D_ARRAY);
    gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, format, width, height, blocks);
    const field = { texture, width, height, blocks };
    if (data) this.write(field, data);
    return field;
  }

  /**
   * `had` if it has this size, else a field in its place.
   *
   * @param {Field | null | undefined} had @param {number} width @param {number} height @param {number} blocks
   * @param {number} [format] as in `field`
   */
  renewed(had, width, height, blocks, format) {
    if (had?.width === width && had.height === height) return had;
    this.free(had);
    return this.field(width, height, blocks, null, format);
  }

  /** Overwrites the first `rows` rows of `count` blocks from `first` on. @param {Field} field of floats
   * @param {Float32Array} data [blocks, height, width, 4] @param {number} [rows] default: all @param {number} [first]
   * @param {number} [count] default: all behind it */
  write({ texture, width, height, blocks }, data, rows = height, first = 0, count = blocks - first) {
    const from = 4 * width * height * first;
    const { gl } = this;
    gl.bindTexture(gl.TEXTURE_2D_ARRAY, texture);
    gl.pixelStorei(gl.UNPACK_IMAGE_HEIGHT, height);
    gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, 0, 0, first, width, rows, count, gl.RGBA, gl.FLOAT, data, from);
    gl.pixelStorei(gl.UNPACK_IMAGE_HEIGHT, 0);
  }

  /**
   * A plain texture of one component.
   *
   * @param {number} width @param {number} height @param {Uint8Array | Uint32Array} data [height, width]
   * @returns {WebGLTexture} R8, read as 0..1, or R32UI
   */
  plain(width, height, data) {
    const { gl } = this;
    const texture = this._texture(gl.TEXTURE_2D);
    const [internal, format, type] =
      data instanceof Uint8Array
        ? [gl.R8, gl.RED, gl.UNSIGNED_BYTE]
        : [gl.R32UI, gl.RED_INTEGER, gl.UNSIGNED_INT];
    gl.texStorage2D(gl.TEXTURE_2D, 1, internal, width, height);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, height, format, type, data);
    return texture;
  }

  /** A texture of half floats, its width the largest. @param {Float32Array} data RGB of texels, row after row
   * @returns {WebGLTexture} */
  colors(data) {
    const { gl, maxSide: width } = this;
    const count = data.length / 3;
    const whole = Math.floor(count / width);
    const texture = this._texture(gl.TEXTURE_2D);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGB16F, width, Math.ceil(count / width));
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, whole, gl.RGB, gl.FLOAT, data);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, whole, count - whole * width, 1, gl.RGB, gl.FLOAT, data, 3 * whole * width);
    return texture;
  }

  /** @param {number} target */
  _texture(target) {
    const { gl } = this;
    const texture = gl.createTexture();
    gl.bindTexture(target, texture);
    gl.texParameteri(target, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(target, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    gl.texParameteri(target, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
    gl.texParameteri(target, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
    return texture;
  }

  /** Frees fields, textures and buffers. @param {(Field | WebGLTexture | WebGLBuffer | null | undefined)[]} things */
  free(...things) {
    const { gl } = this;
    for (const thing of things) {
      if (!thing) continue;
      if (thing instanceof WebGLBuffer) {
        gl.deleteBuffer(thing);
        continue;
      }
      const texture = "texture" in thing ? thing.texture : thing;
      for (const framebuffer of this._framebuffers.get(texture)?.values() ?? []) gl.deleteFramebuffer(framebuffer);
      this._framebuffers.delete(texture);
      gl.deleteTexture(texture);
    }
  }

  /**
   * Binds a framebuffer onto consecutive blocks of a field.
   *
   * @param {Field} field @param {number} first @param {number} count
   */
  bindTarget(field, first, count) {
    const { gl } = this;
    let framebuffers = this._framebuffers.get(field.texture);
    if (!framebuffers) this._framebuffers.set(field.texture, (framebuffers = new Map()));
    const key = `${first} ${count}`;
    const known = framebuffers.get(key);
    const framebuffer = known ?? gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    if (known) return;
    framebuffers.set(key, framebuffer);
    const buffers = [];
    for (let i = 0; i < count; i++) {
      gl.framebufferTextureLayer(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + i, field.texture, 0, first + i);
      buffers.push(gl.COLOR_ATTACHMENT0 + i);
    }
    gl.drawBuffers(buffers);
  }

  /**
   * Starts a program: its textures are bound in the order of their names.
   *
   * @param {Program} program @param {Record<string, Field | WebGLTexture>} textures
   */
  use(program, textures) {
    const { gl } = this;
    gl.useProgram(program.program);
    Object.entries(textures).forEach(([name, thing], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      if ("texture" in thing) gl.bindTexture(gl.TEXTURE_2D_ARRAY, thing.texture);
      else gl.bindTexture(gl.TEXTURE_2D, thing);
      gl.uniform1i(program.uniform(name), unit);
    });
  }

  /** Runs the current program on rows of blocks of a field. @param {Field} field @param {number} first
   * @param {number} count @param {number} row @param {number} rows */
  cover(field, first, count, row, rows) {
    const { gl } = this;
    this.bindTarget(field, first, count);
    gl.viewport(0, row, field.width, rows);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /**
   * The first `rows` rows of the first `count` blocks of a field, [count, rows, width, 4], once the GPU has them.
   *
   * @param {Field} field @param {number} count @param {number} rows
   * @returns {Promise<Float32Array>}
   */
  async read(field, count, rows) {
    const { gl } = this;
    const floats = 4 * field.width * rows;
    const buffer = gl.createBuffer();
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, buffer);
    gl.bufferData(gl.PIXEL_PACK_BUFFER, 4 * floats * count, gl.STREAM_READ);
    for (let i = 0; i < count; i++) {
      this.bindTarget(field, i, 1);
      gl.readPixels(0, 0, field.width, rows, gl.RGBA, gl.FLOAT, 4 * floats * i);
    }
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, null);
    try {
      await this.finished();
      const out = new Float32Array(floats * count);
      gl.bindBuffer(gl.PIXEL_PACK_BUFFER, buffer);
      gl.getBufferSubData(gl.PIXEL_PACK_BUFFER, 0, out);
      gl.bindBuffer(gl.PIXEL_PACK_BUFFER, null);
      return out;
    } finally {
      gl.deleteBuffer(buffer);
    }
  }

  /** Waits until the GPU has run all commands so far. Throws if the context is lost. */
  async finished() {
    const { gl } = this;
    const sync = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    for (;;) {
      const status = sync ? gl.clientWaitSync(sync, 0, 0) : gl.WAIT_FAILED;
      if (status === gl.WAIT_FAILED) throw new Error("the WebGL context is lost");
      if (status !== gl.TIMEOUT_EXPIRED) break;
      await new Promise((resolve) => setTimeout(resolve, POLL_MS));
    }
    gl.deleteSync(sync);
  }

  /** A uniform buffer. @param {Float32Array} data */
  uniforms(data) {
    const { gl } = this;
    const buffer = gl.createBuffer();
    gl.bindBuffer(gl.UNIFORM_BUFFER, buffer);
    gl.bufferData(gl.UNIFORM_BUFFER, data, gl.STATIC_DRAW);
    return buffer;
  }
}
