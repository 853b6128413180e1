// Sizes of what a page loads, bundled and minified, in bytes: `npm install && npm run size`. One line each, as JSON.

import { fileURLToPath } from "node:url";
import { gzipSync } from "node:zlib";

import { build } from "esbuild";

const WORKERS = ["render/loader-worker.js", "render/sort-worker.js", "render/evaluate-worker.js"];
const ENTRIES = ["decode/index.js", "element.js", "spark.js", ...WORKERS];

for (const entry of ENTRIES) {
  const { outputFiles } = await build({
    entryPoints: [fileURLToPath(new URL(`../${entry}`, import.meta.url))],
    bundle: true,
    minify: true,
    format: "esm",
    target: "es2022",
    write: false,
  });
  const code = outputFiles[0].contents;
  console.log(JSON.stringify({ entry, minified: code.length, gzipped: gzipSync(code, { level: 9 }).length }));
}
