#!/usr/bin/env bash
# Makes its own environment in .venv and runs the main job: train a synthetic dynamic scene, pack it, unpack every
# prefix, render each level. Arguments go to tools/demo.py (see `bash tools/demo.sh --help`).
set -euo pipefail
cd "$(dirname "$0")/.."
source tools/environment.sh
make_environment .venv train
exec .venv/bin/python tools/demo.py "$@"
