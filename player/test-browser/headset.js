// A headset as WebXR describes one, for tests: it stands still at `headset.pose`, and `headset.eyes` see `headset.size`
// pixels each. `headset.read()` is what it shows, the eyes beside each other, as base64 of RGBA bytes.

/** @typedef {{inverse: {matrix: Float32Array}}} Transform */

{
  const size = { width: 96, height: 72 };
  /** Of the head: radians to the left, and metres right, up and backwards. Of each eye: metres to the right, tangents of
   * the left, right, lower and upper side. */
  const pose = { turn: 0.2, place: [0.1, 0.05, -0.3] };
  const eyes = { left: [-0.03, -0.7, 0.5, -0.4, 0.5], right: [0.03, -0.5, 0.7, -0.4, 0.5] };

  /** World to head, moved to the right. @param {number} right metres @returns {Transform} */
  function transform(right) {
    const [c, s] = [Math.cos(pose.turn), Math.sin(pose.turn)];
    const [x, y, z] = pose.place;
    const moved = [-c * x + s * z - right, -y, -s * x - c * z];
    return { inverse: { matrix: new Float32Array([c, 0, s, 0, 0, 1, 0, 0, -s, 0, c, 0, ...moved, 1]) } };
  }

  /** @param {"left" | "right"} eye */
  function view(eye) {
    const [right, l, r, b, t] = eyes[eye];
    const [w, h] = [r - l, t - b];
    const rows = [2 / w, 0, 0, 0, 0, 2 / h, 0, 0, (r + l) / w, (t + b) / h, -1, -1, 0, 0, -0.02, 0];
    return { eye, transform: transform(right), projectionMatrix: new Float32Array(rows) };
  }

  class Session extends EventTarget {
    ended = false;
    updateRenderState() {}
    requestReferenceSpace = async () => ({});

    /** @param {(now: number, frame: object) => void} draw */
    requestAnimationFrame(draw) {
      const getViewerPose = () => ({ transform: transform(0), views: [view("left"), view("right")] });
      setTimeout(() => {
        if (this.ended) return;
        draw(performance.now(), { getViewerPose });
        headset.wait(); // else a slow machine gets pictures sooner than it draws them
        headset.frames++;
      }, 10);
    }

    async end() {
      this.ended = true;
      this.dispatchEvent(new Event("end"));
    }
  }

  class Layer {
    framebufferWidth = 2 * size.width;
    framebufferHeight = size.height;

    /** @param {Session} _session @param {WebGL2RenderingContext} gl */
    constructor(_session, gl) {
      this.gl = gl;
      this.framebuffer = gl.createFramebuffer();
      const buffer = gl.createRenderbuffer();
      gl.bindRenderbuffer(gl.RENDERBUFFER, buffer);
      gl.renderbufferStorage(gl.RENDERBUFFER, gl.RGBA8, this.framebufferWidth, this.framebufferHeight);
      gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
      gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.RENDERBUFFER, buffer);
      headset.layer = this;
    }

    /** @param {{eye: string}} view */
    getViewport = ({ eye }) => ({ x: eye === "left" ? 0 : size.width, y: 0, ...size });
  }

  const headset = {
    ...{ size, pose, eyes },
    frames: 0,
    /** @type {Session | null} */
    session: null,
    /** @type {Layer | null} */
    layer: null,
    /** Waits until the GPU has drawn. */
    wait() {
      const { gl, framebuffer } = /** @type {Layer} */ (this.layer);
      gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
      gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    },
    read() {
      const { gl, framebuffer, framebufferWidth: w, framebufferHeight: h } = /** @type {Layer} */ (this.layer);
      const pixels = new Uint8Array(4 * w * h);
      gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
      gl.readPixels(0, 0, w, h, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
      const rows = Array.from({ length: h }, (_, y) => pixels.subarray(4 * w * (h - 1 - y), 4 * w * (h - y)));
      return btoa(rows.map((row) => String.fromCharCode(...row)).join(""));
    },
  };
  const xr = {
    isSessionSupported: async (/** @type {string} */ mode) => mode === "immersive-vr",
    requestSession: async () => (headset.session = new Session()),
  };
  Object.defineProperty(navigator, "xr", { value: xr });
  Object.assign(WebGL2RenderingContext.prototype, { makeXRCompatible: async () => {} });
  Object.assign(globalThis, { headset, XRWebGLLayer: Layer });
}
