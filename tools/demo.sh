#!/usr/bin/env bash
# Makes its own environment in .venv, then trains a synthetic scene from a camera that jumps, packs it, and measures and
# draws what every prefix of the file shows. All results are in out/demo/.
set -euo pipefail
cd "$(dirname "$0")/.."
source tools/environment.sh
make_environment .venv train
PATH=$PWD/.venv/bin:$PATH
scene='synthetic:fast?path=jump&frames=200'
mkdir -p out/demo
cd out/demo
set -x
pd4dgs-train "$scene" -o model.pt --preset tiny --max-seconds 150 -f
pd4dgs-encode model.pt -o scene.pd4 -f
pd4dgs-eval scene.pd4 "$scene"
pd4dgs-render scene.pd4 -o levels.png --side-by-side --data "$scene" --frames 1 -f
pd4dgs-render scene.pd4 -o levels.gif --side-by-side --data "$scene" --split train --frames 40 -f
pd4dgs-bench train --from model.pt --plot error-time.png -f
