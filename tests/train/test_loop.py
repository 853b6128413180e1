"""The loop on a scene of a few tiny pictures: it learns, resumes bit for bit, survives bad steps, ends on time."""

import dataclasses
import io
import json
import math
import signal
from pathlib import Path

import numpy as np
import pytest

from pd4dgs_codec import decode, encode

torch = pytest.importorskip("torch")
pytest.importorskip("numba")

from pd4dgs_codec.data.view import Dataset, View  # noqa: E402
from pd4dgs_codec.errors import DataError, NotFinite, RenderError, TrainError  # noqa: E402
from pd4dgs_codec.model import checkpoint  # noqa: E402
from pd4dgs_codec.model.config import PRESETS, DeformationConfig, ModelConfig  # noqa: E402
from pd4dgs_codec.model.convert import to_scene  # noqa: E402
from pd4dgs_codec.train import loop  # noqa: E402
from pd4dgs_codec.train.config import ABLATIONS, Schedule, TrainConfig  # noqa: E402
from pd4dgs_codec.train.loop import Trainer  # noqa: E402

W, H = 32, 24


def view(t: float) -> View:
    """A bright disc that moves to the right over a grey ground; the camera sways a little."""
    y, x = np.mgrid[0:H, 0:W] + 0.5
    disc = (x - 8 - 16 * t) ** 2 + (y - 12) ** 2 < 16
    image = np.full((H, W, 3), 90, np.uint8)
    image[disc] = (230, 60, 40)
    viewmat = np.eye(4, dtype=np.float32)
    viewmat[0, 3], viewmat[2, 3] = 0.1 * math.sin(6 * t), 3.0
    K = np.array([[30, 0, W / 2], [0, 30, H / 2], [0, 0, 1]], np.float32)
    return View(viewmat=viewmat, K=K, width=W, height=H, time=t, image=image, mask=None, name=f"{t}", camera_id=0)


@pytest.fixture
def dataset() -> Dataset:
    views = tuple(view(t) for t in np.linspace(0, 1, 6))
    return Dataset(
        name="disc", train=views, test=(view(0.5),), points=None, point_colors=None,
        box=np.array([[-1.5, -1.2, -1], [1.5, 1.2, 1]], np.float32), near=0.1, far=10.0, background=(0.0, 0.0, 0.0),
        time_range=(0.0, 1.0), up=(0.0, -1.0, 0.0), unit=0.0, masked=False,
    )  # fmt: skip


@pytest.fixture(autouse=True)
def few_anchors(monkeypatch):
    """The tiny preset with few anchors and cells, so that a step costs milliseconds."""
    field = DeformationConfig(4, 4, 4, (1,), 8, ("position", "feature", "offset", "scaling"))
    local = dataclasses.replace(field, heads=("mean", "scale", "quat", "opacity", "color"))
    monkeypatch.setitem(PRESETS, "tiny", ModelConfig(field, local, hidden=8, initial_anchors=300, max_anchors=600))


def weights(path) -> dict:
    return checkpoint.load(path)[0].state_dict()


def test_it_learns_and_logs_every_term(dataset, tmp_path):
    trainer = Trainer(TrainConfig(preset="tiny", iterations=90), dataset)
    trainer.run(tmp_path / "m.pt", log=tmp_path / "log.jsonl")
    records = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [r["iteration"] for r in records] == list(range(90))
    assert np.mean([r["l1"] for r in records[-10:]]) < 0.6 * np.mean([r["l1"] for r in records[:5]])
    assert {"l1", "dssim", "volume", "rate", "tmc_binary", "tmc_smooth", "rho", "pi", "anchors"} <= set(records[-1])
    assert all(r["level"] == 0 for r in records[: Schedule(90).coarse_end])
    assert {r["level"] for r in records} == {0, 1, 2}
    assert "rate" not in records[Schedule(90).progressive - 1] and "rate" in records[Schedule(90).progressive]
    assert records[-1]["rho"] > 0
    assert any("held_out_psnr" in r for r in records)


