#!/usr/bin/env bash
# Makes its own environment in .venv, then trains a synthetic dynamic scene, packs it, and measures and draws every
# prefix of the file. Arguments go to tools/demo.py (see `bash tools/demo.sh --help`).
set -euo pipefail
cd "$(dirname "$0")/.."
source tools/environment.sh
make_environment .venv train
exec .venv/bin/python tools/demo.py "$@"
