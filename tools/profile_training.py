"""Where the time of a training step goes: processor milliseconds per part and level, as a Markdown table.

    python tools/profile_training.py out/*/model.pt [--steps 20] [--at 0.55] [--write docs/training.md]

Goes on from checkpoints of `pd4dgs-train`, on the data they were trained on, as if they stood at the share `--at` of
their runs, with the levels in turn; the checkpoints stay as they are. Each part is timed by wrapping the functions that
do it, and what a wrapped function spends in another one counts for the other alone. All run on one thread. Columns are
medians over the steps; a part's work in the backward pass that is not a kernel of its own is in "backward, the rest".
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from pages.parts import Stopwatch

if TYPE_CHECKING:
    from pd4dgs_codec.train.learner import Learner

#: Lines of a page between which `--write` puts the tables.
BEGIN, END = "<!-- profile: written by tools/profile_training.py -->", "<!-- end of profile -->"


def watch(learner: Learner, stopwatch: Stopwatch) -> None:
    """Wraps the parts of a step, and the step itself as what is none of them."""
    import torch

    from pd4dgs_codec.model import fused, plane_rate, plane_regularisers, rasterization, rate
    from pd4dgs_codec.model.model import Model
    from pd4dgs_codec.train import learner as steps
    from pd4dgs_codec.train import losses, ssim

    for owner, name, part in (
        (Model, "_visible", "choosing anchors"),
        (Model, "gaussians", "anchors to Gaussians, the rest"),
        (fused._Pick, "forward", "picking attributes, noise"),
        (fused._Pick, "backward", "picking attributes, backward"),
        (fused._Moved, "forward", "residuals: networks"),
        (fused._Moved, "backward", "residuals: networks, backward"),
        (fused._Grown, "forward", "scaffold networks"),
        (fused._Grown, "backward", "scaffold networks, backward"),
        (fused._Finish, "forward", "anchors to Gaussians, the rest"),
        (fused._Finish, "backward", "scaffold networks, backward"),
        (fused, "sample", "HexPlane kernels"),
        (fused, "sample_gradient", "HexPlane kernels, backward"),
        (rasterization, "rasterize_cpu", "rasteriser kernels"),
        (rasterization._Composite, "backward", "rasteriser kernels, backward"),
        (ssim._ImageLoss, "forward", "image loss"),
        (ssim._ImageLoss, "backward", "image loss, backward"),
        (plane_regularisers._Regularisers, "forward", "plane regularisers"),
        (plane_regularisers._Regularisers, "backward", "plane regularisers, backward"),
        (rate._RowBits, "forward", "rate term"),
        (rate._RowBits, "backward", "rate term, backward"),
        (plane_rate._ProxyBits, "forward", "planes' rate"),
        (plane_rate._ProxyBits, "backward", "planes' rate, backward"),
        (steps, "image_loss", "image loss"),
        (losses, "rate_term", "rate term"),
        (losses, "binary_term", "mask terms"),
        (losses, "smooth_term", "mask terms"),
        (losses.Neighbours, "draw", "mask terms"),
        (torch.autograd, "backward", "backward, the rest"),
        (torch.autograd, "grad", "backward, the rest"),
        (learner.grow, "observe", "growing: statistics"),
        (learner.optimiser, "gradient_norm", "gradient norm"),
        (learner.optimiser, "step", "Adam"),
    ):
        stopwatch.wrap(owner, name, part)
    for field, name in ((learner.model.global_deformation, "global"), (learner.model.local_deformation, "local")):
        if field is not None:
            stopwatch.wrap(field, "forward", f"{name} deformation networks")
    stopwatch.wrap(learner, "step", "all else")


def measure(learner: Learner, steps: int, iteration: int) -> list[list[dict[str, float]]]:
    """Per level of the model, one dictionary of seconds per part for each of `steps` steps, all of them as if they were
    the run's step `iteration`."""
    stopwatch, levels = Stopwatch(), range(learner.model.level + 1)

    def step(level: int) -> dict[str, float]:
        learner.iteration = iteration
        learner.step((level,))
        return stopwatch.take()

    for level in levels:  # compiles the kernels and fills the caches
        step(level)
    watch(learner, stopwatch)
    try:
        turns = [[step(level) for level in levels] for _ in range(steps)]
    finally:
        stopwatch.unwrap()
    return [list(level) for level in zip(*turns, strict=True)]


def rows(found: list[list[dict[str, float]]]) -> list[tuple[str, list[float]]]:
    """(part, milliseconds per level), the costliest part first, then the median of whole steps."""
    parts = {part for level in found for step in level for part in step}
    medians = {part: [1e3 * _median(step.get(part, 0.0) for step in level) for level in found] for part in parts}
    ordered = sorted(medians.items(), key=lambda row: -sum(row[1]))
    return [*ordered, ("whole step", [1e3 * _median(sum(step.values()) for step in level) for level in found])]


def _median(values: Iterable[float]) -> float:
    ordered = sorted(values)
    return ordered[len(ordered) // 2]


def profile(path: Path, source: str | None, steps: int, at: float) -> str:
    """The table of one checkpoint under a line that says what was measured."""
    from pd4dgs_codec.data.dataset import load
    from pd4dgs_codec.model import checkpoint
    from pd4dgs_codec.train.config import TrainConfig
    from pd4dgs_codec.train.loop import Trainer

    config = TrainConfig.from_json(checkpoint.load(path)[1]["config"], str(path))
    dataset = load(source or config.source, downscale=config.downscale, holdout=config.holdout)
    trainer = Trainer(config, dataset)
    trainer.resume(path)
    if trainer.total is None:
        raise SystemExit(f"{path}: was cut before its time limit fixed the length of its run; expected a longer run")
    found = measure(trainer.learner, steps, round(trainer.total * at))
    size = f"{dataset.train[0].width}x{dataset.train[0].height}"
    lines = [
        f"{dataset.name} {size}, {config.preset}, {len(trainer.model.anchor_q):,} anchors, one thread, at "
        f"{at:g} of the run, processor milliseconds:",
        "",
        "".join(["| part |", *(f" level {level} |" for level in range(len(found)))]),
        "|---" * (len(found) + 1) + "|",
    ]
    for part, times in rows(found):
        lines.append(f"| {part} | {' | '.join(f'{t:.1f}' for t in times)} |")
    return "\n".join(lines)


def main() -> None:
    """Entry point."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("checkpoints", nargs="+", type=Path, help="checkpoints of pd4dgs-train")
    p.add_argument("--source", help="the data, where a checkpoint's own path does not lead to it")
    p.add_argument("--steps", type=int, default=20, help="steps timed per level (default: 20)")
    p.add_argument("--at", type=float, default=0.55, help="share of the run at which to stand (default: 0.55)")
    p.add_argument("--write", type=Path, metavar="PAGE.md", help="put the tables into this page, between its marks")
    args = p.parse_args()

    from pd4dgs_codec.threads import configure

    configure(1)
    tables = [profile(path, args.source, args.steps, args.at) for path in args.checkpoints]
    text = "\n\n".join(tables)
    print(text)
    if args.write:
        page = args.write.read_text()
        before, after = page[: page.index(BEGIN)], page[page.index(END) :]
        args.write.write_text(f"{before}{BEGIN}\n\n{text}\n\n{after}")


if __name__ == "__main__":
    main()
