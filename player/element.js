// <pd4-player>: a dynamic scene in a page.
//
//   <script type="module" src="player/element.js"></script>
//   <pd4-player src="scene.pd4" controls autoplay loop></pd4-player>
//
// Attributes: src; poster, a picture until there is one; controls; autoplay; loop; speed; time, seconds to start at; fit,
// contain or cover; free, whether the camera may leave what was captured; label, the scene's name; level, the highest
// to load and show; max-bytes and max-seconds, how much of the file to load, and how long beyond its first slice. A
// change of autoplay, max-bytes or max-seconds acts on the next file. What the element contains, such as a picture,
// covers the canvas until the first frame; the first poster-bytes of the file show less than it does.

import { Orbit } from "./render/orbit.js";
import { SCALES, SIZE_NAMES } from "./render/pace.js";
import { Player } from "./render/player.js";
import { enterVr, hasHeadset } from "./render/xr.js";

export { Player } from "./render/player.js";

/** Events that an element passes on from its player. */
const EVENTS = ["progress", "firstpicture", "upgrade", "loaded", "timeupdate", "statechange", "error"];
/** Between two looks at the status, milliseconds. */
const STATUS_MS = 250;
const LOST = "paused: the browser draws no more scenes at once; it goes on when others are out of view";
/** Seconds that a key steps through the scene. */
const FRAME = 1 / 30;

/**
 * Plays an address or a file on a canvas, without an element.
 *
 * @param {string | URL | Blob} source
 * @param {import("./render/player.js").Options & {canvas: HTMLCanvasElement}} options
 * @returns {Player}
 */
export function open(source, { canvas, ...options }) {
  const player = new Player(canvas, options);
  player.load(source);
  return player;
}

const STYLE = `
:host { display: block; position: relative; container-type: inline-size; overflow: hidden; aspect-ratio: 4 / 3;
  contain-intrinsic-width: 320px; max-width: 100%; min-width: 0; min-height: 0;
  background: #000; color: #eee; font: 13px/1.4 system-ui, sans-serif; }
:host([hidden]) { display: none; }
canvas, img { position: absolute; inset: 0; width: 100%; height: 100%; }
canvas:focus-visible { outline: 2px solid #6bf; outline-offset: -2px; }
img { object-fit: contain; pointer-events: none; }
slot { display: block; position: absolute; inset: 0; overflow: hidden; background: inherit; pointer-events: none; }
slot, img { transition: opacity .2s, visibility .2s; }
.past { opacity: 0; visibility: hidden; }
:host([fit="cover"]) img { object-fit: cover; }
.error { position: absolute; inset: 0 0 auto; margin: 0; padding: 8px 12px; background: #611e;
  overflow-wrap: anywhere; }
.bar { position: absolute; inset: auto 0 0; display: flex; gap: 8px; align-items: center; padding: 6px 10px;
  background: #000a; }
.bar > * { flex: none; }
button, select { font: inherit; color: inherit; background: #0006; border: 1px solid #fff4; border-radius: 4px;
  min-width: 32px; height: 28px; padding: 0 6px; cursor: pointer; }
select option { color: #000; }
button:focus-visible, select:focus-visible, input:focus-visible { outline: 2px solid #6bf; }
button svg { display: block; width: 16px; height: 16px; margin: auto; fill: currentColor; }
.time { position: relative; flex: 1 1 60px; min-width: 40px; height: 28px; }
.levels { position: absolute; inset: 10px 0; display: flex; flex-direction: column-reverse; border-radius: 3px;
  overflow: hidden; background: #fff2; }
.levels i { flex: 1; width: 0; background: #6bf; opacity: .8; }
.levels i:nth-child(2) { opacity: .6; }
.levels i:nth-child(3) { opacity: .4; }
input { -webkit-appearance: none; appearance: none; position: absolute; inset: 0; width: 100%; height: 100%; margin: 0;
  background: none; cursor: pointer; }
input::-webkit-slider-runnable-track { background: none; }
input::-webkit-slider-thumb { -webkit-appearance: none; width: 6px; height: 22px; border-radius: 3px;
  background: #fff; box-shadow: 0 0 0 2px #000a; }
input::-moz-range-track { background: none; }
input::-moz-range-thumb { width: 6px; height: 22px; border: 0; border-radius: 3px; background: #fff;
  box-shadow: 0 0 0 2px #000a; }
.clock, .status { font-variant-numeric: tabular-nums; }
.status { position: absolute; inset: auto 6px 46px auto; margin-left: 6px; padding: 1px 6px; border-radius: 4px;
  background: #000a; pointer-events: none; }
.status:empty { display: none; }
@container (max-width: 420px) {
  .bar { flex-wrap: wrap; justify-content: flex-end; }
  .bar .time { flex-basis: 100%; order: -1; }
  .bar .play { margin-right: auto; }
  .status { bottom: 80px; }
}
@container (max-width: 340px) {
  .clock { display: none; }
}
[hidden] { display: none !important; }
`;

