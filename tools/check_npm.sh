#!/usr/bin/env bash
# Packs the player for npm, installs the archive in an empty project, checks its types as a TypeScript user would,
# bundles it with esbuild and vite, and decodes a vector with the bundle. Leaves the archive in the folder given.
set -euo pipefail
cd "$(dirname "$0")/.."
root=$PWD
archive=$(mkdir -p "${1:-out/npm}" && cd "${1:-out/npm}" && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
npm() { command npm --no-audit --no-fund --loglevel=error "$@"; }

"${PYTHON:-python3}" tools/npm_package.py "$work/package"
rm -f "$archive"/*.tgz
(cd "$work/package" && npm install --no-package-lock && npm pack --pack-destination "$archive")

cp -r tools/npm_user "$work/user"
cd "$work/user"
npm install --no-package-lock "$archive"/pd4-player-*.tgz esbuild vite typescript @types/node@20
npx tsc
npx esbuild decode.ts --bundle --platform=node --format=esm --outfile=esbuild/decode.mjs --log-level=warning
npx esbuild page.ts --bundle --format=esm --outdir=esbuild --log-level=warning
npx vite build --logLevel warn --base ./
found=$(node esbuild/decode.mjs "$root/spec/vectors/valid/layers-0-1-2.pd4")
echo "$found"
[ "$found" = '{"layers":[0,1],"anchors":5,"levels":3,"refused":"Truncated"}' ]
