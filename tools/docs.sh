#!/usr/bin/env bash
# Makes its own environment in .venv-docs and builds the documentation site in out/site/ (open out/site/index.html).
# Every warning is an error: a link inside the site that leads nowhere fails. Arguments go to Sphinx, e.g. `-E`.
set -euo pipefail
cd "$(dirname "$0")/.."
source tools/environment.sh
make_environment .venv-docs docs
rm -rf out/site
.venv-docs/bin/python -m sphinx -q -W --keep-going -j auto -c tools/site -d out/site.doctrees "$@" . out/site
.venv-docs/bin/python -m pd4dgs_codec view --sample -o out/site/sample.html # the first page shows it
.venv-docs/bin/python tools/notebook.py docs/tutorial.md out/site/tutorial.ipynb
echo "The site is in out/site/index.html"
