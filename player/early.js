// The first script of index.html, behind what is painted first, and no module: a worker asks for the scene while the
// rest of the page arrives. It becomes the loader once it is given the address of that code, by the packed page or by
// render/loader.js.

{
  const query = new URLSearchParams(location.search);
  /** A packed page may name its scene. */
  const address = document.documentElement.dataset.src ?? query.get("src") ?? "scene.pd4";
  const url = new URL(address, document.baseURI).href;
  const code = `"use strict";
    const controller = new AbortController();
    const url = ${JSON.stringify(url)};
    const answer = fetch(url, { signal: controller.signal });
    answer.catch(() => {});
    globalThis.early = { url, answer, controller };
    const waiting = [];
    onmessage = ({ data }) => {
      if (waiting.push(data) > 1) return;
      import(data).then(() => {
        onmessage = null;
        for (const data of waiting.slice(1)) dispatchEvent(new MessageEvent("message", { data }));
      }).catch((error) => setTimeout(() => { throw error; }));
    };`;
  const start = () => new Worker(URL.createObjectURL(new Blob([code], { type: "text/javascript" })));
  // a file: is no place to ask, and a bench loads by itself
  /** @type {Worker | null} */
  let worker = null;
  try {
    if (/^https?:/.test(url) && !query.has("bench")) worker = start();
  } catch {
    // a policy forbids it; the player says so if it forbids the next one as well
  }
  let begun = false;
  const begin = (/** @type {string} */ loader) => {
    if (!begun) worker?.postMessage(loader);
    begun = true;
  };
  const early = { url, worker, begin };
  if (worker) worker.onerror = () => (early.worker = null);
  Object.assign(globalThis, { early });
}
