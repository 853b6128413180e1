"""One run of one variant on one scene: trained if it is missing, packed, measured; all of it kept by its settings."""

from __future__ import annotations

import json
import lzma
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from pages.page import commit
from pages.trainings import ensure_trained
from pd4dgs_codec.data.view import Dataset
from pd4dgs_codec.format.encoder import encode_with_report
from pd4dgs_codec.io import finite, whole_file, write_bytes
from pd4dgs_codec.model import checkpoint
from pd4dgs_codec.model.convert import to_scene
from pd4dgs_codec.model.model import Model
from pd4dgs_codec.quality.evaluate import evaluate_file
from pd4dgs_codec.quality.packing import Views, pack
from pd4dgs_codec.quality.perceptual import load_perceptual
from pd4dgs_codec.scene import MASK_THRESHOLD
from pd4dgs_codec.train.config import ABLATIONS, TrainConfig

#: Training views whose pictures say what a smaller layer 0 costs.
FITTING_VIEWS = 16
#: Updates of rho (150 a run) from one that is kept to the next.
COURSE_EVERY = 5
#: Shares of the anchors, those first that move least, whose masks are looked at: the still half, the moving tenth.
MOTION_SHARES = ((0.0, 0.5), (0.9, 1.0))
#: Instants at which it is looked where level 1 takes an anchor.
MOTION_INSTANTS = 13


@dataclass(frozen=True)
class Variant:
    """A way to train, as changes of TrainConfig. monolithic: shipped in one piece, all tensors float32 under LZMA.
    longer: times the iterations of its scene."""

    name: str
    changes: dict[str, Any] = field(default_factory=dict)
    monolithic: bool = False
    longer: int = 1


FULL = Variant("full")
SCAFFOLD = Variant("static scaffold alone", {"max_layer": 0})
TWO_LAYER = Variant("two layers", {"max_layer": 1})
#: The full method, but each step trains every level, with a view of its own: as many steps of each as the models made
#: for one purpose have.
EVERY_LEVEL = Variant("every level in every step", {"rollout": "all"})
#: The full method, as many steps of each level by drawing levels three times as often.
THRICE = Variant("three times the steps", longer=3)
#: What the comparison calls them.
OURS = (("ours", FULL), ("thrice", THRICE), ("every level", EVERY_LEVEL))
#: Every step trains all layers together, and nothing is spent on bytes, levels or quantisation.
MONOLITHIC = Variant(
    "monolithic", {"rollout": "top", **ABLATIONS["rate"], **ABLATIONS["tmc"], **ABLATIONS["noise"]}, monolithic=True
)
UNIFORM = Variant("uniform", {"rollout": "uniform"})
FIXED = Variant("fixed", {"rollout": "fixed"})
WITHOUT = tuple(Variant(f"without {part}", ABLATIONS[part]) for part in ("rate", "binary", "smooth", "tmc"))


#: What the tables' runs weigh the rate with, whatever the trainer's default is.
RATE_SCALE = 0.1


def at_rate(scale: float) -> Variant:
    """The full method at another rate weight; `full` itself at that of the tables."""
    return FULL if scale == RATE_SCALE else Variant(f"rate scale {scale:g}", {"rate_scale": scale})


@dataclass(frozen=True)
class Scene:
    """A scene of a table and how its runs are trained, but for variant and seed."""

    name: str
    config: TrainConfig
    seeds: int  #: at most so many runs of each variant


@dataclass(frozen=True)
class Run:
    """One training of a table."""

    scene: Scene
    variant: Variant
    seed: int

    @property
    def config(self) -> TrainConfig:
        """What it is trained with."""
        base = self.scene.config
        iterations = base.iterations and base.iterations * self.variant.longer
        return replace(base, seed=self.seed, iterations=iterations, **self.variant.changes)

    def folder(self, out: Path) -> Path:
        """Where it lies below `out`."""
        config = self.scene.config
        budget = f"{config.preset}-{config.iterations}"
        return out / self.scene.name / budget / f"{self.variant.name.replace(' ', '-')}-{self.seed}"


