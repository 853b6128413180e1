// The script of index.html.

import "./element.js";
import { bench } from "./render/bench.js";

const query = new URLSearchParams(location.search);
/** @typedef {{early: import("./render/loader.js").Early}} Begun */
/** A packed page may hold its scene; for all others early.js knows the address. */
const held = document.getElementById("scene")?.textContent;
const bytes = held ? Uint8Array.from(atob(held), (c) => c.charCodeAt(0)) : null;
const source = bytes ? new Blob([bytes]) : /** @type {Begun} */ (/** @type {unknown} */ (globalThis)).early.url;

const player = /** @type {import("./element.js").Pd4Player} */ (document.querySelector("pd4-player"));

if (query.has("bench")) {
  player.remove();
  bench(source, document.body, query.get("sizes") ?? undefined);
} else {
  for (const name of ["controls", "autoplay", "loop"]) player.toggleAttribute(name, query.get(name) !== "0");
  player.setAttribute("label", document.querySelector("h1")?.textContent ?? "");
  player.toggleAttribute("free", query.get("free") === "1");
  for (const name of ["level", "time", "speed", "fit", "poster", "max-bytes", "max-seconds"]) {
    const value = query.get(name);
    if (value !== null) player.setAttribute(name, value);
  }
  player.load(source);
  document.body.addEventListener("dragover", (event) => event.preventDefault());
  document.body.addEventListener("drop", (event) => {
    event.preventDefault();
    const file = event.dataTransfer?.files[0];
    if (file) player.load(file);
  });
}