def assert_resumes_bit_for_bit(config, dataset, folder, cuts):
    """Runs cut before each of the steps `cuts` and resumed end as the one in folder/whole.pt."""
    for cut in cuts:
        part = Trainer(config, dataset)
        for _ in range(cut):
            part.step()
        part.save(folder / "part.pt")
        resumed = Trainer(config, dataset)
        resumed.resume(folder / "part.pt")
        resumed.run(folder / "resumed.pt")
        whole, again = weights(folder / "whole.pt"), weights(folder / "resumed.pt")
        assert whole.keys() == again.keys()
        assert all(torch.equal(whole[k], again[k]) for k in whole), cut


def test_resuming_repeats_the_run_bit_for_bit(dataset, tmp_path):
    config = TrainConfig(preset="tiny", iterations=60)
    Trainer(config, dataset).run(tmp_path / "whole.pt")
    # inside growing, and inside the progressive phase
    assert_resumes_bit_for_bit(config, dataset, tmp_path, (25, 41))


@pytest.mark.parametrize("max_layer", [0, 1])
def test_a_model_without_upper_layers_is_packed_as_it_was_trained(dataset, tmp_path, max_layer):
    config = TrainConfig(preset="tiny", iterations=40, max_layer=max_layer)
    Trainer(config, dataset).run(tmp_path / "m.pt")
    model = checkpoint.load(tmp_path / "m.pt")[0]
    assert model.level == max_layer
    own = [float((model.masks(level) - model.masks(level - 1)).detach().max()) > 1e-6 for level in (1, 2)]
    assert own == [max_layer >= 1, False], "absent levels have masks of their own"
    scene = decode(encode(to_scene(model)))
    assert scene.level <= max_layer


def test_the_top_rollout_trains_the_highest_level_alone(dataset, tmp_path):
    config = TrainConfig(preset="tiny", iterations=40, rollout="top")
    Trainer(config, dataset).run(tmp_path / "m.pt", log=tmp_path / "log.jsonl")
    records = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert {r["level"] for r in records if r["iteration"] < 4} == {0}
    assert {r["level"] for r in records if r["iteration"] >= 4} == {2}


def test_every_level_is_trained_in_every_step_on_a_view_of_its_own_if_asked(dataset):
    trainer = Trainer(TrainConfig(preset="tiny", iterations=40, rollout="all"), dataset)
    for _ in range(5):
        record = trainer.step()
    assert record["level"] == 2 and record["pi"] == (1.0, 1.0, 1.0)
    seen = []
    trainer._loss, loss = (lambda *a: seen.append(a[:2]) or loss(*a)), trainer._loss
    trainer.step()
    views, levels = zip(*seen, strict=True)
    assert levels == (0, 1, 2) and len(set(views)) == 3


def test_without_quantisation_nothing_is_rounded(dataset, tmp_path):
    config = TrainConfig(preset="tiny", iterations=40, **ABLATIONS["noise"])
    Trainer(config, dataset).run(tmp_path / "m.pt")
    model = checkpoint.load(tmp_path / "m.pt")[0]
    rest = (model.feature / model.steps.feature).frac().abs()
    assert float(((rest > 0.05) & (rest < 0.95)).float().mean()) > 0.5


@pytest.mark.parametrize(
    "part, gone",
    [("rate", {"rate"}), ("binary", {"tmc_binary"}), ("smooth", {"tmc_smooth"}), ("tmc", {"tmc_binary", "tmc_smooth"})],
)
def test_an_ablation_takes_out_its_terms_alone(dataset, part, gone):
    terms = {"rate", "tmc_binary", "tmc_smooth"}
    trainer = Trainer(TrainConfig(preset="tiny", iterations=3, **ABLATIONS[part]), dataset)
    records = [trainer.step() for _ in range(3)]
    assert terms & set(records[-1]) == terms - gone


def test_seeds_differ_and_repeat(dataset, tmp_path):
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        Trainer(TrainConfig(preset="tiny", iterations=12, seed=seed), dataset).run(tmp_path / f"{name}.pt")
    a, b, c = (weights(tmp_path / f"{name}.pt") for name in "abc")
    assert all(torch.equal(a[k], b[k]) for k in a)
    assert not torch.equal(a["feature"][:10], c["feature"][:10])


