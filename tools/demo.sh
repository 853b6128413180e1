#!/usr/bin/env bash
# Makes its own environment in .venv, then trains a figure that dances, packs it in slices, and measures and draws what
# every level and every prefix of the file shows. All results are in out/demo/.
set -euo pipefail
cd "$(dirname "$0")/.."
source tools/environment.sh
make_environment .venv train
PATH=$PWD/.venv/bin:$PATH
scene='synthetic:dancer'
mkdir -p out/demo
cd out/demo
set -x
pd4dgs-train "$scene" -o model.pt --preset tiny --slots 5 --keep-layers --max-seconds 120 -f
pd4dgs-encode model.pt -o scene.pd4 --slices 20k --keep-levels -f
pd4dgs-eval scene.pd4 "$scene"
pd4dgs-render scene.pd4 -o levels.png --side-by-side --data "$scene" --frames 3 -f
python ../../benchmarks/refining_gif.py scene.pd4 -o arriving.gif
{ set +x; } 2> /dev/null
cat << END

In out/demo/: scene.pd4 is the file, levels.png shows its levels beside the truth at three times, and arriving.gif
plays the scene while its bytes arrive. To play the file in your browser:

    .venv/bin/pd4dgs-view out/demo/scene.pd4
END