/** @param {string} path on a square of 16 */
const icon = (path) => `<svg viewBox="0 0 16 16" aria-hidden="true"><path d="${path}"/></svg>`;
const PLAY = icon("M3 1v14l11-7z");
const PAUSE = icon("M3 1h4v14H3zM9 1h4v14H9z");
const HOME = icon("M8 1 1 8h2v6h4v-4h2v4h4V8h2z");
const FULL = icon("M1 1h5v2H3v3H1zM10 1h5v5h-2V3h-3zM1 10h2v3h3v2H1zM13 10h2v5h-5v-2h3z");

const BODY = `
<canvas tabindex="0" role="application" aria-label="Dynamic scene"
  aria-keyshortcuts="Space ArrowLeft ArrowRight ArrowUp ArrowDown + - Home , . f"></canvas>
<slot></slot>
<img alt="" hidden>
<p class="error" role="alert" hidden></p>
<div class="status" part="status" aria-hidden="true"></div>
<div class="bar" role="group" aria-label="Player" hidden>
  <button class="play" type="button"></button>
  <div class="time">
    <div class="levels"></div><input type="range" min="0" max="1" step="any" value="0" aria-label="Time">
  </div>
  <span class="clock" aria-hidden="true"></span>
  <select aria-label="Highest level"></select>
  <button class="home" type="button" aria-label="Reset the view" title="Reset the view">${HOME}</button>
  <button class="vr" type="button" aria-label="Show in the headset" title="Show in the headset" hidden>VR</button>
  <button class="full" type="button" aria-label="Full screen" title="Full screen">${FULL}</button>
</div>
`;

/** A number from an attribute, null where there is none. @param {string | null} text */
const number = (text) => (text === null || text.trim() === "" || Number.isNaN(Number(text)) ? null : Number(text));

export class Pd4Player extends HTMLElement {
  static observedAttributes = ["src", "level", "time", "loop", "speed", "fit", "free", "label", "controls", "poster"];

  constructor() {
    super();
    const root = this.attachShadow({ mode: "open" });
    const style = new CSSStyleSheet(); // a page may forbid style elements
    style.replaceSync(STYLE);
    root.adoptedStyleSheets = [style];
    root.innerHTML = BODY;
    /** @param {string} selector */
    const part = (selector) => /** @type {HTMLElement} */ (root.querySelector(selector));
    this._poster = /** @type {HTMLImageElement} */ (part("img"));
    this._slot = part("slot");
    this._error = part(".error");
    this._statusLine = part(".status");
    this._bar = part(".bar");
    this._levels = part(".levels");
    this._clock = part(".clock");
    this._play = /** @type {HTMLButtonElement} */ (part(".play"));
    this._slider = /** @type {HTMLInputElement} */ (part("input"));
    this._select = /** @type {HTMLSelectElement} */ (part("select"));
    /** @type {Player | null} */
    this._player = null;
    /** @type {Orbit | null} */
    this._orbit = null;
    this._timer = 0;
    /** Of a segment, that is told. */
    this._problem = "";

    this._play.addEventListener("click", () => this.toggle());
    this._slider.addEventListener("input", () => this.seek(Number(this._slider.value)));
    this._select.addEventListener("change", () => (this.level = number(this._select.value)));
    part(".home").addEventListener("click", () => this._orbit?.reset());
    part(".vr").addEventListener("click", () => this._enterVr());
    hasHeadset().then((there) => (part(".vr").hidden = !there));
    part(".full").addEventListener("click", () => this._toggleFullScreen());
    this._onKey = (/** @type {KeyboardEvent} */ event) => this._key(event);
    this._showState();
  }

  connectedCallback() {
    const old = /** @type {HTMLCanvasElement} */ (this.shadowRoot?.querySelector("canvas"));
    const canvas = /** @type {HTMLCanvasElement} */ (old.cloneNode()); // a context that was given up does not return
    old.replaceWith(canvas);
    const player = new Player(canvas, this._asked());
    this._player = player;
    for (const name of EVENTS) {
      player.addEventListener(name, (event) => {
        const { detail } = /** @type {CustomEvent} */ (event);
        this._react(name, detail);
        this.dispatchEvent(new CustomEvent(name, { detail }));
      });
    }
    this._timer = window.setInterval(() => this._showStatus(), STATUS_MS);
    document.addEventListener("keydown", this._onKey);
    this._showControls();
    this._showPoster();
    this._load();
  }