def test_a_non_finite_step_is_skipped_and_counted(dataset):
    trainer = Trainer(TrainConfig(preset="tiny", iterations=30), dataset)
    trainer.step()
    with torch.no_grad():
        trainer.model.networks["color"].linears[1].bias[:] = math.nan
    before = trainer.model.feature.detach().clone()
    record = trainer.step()
    assert record["skipped"] == 1 == trainer.skipped
    assert torch.equal(before, trainer.model.feature.detach())


def test_a_time_limit_fixes_n_once_and_ends_in_time(dataset, tmp_path):
    Trainer(TrainConfig(preset="tiny", iterations=12), dataset).run(tmp_path / "warm.pt")  # compiles the kernels
    trainer = Trainer(TrainConfig(preset="tiny", max_seconds=10.0), dataset)
    trainer.run(tmp_path / "m.pt", log=tmp_path / "log.jsonl")
    assert trainer.total >= loop.LEAST_TIMED_TOTAL and trainer.seconds < 12.0
    totals = {r["iteration"]: r["total"] for r in map(json.loads, open(tmp_path / "log.jsonl")) if "total" in r}
    assert totals == {loop.TIMED_STEPS - 1: trainer.total}
    stored = checkpoint.load(tmp_path / "m.pt")[1]
    assert stored["total"] == trainer.total
    assert json.loads(stored["config"])["iterations"] == trainer.total


def test_a_limit_too_short_for_any_phase_still_leaves_a_checkpoint(dataset, tmp_path):
    trainer = Trainer(TrainConfig(preset="tiny", max_seconds=0.05), dataset)
    trainer.run(tmp_path / "m.pt")
    assert checkpoint.load(tmp_path / "m.pt")[1]["iteration"] == trainer.iteration >= 1
    assert Schedule(trainer.total or 1000).phases_not_reached(trainer.iteration)


def test_a_finished_checkpoint_holds_rounded_weights(dataset, tmp_path):
    trainer = Trainer(TrainConfig(preset="tiny", iterations=20), dataset)
    trainer.run(tmp_path / "m.pt")
    model, _ = checkpoint.load(tmp_path / "m.pt")
    ratio = model.networks["color"].linears[0].weight.detach() / model.steps.weights_scaffold
    assert torch.allclose(ratio, ratio.round(), atol=1e-3)


def test_resuming_from_a_model_without_training_state_is_refused(dataset, tmp_path):
    trainer = Trainer(TrainConfig(preset="tiny", iterations=5), dataset)
    checkpoint.save(tmp_path / "m.pt", trainer.model)
    with pytest.raises(TrainError, match="no training state"):
        trainer.resume(tmp_path / "m.pt")


def test_a_limit_nearly_spent_gives_a_cut_run_that_says_so(dataset):
    trainer = Trainer(TrainConfig(preset="tiny", max_seconds=1e-3), dataset)
    trainer._fix_iterations(start=0.0)
    assert trainer.total == loop.LEAST_TIMED_TOTAL
    assert "levels 1 and 2" in Schedule(trainer.total).phases_not_reached(loop.TIMED_STEPS)


def test_a_time_limit_allows_for_what_a_step_of_the_rollout_costs(dataset, monkeypatch):
    totals = {}
    monkeypatch.setattr(Trainer, "_level_costs", lambda self: [1e-3, 2e-3, 3e-3])
    for rollout in ("uniform", "top", "all"):
        trainer = Trainer(TrainConfig(preset="tiny", max_seconds=1e3, rollout=rollout), dataset)
        trainer._fix_iterations(start=loop.time.monotonic())
        totals[rollout] = trainer.total
    tenth, rest = 0.1, 0.9  # the coarse phase is of level 0 alone
    assert totals["uniform"] / totals["top"] == pytest.approx((tenth * 1 + rest * 3) / (tenth * 1 + rest * 2), rel=1e-2)
    assert totals["uniform"] / totals["all"] == pytest.approx((tenth * 1 + rest * 6) / (tenth * 1 + rest * 2), rel=1e-2)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_first_signal_ends_the_run_after_a_whole_step(dataset, tmp_path, monkeypatch, number):
    trainer = Trainer(TrainConfig(preset="tiny", iterations=8), dataset)
    update, before = trainer._update, signal.getsignal(number)

    def interrupted(*args):
        if trainer.iteration == 2:
            signal.raise_signal(number)  # in the middle of a step
        update(*args)

    monkeypatch.setattr(trainer, "_update", interrupted)
    trainer.run(tmp_path / "m.pt")
    assert trainer.interrupted and trainer.iteration == 3 == checkpoint.load(tmp_path / "m.pt")[1]["iteration"]
    assert signal.getsignal(number) is before
    resumed, whole = (Trainer(TrainConfig(preset="tiny", iterations=8), dataset) for _ in range(2))
    resumed.resume(tmp_path / "m.pt")
    resumed.run(tmp_path / "resumed.pt")
    whole.run(tmp_path / "whole.pt")
    again, expected = weights(tmp_path / "resumed.pt"), weights(tmp_path / "whole.pt")
    assert not resumed.interrupted and all(torch.equal(again[k], expected[k]) for k in expected)