def measure(
    run: Run, dataset: Callable[[], Dataset], out: Path, *, say: Callable[[str], None], progress: Any = None
) -> dict[str, Any]:
    """The result of `run`, from its result.json if there is one of the same settings, else made now.

    {"scene", "variant", "seed", "commit", "config", "iterations", "seconds", "anchors", "rho", "active": anchors per
    level, "gap_by_motion": see there, "pi": what `course` reads, "levels": rows of pd4dgs-eval --perceptual}. The one
    level of a monolithic variant is its highest, its bytes those of `monolithic_bytes`. dataset: loads the scene when
    needed.
    """
    folder = run.folder(out)
    wanted = json.loads(json.dumps(run.config, default=lambda value: value.__dict__))
    file = folder / "result.json"
    if file.exists():
        stored: dict[str, Any] = json.loads(file.read_text())
        if stored["config"] == wanted:
            return {"commit": "unknown"} | stored
    data = dataset()
    path = folder / "model.pt"
    model, training = ensure_trained(run.config, data, path, say=say, progress=progress)
    perceptual = load_perceptual()
    if run.variant.monolithic:
        levels = evaluate_file(path, data, perceptual=perceptual)["levels"][-1:]
        levels[0]["cumulative_bytes"] = monolithic_bytes(model)
    else:
        packed, _ = encode_with_report(to_scene(model))
        write_bytes(folder / "scene.pd4", packed, overwrite=True)
        levels = evaluate_file(packed, data, perceptual=perceptual)["levels"]
    result = {
        "scene": run.scene.name,
        "variant": run.variant.name,
        "seed": run.seed,
        "commit": commit(),
        "config": wanted,
        "iterations": training["iteration"],
        "seconds": training["seconds"],
        "anchors": len(model.anchor_q),
        "rho": training["rho"],
        "active": [int((model.masks(level) > MASK_THRESHOLD).sum()) for level in range(3)],
        "gap_by_motion": gap_by_motion(model),
        "pi": course(path.with_name("train.jsonl")),
        "levels": levels,
    }
    return _keep(file, result)


def held_to(
    result: dict[str, Any],
    run: Run,
    limit: int,
    dataset: Callable[[], Dataset],
    out: Path,
    *,
    say: Callable[[str], None],
) -> dict[str, Any]:
    """The result of `run`, its file packed so that header and layer 0 have at most `limit` bytes, as
    `pd4dgs-encode --target-size` does with the training views; `result` as it is if they have. Kept as held.json."""
    if result["levels"][0]["cumulative_bytes"] <= limit:
        return result
    file = run.folder(out) / "held.json"
    stored = json.loads(file.read_text()) if file.exists() else {}
    if (stored.get("config"), stored.get("limit")) == (result["config"], limit):
        return result | {"levels": stored["levels"]}
    say(f"layer 0 is held to {limit:,} bytes")
    data = dataset()
    model, _ = checkpoint.load(run.folder(out) / "model.pt")
    fitting = Views.of(data, run.config.source, FITTING_VIEWS).fitting
    packed = pack(model, target_sizes={0: limit}, views=Views(run.config.source, fitting))
    levels = evaluate_file(packed.data, data, perceptual=load_perceptual())["levels"]
    held = _keep(file, {"config": result["config"], "limit": limit, "levels": levels})
    return result | {"levels": held["levels"]}


def _keep(file: Path, value: dict[str, Any]) -> dict[str, Any]:
    """Writes `value` as JSON and returns what the file then says, which is what a later run will read."""
    with whole_file(file, overwrite=True) as temporary:
        temporary.write_text(json.dumps(finite(value), indent=1, allow_nan=False))
    kept: dict[str, Any] = json.loads(file.read_text())
    return kept


def course(log: Path) -> list[dict[str, Any]]:
    """iteration, rho and pi over a run, from its log: every COURSE_EVERY-th step after which rho is updated, and the
    last such step."""
    keys = ("iteration", "rho", "pi")
    records = [record for record in map(json.loads, log.read_text().splitlines()) if "active" in record]
    kept = records[::-COURSE_EVERY][::-1]
    return [{key: record[key] for key in keys} for record in kept]


@torch.no_grad()
def gap_by_motion(model: Model) -> list[float] | None:
    """Mean m^(2) - m^(0) of the anchors in each of MOTION_SHARES, ordered by the diagonal of the box in which level 1
    moves them; None without level 1. Over all anchors this mean is what rho follows."""
    if model.global_deformation is None:
        return None
    position = model.anchor
    instants = torch.linspace(0, 1, MOTION_INSTANTS).tolist()
    moved = torch.stack([model.global_deformation(position, t)["position"] for t in instants])
    order = (moved.amax(0) - moved.amin(0)).norm(dim=1).argsort()
    gap = (model.masks(2) - model.masks(0))[order]
    n = len(gap)
    return [float(gap[int(low * n) : max(int(high * n), 1)].mean()) for low, high in MOTION_SHARES]


def monolithic_bytes(model: Model) -> int:
    """Bytes of all layers in one piece, as the paper ships deformations: every tensor as float32 (anchors as positions,
    no masks: each anchor is always there), one after another, under LZMA at its highest preset."""
    tensors = {"anchor": model.anchor} | {
        name: tensor for name, tensor in model.state_dict().items() if name not in ("anchor_q", "mask_logits")
    }
    return len(lzma.compress(b"".join(t.float().cpu().numpy().tobytes() for t in tensors.values()), preset=9))
