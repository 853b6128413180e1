"""The stability table: what a case and its row are, and what the rooms share."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
import torch

from pd4dgs_codec.bench.report import markdown
from pd4dgs_codec.draw.visibility import near_plane
from pd4dgs_codec.errors import DataError, Pd4Error
from pd4dgs_codec.model.model import Model
from pd4dgs_codec.model.picture import render
from pd4dgs_codec.model.rasterization import rasterization
from pd4dgs_codec.scene import Camera, Deformation, Network, Scene, SceneInfo, Steps, Widths

PASS, REFUSED, FAIL = "pass", "refused", "fail"
#: Modules of this folder, in the table's order.
ROOMS = ("rate", "symbols", "fields", "rasteriser", "training")
#: What came out, in words, and the error; NaN breaks every promise.
Found = tuple[str, float]


@dataclass(frozen=True)
class Case:
    """One stiff or extreme input. fed, promised: in words. bound: the largest error that keeps the promise. refuses:
    the error that must be raised instead, for input that has no answer; bound is then unused."""

    group: str
    case: str
    fed: str
    promised: str
    bound: float
    measure: Callable[[], Found]
    refuses: type[Pd4Error] | None = None


@dataclass(frozen=True)
class Row:
    """A case and its outcome. error and bound: None where there was nothing to measure. status: pass, refused, fail."""

    case: str
    group: str
    fed: str
    promised: str
    got: str
    error: float | None
    bound: float | None
    status: str


def refusal(group: str, case: str, fed: str, error: type[Pd4Error], act: Callable[[], object]) -> Case:
    """The case of an input that must be refused with `error` in one line; anything that `act` returns is a failure."""

    def measure() -> Found:
        act()
        return "accepted", math.nan

    return Case(group, case, fed, f"refused in one line ({error.__name__})", math.nan, measure, error)


def judge(case: Case) -> Row:
    """Runs a case. Whatever it raises is a failed row, but for the refusal that was promised; a module that is missing
    is the caller's concern."""
    error: float | None = None
    try:
        got, error = case.measure()
        status = PASS if case.refuses is None and error <= case.bound else FAIL
    except ModuleNotFoundError:
        raise
    except Exception as problem:
        kept = case.refuses is not None and isinstance(problem, case.refuses) and "\n" not in str(problem)
        status = REFUSED if kept else FAIL
        got = " ".join(f"{type(problem).__name__}: {problem}".split())
    bound = None if case.refuses else case.bound
    return Row(case.case, case.group, case.fed, case.promised, got, error, bound, status)


def chosen(name: str | None) -> list[Case]:
    """The cases of the group `name`, else those with `name` in their own name; all for None. In the table's order."""
    rooms = (import_module(f"{__package__}.{room}") for room in ROOMS)
    cases: list[Case] = [case for room in rooms for case in room.cases()]
    if name is None:
        return cases
    return [c for c in cases if c.group == name] or [c for c in cases if name.lower() in c.case.lower()]


def counts(rows: Sequence[Row]) -> dict[str, int]:
    """Rows per status."""
    found = Counter(row.status for row in rows)
    return {status: found[status] for status in (PASS, REFUSED, FAIL)}


def text(rows: Sequence[Row]) -> str:
    """The rows as one Markdown table per group, and a line that counts them."""
    head, parts = ("case", "fed", "promised", "came out", "error", "bound", "status"), []
    for group in dict.fromkeys(row.group for row in rows):
        own = [row for row in rows if row.group == group]
        cells = [(r.case, r.fed, r.promised, r.got, _number(r.error), _number(r.bound), r.status) for r in own]
        parts.append(f"## {group}\n\n" + markdown(head, [[c.replace("|", "\\|") for c in line] for line in cells]))
    found = counts(rows)
    parts.append(f"{len(rows)} rows: {found[PASS]} pass, {found[REFUSED]} refused as promised, {found[FAIL]} fail")
    return "\n\n".join(parts)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2g}"


# -- what the rooms share ----------------------------------------------------------------------------------------------


def mpmath() -> Any:
    """The library of the high-precision references. Raises DataError where it is not installed."""
    try:
        return import_module("mpmath")
    except ModuleNotFoundError:
        message = "the references of the stability table need mpmath, which is not installed"
        raise DataError(f"{message}: pip install 'pd4dgs-codec[test]'") from None


def largest(errors: Iterable[float]) -> float:
    """The largest of some numbers, NaN if one is."""
    return float(np.max(np.array(list(errors))))


WIDTH, HEIGHT = 40, 30
BOX = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]], np.float32)
_VIEWMAT = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]], np.float32)
CAMERA = Camera(_VIEWMAT, np.array([[40, 0, WIDTH / 2], [0, 40, HEIGHT / 2], [0, 0, 1]], np.float32), WIDTH, HEIGHT)


def small_scene(deformation: Deformation | None = None, anchors: int = 40, mask: int = 255) -> Scene:
    """A few anchors in front of CAMERA: layer 0, or layers 0 and 1 with a global deformation. mask: of every anchor."""
    rng = np.random.default_rng(3)
    cells = rng.choice(21**3, anchors, replace=False)
    layers = (0,) if deformation is None else (0, 1)
    networks: dict[str, Network] = {
        name: ((rng.normal(0, 0.3, (n, 35)).astype(np.float32), np.full(n, 0.2, np.float32)),)
        for name, n in Widths().networks.items()
    }
    return Scene(
        info=SceneInfo(0.0625, BOX, (0.0, 1.0), (0.25, 0.5, 0.75), 0.0625, 100.0, (0.0, -1.0, 0.0), 0.0, CAMERA),
        steps=Steps(),
        layers=layers,
        rows=(anchors,) * len(layers),
        anchor_q=np.stack(np.unravel_index(cells, (21, 21, 21)), 1).astype(np.int32) - 10,
        feature=rng.normal(0, 1, (anchors, 32)).astype(np.float32),
        scaling_log=rng.normal(-2.5, 0.3, (anchors, 6)).astype(np.float32),
        offset=rng.normal(0, 1, (anchors, 10, 3)).astype(np.float32),
        mask=(np.full(anchors, mask, np.uint8),) * len(layers),
        networks=networks,
        global_deformation=deformation,
    )


@torch.no_grad()
def picture_error(model: Model, level: int, t: float, camera: Camera = CAMERA) -> float:
    """Largest difference of a channel of a pixel between the float32 picture and the float64 oracle's picture of the
    same Gaussians; NaN where the former is not finite."""
    picture = render(model, level, t, camera)
    g, near = picture.gaussians, near_plane(model.info)
    drawn = g.colors.isfinite().all(1)
    means, quats, scales, opacities, colors = (a[drawn] for a in (g.means, g.quats, g.scales, g.opacities, g.colors))
    expected, _, _ = rasterization(
        means, quats, scales, opacities, colors, camera, model.info.background, near_plane=near, backend="reference"
    )
    return float((picture.image.double() - expected).abs().max())