  disconnectedCallback() {
    clearInterval(this._timer);
    document.removeEventListener("keydown", this._onKey);
    this._orbit?.close();
    this._orbit = null;
    this._player?.close();
    this._player = null;
  }

  /** @param {string} name @param {string | null} before @param {string | null} value */
  attributeChangedCallback(name, before, value) {
    if (!this._player || before === value) return;
    if (name === "src") this._load();
    else if (name === "level") this._player.level = number(value);
    else if (name === "time") this.seek(number(value) ?? 0);
    else if (name === "loop") this._player.loop = value !== null;
    else if (name === "speed") this._player.speed = this._asked().speed;
    else if (name === "fit") this._player.fit = this._asked().fit;
    else if (name === "free" || name === "label" || name === "controls") this._showControls();
    else this._showPoster();
  }

  // --- for scripts

  /** The player, null while the element is in no document. */
  get player() {
    return this._player;
  }

  /** Loads a scene in place of the one on show. @param {string | URL | Blob} source */
  async load(source) {
    this._say("");
    if (!this._player) return;
    Object.assign(this._player._options, this._asked());
    await this._player.load(source);
  }

  get src() {
    return this.getAttribute("src");
  }

  set src(value) {
    if (value === null) this.removeAttribute("src");
    else this.setAttribute("src", value);
  }

  /** The highest level to show, null: all. */
  get level() {
    return this._player ? this._player.level : number(this.getAttribute("level"));
  }

  set level(level) {
    if (level === null) this.removeAttribute("level");
    else this.setAttribute("level", String(level));
  }

  get camera() {
    return this._player?.camera ?? null;
  }

  set camera(camera) {
    if (this._player) this._player.camera = camera;
  }

  /** Seconds of the scene's time. */
  get time() {
    return this._player?.time ?? 0;
  }

  set time(seconds) {
    this.seek(seconds);
  }

  get paused() {
    return this._player?.paused ?? true;
  }

  /** @param {number} seconds of the scene's time */
  seek(seconds) {
    this._player?.seek(seconds);
  }

  play() {
    this._player?.play();
  }

  pause() {
    this._player?.pause();
  }

  toggle() {
    if (this.paused) this.play();
    else this.pause();
  }

  // --- inside

  /** What the attributes ask of a player. */
  _asked() {
    return {
      level: number(this.getAttribute("level")),
      time: number(this.getAttribute("time")),
      autoplay: this.hasAttribute("autoplay"),
      loop: this.hasAttribute("loop"),
      speed: Math.max(number(this.getAttribute("speed")) ?? 1, 0),
      fit: /** @type {import("./render/camera.js").Fit} */ (this.getAttribute("fit") === "cover" ? "cover" : "contain"),
      bytes: number(this.getAttribute("max-bytes")),
      seconds: number(this.getAttribute("max-seconds")),
      held: number(this.getAttribute("poster-bytes")),
    };
  }

  _load() {
    const { src } = this;
    if (src !== null && src !== "") this.load(src);
  }

  /** @param {string} name @param {any} detail */
  _react(name, detail) {
    if (name === "error" && detail.segment === undefined) this._say(detail.message); // else when its time comes
    if (name === "firstpicture") this._showPoster();
    if (name === "statechange" || name === "timeupdate") this._showState();
    if (name !== "timeupdate") this._showStatus();
  }

  /** Shows a message, or none. @param {string} text */
  _say(text) {
    this._error.textContent = text;
    this._error.hidden = !text;
  }

  _showPoster() {
    const poster = this.getAttribute("poster");
    const drawn = this._player?.status.level !== null;
    if (poster !== null && !drawn) this._poster.src = poster;
    this._poster.hidden = poster === null;
    for (const cover of [this._poster, this._slot]) cover.classList.toggle("past", drawn);
  }

  _showControls() {
    const controls = this.hasAttribute("controls");
    this._bar.hidden = this._statusLine.hidden = !controls;
    const canvas = this._player?.canvas;
    if (canvas) canvas.tabIndex = controls ? 0 : -1; // without controls keys do nothing
    canvas?.setAttribute("role", controls ? "application" : "img");
    canvas?.setAttribute("aria-label", this.getAttribute("label") ?? "Dynamic scene");
    this._orbit?.close();
    this._orbit = controls && this._player ? new Orbit(this._player, this._player.canvas) : null;
    if (this._orbit) this._orbit.free = this.hasAttribute("free");
  }

