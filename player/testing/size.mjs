// Sizes of the decoder, bundled and minified, in bytes: `npm install && npm run size`. One line per entry, as JSON.

import { fileURLToPath } from "node:url";
import { gzipSync } from "node:zlib";

import { build } from "esbuild";

const ENTRIES = { decoder: "index.js", "decoder, in a Worker": "worker.js", "decoder and fetch": "fetch.js", "page's side of the Worker": "worker-decoder.js" };

for (const [name, file] of Object.entries(ENTRIES)) {
  const { outputFiles } = await build({
    entryPoints: [fileURLToPath(new URL(`../decode/${file}`, import.meta.url))],
    bundle: true,
    minify: true,
    format: "esm",
    target: "es2022",
    write: false,
  });
  const code = outputFiles[0].contents;
  console.log(JSON.stringify({ entry: name, minified: code.length, gzipped: gzipSync(code, { level: 9 }).length }));
}
