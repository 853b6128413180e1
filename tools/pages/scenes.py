"""The scenes that the pages are made from, and where the real ones are read."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pd4dgs_codec.data.view import Dataset
    from pd4dgs_codec.train.config import TrainConfig

#: The folder of the real scenes, which are not part of the repository.
SHARED = Path(os.environ.get("PD4DGS_SHARED") or Path(__file__).resolve().parents[3] / "shared" / "data")


@dataclass(frozen=True)
class Scene:
    """One scene and how tools/results.py trains it. name: its folder in out/ and its rows; seconds: instead of
    iterations."""

    name: str
    source: str
    downscale: int = 1
    preset: str = "small"
    iterations: int = 1_500
    seconds: float | None = None

    @property
    def there(self) -> bool:
        """Whether its data are on this machine."""
        return self.source.startswith("synthetic:") or Path(self.source).is_dir()

    def load(self) -> Dataset:
        """Its views. Raises DataError."""
        from pd4dgs_codec.data.dataset import load

        return load(self.source, downscale=self.downscale)

    def config(self, **changes: Any) -> TrainConfig:
        """Of its training, all at the defaults but for `changes`."""
        from pd4dgs_codec.train.config import TrainConfig

        given = {"preset": self.preset, "source": self.source, "downscale": self.downscale}
        length = {"max_seconds": self.seconds} if self.seconds else {"iterations": self.iterations}
        return TrainConfig(**given | length | changes)


SCENES = {
    scene.name: scene
    for scene in (
        Scene("shelf-hand", str(SHARED / "shelf-hand"), 2, iterations=5_000),
        Scene("bouncing-balls", str(SHARED / "bouncing-balls"), 4, iterations=7_000),
        *(Scene(f"synthetic-{name}", f"synthetic:{name}") for name in ("static", "global", "local", "fast")),
        Scene("shelf-hand-paper", str(SHARED / "shelf-hand"), 2, "paper", 4_600),
        Scene("shelf-hand-large", str(SHARED / "shelf-hand"), 1, seconds=1_800),
        Scene("bouncing-balls-large", str(SHARED / "bouncing-balls"), 2, seconds=1_800),
        Scene("synthetic-large", "synthetic:local?size=960x540&frames=300", 1, seconds=1_800),
    )
}
#: Those of the preset small with pictures of a fraction of their size.
SMALL = tuple(name for name, scene in SCENES.items() if scene.preset == "small" and not scene.seconds)


def present(args: argparse.Namespace, names: Sequence[str] = tuple(SCENES)) -> list[Scene]:
    """Those of `names` that --only asks for, else all, whose data are there; says which are not. None for --render."""
    asked = [] if args.render else [SCENES[name] for name in names if not args.only or name in args.only]
    for scene in asked:
        if not scene.there:
            print(f"{scene.name}: {scene.source} is not there, left out", flush=True)
    return [scene for scene in asked if scene.there]