def test_a_second_signal_ends_it_at_once_and_saves_nothing(dataset, tmp_path, monkeypatch):
    trainer = Trainer(TrainConfig(preset="tiny", iterations=8), dataset)
    before = signal.getsignal(signal.SIGINT)
    monkeypatch.setattr(trainer, "_update", lambda *_: [signal.raise_signal(signal.SIGINT) for _ in range(2)])
    with pytest.raises(KeyboardInterrupt):
        trainer.run(tmp_path / "m.pt")
    assert not (tmp_path / "m.pt").exists() and signal.getsignal(signal.SIGINT) is before


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_log_that_cannot_be_written_ends_the_run_with_a_checkpoint(dataset, tmp_path):
    trainer = Trainer(TrainConfig(preset="tiny", iterations=8), dataset)
    with pytest.raises(DataError, match="/dev/full: .*No space left"):
        trainer.run(tmp_path / "m.pt", log=Path("/dev/full"))
    assert checkpoint.load(tmp_path / "m.pt")[1]["iteration"] == 1
    with pytest.raises(DataError, match="none"):
        trainer.run(tmp_path / "n.pt", log=tmp_path / "none" / "log.jsonl")


def test_the_log_is_json_even_of_a_step_that_is_not_finite():
    stream = io.StringIO()
    assert loop._append(stream, {"loss": math.nan, "pi": (0.5, math.inf)}) is None
    assert json.loads(stream.getvalue(), parse_constant=pytest.fail) == {"loss": None, "pi": [0.5, None]}


def test_only_what_is_not_finite_is_skipped(dataset, monkeypatch):
    trainer = Trainer(TrainConfig(preset="tiny", iterations=8), dataset)

    def refuse(error):
        monkeypatch.setattr(trainer, "_loss", lambda *_: (_ for _ in ()).throw(error))

    refuse(NotFinite("colors"))
    assert trainer.step()["refused"] == "colors"
    refuse(RenderError("no gsplat"))
    with pytest.raises(RenderError, match="no gsplat"):
        trainer.step()


BROKEN_STATES = {
    "order": [0, 6],
    "generator": torch.zeros(3),
    "optimiser": {"state": {}},
    "densifier": None,
    "iteration": "many",
    "curve": "{",
}


@pytest.mark.parametrize("name", BROKEN_STATES)
def test_broken_training_state_is_refused_in_one_line(dataset, tmp_path, name):
    trainer = Trainer(TrainConfig(preset="tiny", iterations=5), dataset)
    trainer.save(tmp_path / "m.pt")
    model, training = checkpoint.load(tmp_path / "m.pt")
    for broken in (training | {name: BROKEN_STATES[name]}, {k: v for k, v in training.items() if k != name}):
        checkpoint.save(tmp_path / "m.pt", model, broken)
        with pytest.raises((DataError, TrainError)) as caught:
            trainer.resume(tmp_path / "m.pt")
        assert str(tmp_path / "m.pt") in str(caught.value) and "\n" not in str(caught.value)


def test_points_that_all_lie_far_outside_are_as_good_as_none(dataset):
    far = dataclasses.replace(dataset, points=np.full((20, 3), 1e4, np.float32))
    assert len(Trainer(TrainConfig(preset="tiny", iterations=5), far).model.anchor_q) > 100