  _showState() {
    const { paused } = this;
    const label = paused ? "Play" : "Pause";
    if (this._play.title !== label) {
      this._play.innerHTML = paused ? PLAY : PAUSE;
      this._play.setAttribute("aria-label", label);
      this._play.title = label;
    }
    const [start, end] = this._player?.timeRange ?? [0, 0];
    this._slider.min = String(start);
    this._slider.max = String(end > start ? end : start + 1);
    this._slider.value = String(this.time);
    const clock = `${(this.time - start).toFixed(1)} / ${(end - start).toFixed(1)} s`;
    this._slider.setAttribute("aria-valuetext", clock);
    this._clock.textContent = clock;
  }

  /** The status line, the levels on the time bar and in the list. */
  _showStatus() {
    const player = this._player;
    if (!player) return;
    const { bytes, total, ends, level, levels, fps, scale, software, lost, problem, awaited } = player.status;
    if (lost !== (this._error.textContent === LOST)) this._say(lost ? LOST : "");
    if (problem !== this._problem) this._say(problem);
    this._problem = problem;
    if (this._bar.hidden) return;
    const drawn = level !== null;
    const { layer: last, end } = ends[ends.length - 1] ?? { layer: levels[levels.length - 1], end: total };
    const parts = bytes ? [`${drawn ? `level ${level} of ${last}, ` : ""}${sizes(bytes, end)}`] : [];
    if (awaited) parts.push(`waiting for ${awaited[0].toFixed(1)} to ${awaited[1].toFixed(1)} s`);
    if (fps) parts.push(`${fps.toFixed(fps < 9.5 ? 1 : 0)} fps`);
    const fewer = scale < 1 ? `${SIZE_NAMES[SCALES.indexOf(scale)]} size: ` : "";
    if (drawn && (software || fewer)) parts.push(fewer + (software ? "no GPU found" : "drawing is slow"));
    this._statusLine.textContent = parts.join(" · ");

    const whole = ends.filter(({ layer }, i) => layer !== ends[i + 1]?.layer); // of slices the last one
    while (this._levels.children.length < whole.length) this._levels.append(document.createElement("i"));
    while (this._levels.children.length > whole.length) this._levels.lastChild?.remove();
    whole.forEach(({ end }, i) => {
      const begin = i ? whole[i - 1].end : 0;
      const share = Math.min(Math.max((bytes - begin) / (end - begin), 0), 1);
      /** @type {HTMLElement} */ (this._levels.children[i]).style.width = `${100 * share}%`;
    });

    const names = ["all levels", ...levels.map((n) => `level ${n}`)];
    if (this._select.options.length !== names.length) {
      this._select.replaceChildren(...names.map((name, i) => new Option(name, i ? String(levels[i - 1]) : "")));
    }
    this._select.value = this.level === null ? "" : String(this.level);
    this._showState();
  }

  /** @param {KeyboardEvent} event */
  _key(event) {
    if (!this._orbit || event.defaultPrevented || event.ctrlKey || event.metaKey || event.altKey) return;
    // buttons and slider have keys of their own, a page keeps its own unless the pointer is over the scene
    const unclaimed = document.activeElement === document.body && (this._orbit.fills || this.matches(":hover"));
    if (event.composedPath()[0] !== this._player?.canvas && !unclaimed) return;
    if (event.key === " ") this.toggle();
    else if (event.key === "f") this._toggleFullScreen();
    else if (event.key === "," || event.key === ".") this.seek(this.time + (event.key === "." ? FRAME : -FRAME));
    else if (!this._orbit.key(event)) return;
    event.preventDefault();
  }

  _enterVr() {
    const player = this._player;
    if (player) enterVr(player).catch(({ message }) => this._react("error", { message }));
  }

  _toggleFullScreen() {
    if (document.fullscreenElement) document.exitFullscreen();
    else this.requestFullscreen?.().catch(() => {}); // a page may forbid it
  }
}

/** How much has come, in the unit of all. @param {number} bytes @param {number | null} total */
function sizes(bytes, total) {
  const [unit, by, digits] = (total ?? bytes) < 1e6 ? /** @type {const} */ (["kB", 1e3, 0]) : ["MB", 1e6, 1];
  const [come, all] = [bytes, total ?? 0].map((n) => (n / by).toFixed(digits));
  return `${come === all || !total ? "" : `${come} of `}${total ? all : come} ${unit}`;
}

customElements.define("pd4-player", Pd4Player);
