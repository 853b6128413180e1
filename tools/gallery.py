"""Trains our own synthetic scenes and lays them out as a gallery: `python tools/gallery.py [--seconds 150]`.

out/gallery/ gets a page per scene, player and scene in one HTML file, and an index with moving pictures. tools/docs.sh
puts the folder on the site. A scene that has its page is left as it is. Needs the extra `train`.
"""

from __future__ import annotations

import argparse
import html
import subprocess
import sys
import tempfile
from pathlib import Path

FOLDER = Path(__file__).resolve().parents[1] / "out" / "gallery"
SCENES = {
    "global": "large objects move slowly",
    "local": "small parts move on their own",
    "fast": "quick motion",
    "flyby": "a ball flies past a cube",
    "bend": "a column bends",
    "blink": "things appear and vanish",
}
STYLE = "body{font:16px system-ui;margin:2em}main{display:flex;flex-wrap:wrap;gap:1em}figure{margin:0}img{width:20em}"


def run(verb: str, *arguments: object) -> None:
    """A command of the package."""
    subprocess.run([sys.executable, "-m", "pd4dgs_codec", verb, *map(str, arguments)], check=True)


def add(name: str, seconds: float) -> None:
    """NAME.gif and, when all else is done, NAME.html."""
    with tempfile.TemporaryDirectory() as temporary:
        model, scene = Path(temporary) / "model.pt", Path(temporary) / "scene.pd4"
        run("train", f"synthetic:{name}", "-o", model, "--preset", "tiny", "--max-seconds", seconds)
        run("encode", model, "-o", scene, "--slices", "50k")
        run("render", scene, "--orbit", 24, "-o", FOLDER / f"{name}.gif", "-f")
        run("view", scene, "-o", FOLDER / f"{name}.html", "-f")


def card(name: str) -> str:
    """A scene of the index."""
    size = (FOLDER / f"{name}.html").stat().st_size / 1e6
    what = f"synthetic:{name}: {html.escape(SCENES[name])} ({size:.1f} MB with the player)"
    return (
        f'<figure><a href="{name}.html"><img src="{name}.gif" alt="{name}"></a><figcaption>{what}</figcaption></figure>'
    )


def main() -> None:
    """Makes what is missing, then the index."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=150.0, help="training time of a scene (%(default)s)")
    args = parser.parse_args()
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name in SCENES:
        if not (FOLDER / f"{name}.html").exists():
            add(name, args.seconds)
    cards = "\n".join(map(card, SCENES))
    title = "Synthetic scenes"
    page = f"<!doctype html>\n<html lang=en><meta charset=utf-8><title>{title}</title><style>{STYLE}</style>\n"
    (FOLDER / "index.html").write_text(f"{page}<h1>{title}</h1><main>\n{cards}\n</main>\n</html>\n", encoding="utf-8")


if __name__ == "__main__":
    main()
