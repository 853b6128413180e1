"""The phases of a run: opening of time, pruning, selection of levels, step classes, whitening and prefixes."""

import itertools
import json
import signal
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from runs import assert_goes_on_as_one_run, assert_resumes_bit_for_bit, interrupt, records_of, run_saving, trainer_of
from tiny import TINY, disc
from trainer_rate import train_rate_bits

from pd4dgs_codec.errors import NotFinite
from pd4dgs_codec.format.decoder import decode
from pd4dgs_codec.format.encoder import encode, encode_with_report
from pd4dgs_codec.model import checkpoint
from pd4dgs_codec.model.model import to_scene
from pd4dgs_codec.model.networks import EXACT, level_mask
from pd4dgs_codec.model.picture import render, render_image
from pd4dgs_codec.model.sensitivity import whitening_transform
from pd4dgs_codec.scene import ATTRIBUTES, MASK_THRESHOLD, MAX_CLASS
from pd4dgs_codec.train import learner, losses
from pd4dgs_codec.train.config import TrainConfig
from pd4dgs_codec.train.loop import Trainer
from pd4dgs_codec.train.phases import levels, opening, prefixes, prune, quantisation
from pd4dgs_codec.train.phases.levels import held_back_views
from pd4dgs_codec.train.phases.prefixes import draw_prefix, rank_anchors
from pd4dgs_codec.train.phases.prune import Prune, added_error, least, round_of
from pd4dgs_codec.train.phases.quantisation import classes_within, fitted, measured, rounding_errors, whiten
from pd4dgs_codec.train.rollout import next_view
from pd4dgs_codec.train.schedule import PRUNING_ROUNDS, Schedule


@pytest.mark.usefixtures("short_runs_have_phases")
def test_a_run_with_all_phases_resumes_bit_for_bit(dataset, tmp_path, monkeypatch):
    """Cut on quarter pictures before anchors grow, between two rounds of pruning, and while prefixes are trained."""
    monkeypatch.setattr("pd4dgs_codec.train.state.LARGE", 24)
    monkeypatch.setattr(prefixes, "FEWEST", 20)
    monkeypatch.setattr("pd4dgs_codec.train.rollout.STILL_ODDS", 0.6)  # of few steps some render a prefix
    config = TrainConfig(preset="tiny", iterations=44, seed=6, prune=0.05, grading=0.5, small_pictures=0.6)
    trainer, schedule, whitenings = Trainer(config, dataset), Schedule(44), []
    monkeypatch.setattr(quantisation, "whiten", lambda *args: whitenings.append(trainer.iteration) or whiten(*args))
    cuts = (12, schedule.prune[2], 36)
    records = run_saving(trainer, tmp_path, cuts)
    pruned, drawn = ([r for r in records if name in r] for name in ("left_model", "prefix"))
    assert [r["iteration"] for r in pruned] == list(schedule.prune) and sum(r["left_model"] for r in pruned) > 0
    assert records[schedule.prune[0] - 1]["anchors"] - pruned[-1]["anchors"] == sum(r["left_model"] for r in pruned)
    assert drawn and min(r["iteration"] for r in drawn) >= schedule.rounding
    assert all(r["level"] == 0 and r["prefix"] >= 20 for r in drawn)
    assert whitenings == [schedule.rounding]
    assert sum("grown" in r for r in records) == sum("step_classes" in r for r in records) == 1
    assert_resumes_bit_for_bit(config, dataset, tmp_path, cuts)


@pytest.mark.usefixtures("short_runs_have_phases")
def test_phases_that_meet_infinity_are_skipped(dataset, tmp_path, monkeypatch):
    diverged = Mock(side_effect=NotFinite("colors: found inf"))
    monkeypatch.setattr(prefixes, "FEWEST", 20)
    for owner, name in ((prune, "omission_error"), (quantisation, "grade"), (prefixes, "utility")):
        monkeypatch.setattr(owner, name, diverged)
    records = records_of(trainer_of(dataset, prune=0.5, grading=0.5), tmp_path)
    assert len(records) == 30 and not any({"left_model", "step_classes", "prefix"} & set(r) for r in records)


def test_short_runs_and_few_views_have_no_measured_phases(dataset, tmp_path, request):
    views = replace(dataset, train=dataset.train * 12)
    trainer = trainer_of(views, 12, prune=0.5, grading=0.5)
    assert not held_back_views(trainer.learner)
    records = records_of(trainer, tmp_path)
    assert not any({"left_model", "step_classes", "left_out"} & set(record) for record in records)
    request.getfixturevalue("short_runs_have_phases")
    assert held_back_views(trainer.learner) == {8, 24, 40, 56}
    for off in ({"keep_layers": True}, {"max_layer": 0}, {"rollout": "top"}):
        assert not held_back_views(trainer_of(views, **off).learner)
    assert not held_back_views(trainer_of(replace(dataset, train=dataset.train * 8)).learner)


# -- opening of time ---------------------------------------------------------------------------------------------------


def opening_told(monkeypatch, errors: list[list[float]]) -> None:
    """Lets the branches that open time gradually and at once have these errors."""
    left = iter(errors)
    monkeypatch.setattr(opening, "_errors_beyond", lambda state: next(left))


@pytest.mark.usefixtures("short_runs_have_phases")
@pytest.mark.parametrize("errors, opened", [([0.1, 0.1, 0.2, 0.21], False), ([0.1, 0.1, 0.1, 0.12], True)])
def test_time_opens_from_the_key_instant_where_motion_predicts(dataset, monkeypatch, errors, opened):
    """The run goes on with the steps of the better branch."""
    learner, ends, seen = trainer_of(dataset, 100, 10).learner, [], []
    monkeypatch.setattr(learner, "_update", lambda few: seen.append(few) or type(learner)._update(learner, few))
    opening_told(monkeypatch, [errors[:2], errors[2:]])
    (phase,) = [phase for phase in learner.before_step if isinstance(phase, opening.OpenTime)]
    phase._practise = lambda *at: learner.practise(*at) or ends.append(weights_of(learner.model))
    assert phase.due(learner)
    phase.apply(learner, record := {})
    assert record["opening_errors"] == pytest.approx([0.1, sum(errors[2:]) / 2]) and learner.opened == opened
    assert seen == [3] * 5 + [None] * 5
    assert not moved(ends[learner.opened], learner.model) and moved(ends[not learner.opened], learner.model)
    counts, instants = [], []
    for learner.iteration in range(10, 100, 5):
        window = opening.within(learner, range(len(learner.views)))
        seen = {next_view(learner, 2) for _ in range(40)}
        assert seen <= set(window) or len(window) < levels.MIN_VIEWS
        counts.append(len(window))
        instants.append(opening.few_instants(learner))
    if learner.opened:
        assert min(counts) == len(learner.views)
        assert instants == [None] * 18
    else:
        assert counts == sorted(counts) and counts[0] < counts[4] < counts[-1] == len(learner.views)
        assert instants[0] == 3 and instants[4] is not None and instants[8:] == [None] * 10


def weights_of(model) -> dict:
    """A copy of the parameters, by name."""
    return {name: value.clone() for name, value in model.state_dict().items()}


def test_a_share_of_a_run_is_counted_in_its_own_steps(dataset):
    learner = trainer_of(dataset, 1500).learner
    learner.iteration = 150
    assert learner.steps_in(1 / 10) == 150
    learner.iteration, learner.share = 40, 0.1  # a timed run whose steps became slower than its N supposes
    assert learner.steps_in(1 / 10) == 40


def moved(before: dict, model) -> bool:
    """Whether a parameter differs."""
    return any(not torch.equal(value, before[name]) for name, value in model.state_dict().items())


def times_of(field) -> list[np.ndarray]:
    """The planes with a time axis."""
    return [plane for scale in field.arrays().planes for name, plane in scale.items() if name.endswith("t")]


@pytest.mark.usefixtures("short_runs_have_phases")
def test_steps_while_time_opens_leave_planes_linear_between_few_instants(dataset, monkeypatch):
    opening_told(monkeypatch, [[0.1], [0.2]])
    field = trainer_of(dataset, 100, 20).model.global_deformation
    times = times_of(field)
    assert any(np.ptp(plane) > 1e-3 for plane in times)
    field.planes.confine(3)
    for before, after in zip(times, times_of(field), strict=True):
        np.testing.assert_allclose(after, before, atol=1e-5)


@pytest.mark.usefixtures("short_runs_have_phases")
def test_a_signal_ends_a_trial_which_comes_again(dataset, tmp_path):
    config, updates = TrainConfig(preset="tiny", iterations=30), []
    trainer = Trainer(config, dataset)

    def in_the_second_update_of_the_trial():
        updates.extend([trainer.iteration] * trainer.learner.practising)
        return trainer.learner.practising and len(updates) == 2

    interrupt(trainer, signal.SIGTERM, in_the_second_update_of_the_trial)
    trainer.run(tmp_path / "part.pt")
    assert trainer.interrupted and updates == [trainer.learner.schedule.coarse_end] * 2
    assert trainer.iteration == trainer.learner.schedule.coarse_end
    assert_goes_on_as_one_run(config, dataset, tmp_path / "part.pt")


# -- pruning -----------------------------------------------------------------------------------------------------------


def test_the_least_errors_are_chosen_up_to_the_share():
    errors = torch.tensor([0.5, 0.01, torch.inf, 0.0, 0.02, 0.03], dtype=torch.float64)
    assert least(errors, 0.03).tolist() == [False, True, False, True, True, False]
    assert least(errors, 0.0).tolist() == [False, False, False, True, False, False]
    assert not least(torch.full((3,), torch.inf, dtype=torch.float64), 1.0).any()


UNPRUNED = TrainConfig(preset="tiny", iterations=120, prune=0.0, noise=False)


@pytest.fixture(scope="module")
def finished(once):
    """The checkpoint of a short run without pruning."""
    return once("unpruned", lambda folder: Trainer(UNPRUNED, disc(), size=TINY).run(folder / "m.pt")) / "m.pt"


@pytest.fixture
def trained(dataset, finished) -> Trainer:
    trainer = Trainer(UNPRUNED, dataset)
    trainer.resume(finished)
    return trainer


def pictures_of(trainer, level: int) -> list[np.ndarray]:
    """The training views."""
    return [render_image(trainer.model, level, v.time, v.camera) for v in trainer.dataset.train]


def difference(pictures, others) -> float:
    return float(np.mean([np.square(a - b).mean() for a, b in zip(pictures, others, strict=True)]))


def error_of(trainer, level: int) -> float:
    """Mean squared error over the training views."""
    return difference(pictures_of(trainer, level), [v.image / 255 for v in trainer.dataset.train])


def test_the_added_error_is_about_that_of_leaving_an_anchor_out(trained, monkeypatch):
    monkeypatch.setattr(prune, "LEARNT", np.inf)
    errors = added_error(trained.model, [1], trained.learner.views.spread(6), EXACT)[0].numpy()
    pictures = pictures_of(trained, 1)
    near = np.flatnonzero(np.isfinite(errors) & (errors > 0))
    chosen = near[np.argsort(errors[near])][:: max(1, len(near) // 40)]
    logits = trained.model.mask_logits.detach().clone()
    added = []
    for row in chosen:
        with torch.no_grad():
            trained.model.mask_logits[row] = -30.0
        added.append(difference(pictures_of(trained, 1), pictures))
        with torch.no_grad():
            trained.model.mask_logits.copy_(logits)
    expected = errors[chosen] * error_of(trained, 1)
    ranks = [np.argsort(np.argsort(x)) for x in (added, expected)]
    assert np.corrcoef(*ranks)[0, 1] > 0.9
    assert 1 / 4 < np.median(expected / added) < 4


def test_pruning_adds_about_its_share_of_error_and_keeps_the_masks_above(trained, monkeypatch):
    learner, model = trained.learner, trained.model
    learner.config = replace(learner.config, prune=0.02)
    before = [error_of(trained, level) for level in range(3)]
    for turn in range(PRUNING_ROUNDS):
        rounds, masks = round_of(model.anchor_q), [model.masks(level).detach() for level in range(3)]
        keep, record = Mock(wraps=learner.keep_anchors), {}
        monkeypatch.setattr(learner, "keep_anchors", keep)
        Prune(turn).apply(learner, record)
        monkeypatch.undo()
        (rows,) = keep.call_args.args
        assert 0 < len(model.anchor_q) == len(rows) == len(rounds) - record["left_model"]
        assert len(learner.statistics["opacity"]) == len(rows)
        assert torch.isin((rounds != turn).nonzero()[:, 0], rows).all()
        for level in (1, 2):
            torch.testing.assert_close(model.masks(level).detach(), masks[level][rows], atol=2e-6, rtol=0)
        left = (model.masks(0) < MASK_THRESHOLD) & (masks[0][rows] >= MASK_THRESHOLD)
        assert int(left.sum()) == record["left_level_0"]
        torch.testing.assert_close(model.masks(0).detach()[~left], masks[0][rows][~left])
    assert len(model.anchor_q) < 300  # of 600, most of them behind or beside others of the same grey
    for level in range(3):  # an estimate leaves out one anchor: many cost more together, and level 0 pays twice
        assert error_of(trained, level) < 1.5 * before[level]


@pytest.mark.parametrize("rollout", ["adaptive", "top"])
def test_a_scene_that_needs_no_anchor_keeps_some(dataset, monkeypatch, rollout):
    monkeypatch.setattr(prune, "added_error", lambda model, *_: torch.zeros(3, len(model.anchor_q)).double())
    learner, record = trainer_of(dataset, rollout=rollout).learner, {}
    for turn in range(PRUNING_ROUNDS):
        Prune(turn).apply(learner, record)
    assert 0 < learner.active_anchors()[0] <= len(learner.model.anchor_q) < 300
    assert record["left_level_0"] == 0 or rollout != "top", "a level that is not trained is not pruned"


# -- selection of levels -----------------------------------------------------------------------------------------------


@pytest.fixture
def many(dataset, short_runs_have_phases):
    """Enough views to hold some back."""
    return replace(dataset, train=dataset.train * 12)


def at_selection(many, share: float = 2 / 3) -> learner.Learner:
    """A learner at a step that selects levels, whose level 0 is fainter than level 2."""
    steps = trainer_of(many, 60).learner
    with torch.no_grad():
        for parameter in (p for field in steps.model.deformations.values() for p in field.weights):
            parameter.add_(0.1)
        steps.model.mask_logits[:, 0] -= 3.0
    steps.iteration = round(60 * share) + 1
    for _ in range(2):
        steps.step()
    return steps


def told(monkeypatch, errors: dict[int, list[float]], wrong: bool) -> None:
    """Lets the levels have these errors in the views held back, in turn, and level 0 be wrong or not."""
    turns = {level: itertools.cycle(values) for level, values in errors.items()}
    monkeypatch.setattr(levels, "error", lambda state, view, level: next(turns[level]))
    monkeypatch.setattr(levels, "_wrong", lambda *at: wrong)


def test_a_level_that_stays_leaves_the_model_as_it_was(many, monkeypatch):
    """The practice of the level below is undone."""
    told(monkeypatch, {0: [0.2, 0.21], 1: [0.2, 0.21], 2: [0.1, 0.12]}, wrong=False)
    steps = at_selection(many)
    before = [p.detach().clone() for p in steps.optimiser.parameters]
    moments = [m["exp_avg"].clone() for m in steps.optimiser.moments.values()]
    practised = Mock(wraps=steps.practise)
    steps.levels._practise = practised
    steps.levels.apply(steps, {})
    assert [call.args for call in practised.call_args_list] == [(0, 3), (1, 3)]  # no gain, no second half
    assert steps.model.level == 2 and steps.levels.left_out == []
    assert all(map(torch.equal, steps.optimiser.parameters, before))
    assert all(torch.equal(m["exp_avg"], b) for m, b in zip(steps.optimiser.moments.values(), moments, strict=True))


@pytest.mark.parametrize("share", [1 / 3, 2 / 3])
def test_levels_without_use_go_and_leave_their_anchors(many, monkeypatch, share):
    told(monkeypatch, {0: [0.1], 2: [0.1]}, wrong=False)
    steps = at_selection(many, share)
    masks = level_mask(steps.model.mask_logits.detach(), 2)
    steps.levels._practise = Mock()
    steps.levels.apply(steps, record := {})
    row = {"level": 2, "kept": 0, "error": 0.1, "instead": 0.1, "views": 4}
    assert record["left_out"] == [pytest.approx(row)] and steps.model.level == 0 and not held_back_views(steps)
    assert (steps.model.masks(0) - masks).abs().mean() < 0.05  # its own masks were 0.17 lower


@pytest.mark.parametrize("share, kept", [(1 / 3, 2), (2 / 3, 1)])
def test_where_level_0_is_wrong_it_is_not_tried(many, monkeypatch, share, kept):
    told(monkeypatch, {1: [0.1], 2: [0.1]}, wrong=True)
    steps = at_selection(many, share)
    steps.levels.apply(steps, {})
    assert steps.model.level == kept


@pytest.mark.parametrize("worse, kept", [([0.0, 0.02], 1), ([0.019, 0.021], 2)])
def test_a_level_must_be_better_beyond_the_noise(many, monkeypatch, worse, kept):
    told(monkeypatch, {1: [0.1 + more for more in worse], 2: [0.1]}, wrong=True)
    steps = at_selection(many)
    steps.levels.apply(steps, {})
    assert steps.model.level == kept


def test_what_level_0_shows_wrongly_is_found_however_small_it_is(many, monkeypatch):
    steps = trainer_of(many).learner
    view = steps.views[0]
    wrong = view.image.clone()
    wrong[8:13, 20:25] = 1 - wrong[8:13, 20:25]
    shown = {0: wrong, 1: wrong, 2: view.image}
    monkeypatch.setattr(levels, "images", lambda state, view, which: [shown[level] for level in which])
    assert [levels._wrong(steps, view, level) for level in (None, 2, 1)] == [True, True, False]
    found = levels.worst_block(view, *(levels.block_errors(view, shown[level]) for level in (0, 2)))
    assert np.hypot(*np.subtract(found.at, (22, 10))) < 4 and found.own > levels.LACKS > found.other == 0


@pytest.mark.parametrize("share, kept", [(0.9, 1), (1.1, 2)])
def test_a_level_pays_for_its_bits(many, monkeypatch, share, kept):
    """Half of the derivative of 0.01, a squared error of 0.1, by the absolute error is 0.1."""
    steps = at_selection(many)
    rate = 2 * 0.1 * steps.config.plane_rate * steps.plane_bits()[1]
    told(monkeypatch, {1: [0.01 + share * rate], 2: [0.01]}, wrong=True)
    steps.levels.apply(steps, {})
    assert steps.model.level == kept and rate > 0


@pytest.mark.usefixtures("short_runs_have_phases")
@pytest.mark.parametrize("share", [None, 0.7])
def test_a_trial_sees_no_view_that_judges_it(dataset, monkeypatch, share):
    """A timed run may begin its trial some positions after `Schedule.rounding`."""
    learner, drawn = trainer_of(replace(dataset, train=dataset.train * 12)).learner, []
    learner.iteration, learner.share = learner.schedule.rounding, share
    monkeypatch.setattr(learner, "_learn", lambda pairs, *_: drawn.extend(view for view, _ in pairs))
    learner.practise(0, 2 * len(learner.views))
    assert set(range(len(learner.views))) - set(drawn) == held_back_views(learner)


def test_steps_since_a_snapshot_are_undone_as_often_as_needed(dataset):
    learner, after = trainer_of(dataset, steps=2).learner, []
    before = learner.snapshot()
    for _ in range(3):
        learner.step()
        after.append([p.detach().clone() for p in learner.optimiser.parameters])
        learner.return_to(before)
        learner.iteration = 2
    for again in after[1:]:
        assert all(map(torch.equal, after[0], again))


@pytest.mark.parametrize("share, due", [(0.45, True), (0.7, False)])
def test_nothing_grows_behind_phases_that_number_the_anchors(dataset, share, due):
    """A timed run whose machine stops may go from before N/2 to behind 2N/3 in one step."""
    learner = trainer_of(dataset, 600).learner
    learner.share, learner._before = share, 240
    assert learner.grow.due(learner) == due


def test_a_removed_level_stays_away(many, tmp_path, monkeypatch):
    """From the model, its optimiser, the log, the file and a resumed run."""
    told(monkeypatch, {1: [0.1], 2: [0.1]}, wrong=True)
    config = TrainConfig(preset="tiny", iterations=30)
    trainer = Trainer(config, many)
    held_back, seen, original = held_back_views(trainer.learner), [], learner.next_view
    monkeypatch.setattr(learner, "next_view", lambda *at: seen.append(original(*at)) or seen[-1])
    records = run_saving(trainer, tmp_path, [25])
    start = Schedule(30).rounding
    assert len(held_back) == 4 and not set(seen[:start]) & held_back
    assert [r["iteration"] for r in records if r.get("left_out")] == [start]
    assert records[start]["left_out"][0]["level"] == 2 and max(r["level"] for r in records[start:]) == 1
    model, training = checkpoint.load(tmp_path / "whole.pt")
    assert model.local_deformation is None and model.global_deformation is not None
    assert json.loads(training["left_out"]) == trainer.learner.levels.left_out
    assert decode(encode(to_scene(model), effort=1)).layers == (0, 1)
    assert_resumes_bit_for_bit(config, many, tmp_path, [25])
    assert checkpoint.load(tmp_path / "from-25.pt")[1]["left_out"] == training["left_out"]


# -- step classes ------------------------------------------------------------------------------------------------------


def test_classes_stay_within_their_budget_and_use_it():
    errors = torch.from_numpy(np.random.default_rng(0).lognormal(0, 3, 4000))
    for share in (0.01, 1.0, 30.0):
        classes = classes_within(errors, share * float(errors.sum())).double()
        added = float((errors * (4**classes - 1)).sum() / errors.sum())
        assert 0.97 * share < added <= share
        assert (classes[errors.argsort()].diff() <= 0).all(), "the larger the error of a step, the finer it is"


def test_classes_at_the_edges():
    errors = torch.tensor([0.0, 1.0, torch.inf, 1e-12], dtype=torch.float64)
    assert classes_within(errors, 0.0).tolist() == [MAX_CLASS, 0, 0, 0]
    assert classes_within(errors, 1e30).tolist() == [MAX_CLASS, MAX_CLASS, 0, MAX_CLASS]
    assert classes_within(torch.full((3,), torch.inf, dtype=torch.float64), 1.0).tolist() == [0, 0, 0]


def test_the_error_of_a_step_is_about_that_of_rounding(dataset):
    """Against pictures of anchors whose attributes are moved at random by up to half a step."""
    learner = trainer_of(dataset).learner
    model, view, generator = learner.model, dataset.train[2], torch.Generator().manual_seed(0)
    with torch.no_grad():
        model.feature.add_(0.3 * torch.randn(model.feature.shape, generator=generator))
        model.offset.add_(2 * torch.randn(model.offset.shape, generator=generator))  # none in the same place
    level = measured(model, 1, [learner.views[2]] * 20, EXACT)
    errors = rounding_errors(model, level) / 20
    assert (errors >= 0).all() and not errors[~level.met].any()
    still, found = render_image(model, 1, view.time, view.camera), []
    values = {name: getattr(model, name).detach().clone() for name in ATTRIBUTES}
    for _ in range(20):
        with torch.no_grad():
            for name, value in values.items():
                noise = torch.rand(value.shape, generator=generator) - 0.5
                getattr(model, name).copy_(value + noise * getattr(model.steps, name))
        found.append(float(((render_image(model, 1, view.time, view.camera) - still) ** 2).mean()))
    assert np.mean(found) == pytest.approx(float(errors.sum()), rel=0.35)


@pytest.mark.usefixtures("short_runs_have_phases")
def test_a_run_grades_its_anchors_once_and_codes_them(dataset):
    trainer = trainer_of(dataset, grading=0.5)
    records = [trainer.learner.step() for _ in range(30)]
    (logged,) = [r["step_classes"] for r in records if "step_classes" in r]
    model = trainer.model
    assert sum(logged) == len(model.anchor_q)
    assert torch.bincount(model.step_class.long(), minlength=7).tolist() == logged
    assert len(set(model.step_class.tolist())) > 1
    model.round_to_steps()
    scene = to_scene(model)
    _, report = encode_with_report(scene, priors="gauss", layers=2, omit="nothing", effort=1)
    for own, row in zip(train_rate_bits(scene), report.layers, strict=True):
        coded = {s.name: s.rate_bits for s in row.streams}
        assert own["attributes"] == pytest.approx(coded.get("attributes", 0.0), rel=0.02)


def test_the_rate_of_a_class_depends_on_its_own_anchors_only(dataset):
    model = trainer_of(dataset).model
    with torch.no_grad():
        for name in ATTRIBUTES:
            getattr(model, name).normal_(generator=torch.Generator().manual_seed(1))
    rows, anchors = torch.arange(40), {name: getattr(model, name) for name in ATTRIBUTES}
    plain = losses.anchor_bits(model, anchors, rows, rows)
    model.step_class[20:40] = 3
    graded = losses.anchor_bits(model, anchors, rows.flip(0), rows).flip(0)
    first, second = rows[:20], rows[20:]
    torch.testing.assert_close(graded[:20], losses.anchor_bits(model, anchors, first, first))
    assert float((plain[20:] - graded[20:]).detach().mean()) == pytest.approx(3, abs=0.4)
    torch.testing.assert_close(graded[20:], losses.anchor_bits(model, anchors, second, second))


# -- whitening ---------------------------------------------------------------------------------------------------------


def matrix(seed: int, width: int) -> torch.Tensor:
    """float64 [width, width], symmetric, positive, with eigenvalues over three decades."""
    rng = np.random.default_rng(seed)
    axes, _ = np.linalg.qr(rng.normal(size=(width, width)))
    return torch.from_numpy(axes @ np.diag(np.logspace(-1.5, 1.5, width)) @ axes.T)


def test_whitened_channels_have_equal_errors_and_no_correlation():
    errors, covariance = matrix(0, 12), matrix(1, 12)
    transform = whitening_transform(errors, covariance)
    back = torch.linalg.inv(transform)
    after = back.T @ errors @ back
    assert float(after.trace()) == pytest.approx(float(errors.trace()))
    after = (after / after.trace() * 12).numpy()
    np.testing.assert_allclose(after - np.diag(np.diag(after)), 0, atol=0.5)  # not quite: all have a least error
    assert np.linalg.cond(after) < 0.2 * np.linalg.cond(errors)
    spread = (transform @ covariance @ transform.T).numpy()
    np.testing.assert_allclose(spread - np.diag(np.diag(spread)), 0, atol=1e-8 * spread.max())
    assert (np.diff(np.diag(spread)) <= 0).all()


def whitened(trainer: Trainer) -> None:
    """Whitens, and checks that step classes of whitened features need no further pictures."""
    model, views = trainer.model, trainer.learner.views.spread(2)
    levels = [measured(model, level, views, EXACT) for level in range(model.level + 1)]
    _, transform = fitted(model, levels, 0.0, True)
    expected = rounding_errors(model, levels[-1], torch.linalg.inv(transform))
    whiten(model, trainer.learner.optimiser, transform)
    again = rounding_errors(model, measured(model, model.level, views, EXACT))
    torch.testing.assert_close(again, expected, rtol=1e-2, atol=1e-3 * float(expected.max()))


def test_whitening_keeps_pictures_and_the_products_of_gradients_and_parameters(dataset):
    """Also through the heads that move features, once they move them."""
    trainer = trainer_of(dataset, 60, 30)
    model, view, moments = trainer.model, dataset.test[0], trainer.learner.optimiser.moments
    view = replace(view, time=0.1)  # not the key instant, where nothing moves
    with torch.no_grad():
        for layer, field in model.deformations.items():
            head = field.head_layer("feature")
            head.weight.normal_(0, 0.2, generator=torch.Generator().manual_seed(layer))
            head.bias.normal_(0, 0.2, generator=torch.Generator().manual_seed(2 + layer))
    before, kept = [render_image(model, i, view.time, view.camera) for i in range(3)], model.feature.detach().clone()
    moved = (model.feature, model.network("color").layers[0].weight)
    products = [(moments[p]["exp_avg"] * p.detach()).sum() for p in moved]
    whitened(trainer)
    assert float((model.feature - kept).detach().abs().max()) > 0.1
    for level, picture in enumerate(before):
        np.testing.assert_allclose(render_image(model, level, view.time, view.camera), picture, atol=2e-3)
    for parameter, product in zip(moved, products, strict=True):  # <G, X> does not depend on the basis
        after = (moments[parameter]["exp_avg"] * parameter.detach()).sum()
        torch.testing.assert_close(after, product, rtol=1e-3, atol=1e-9)
        assert (moments[parameter]["exp_avg_sq"] >= 0).all()


def test_whitening_makes_files_smaller(dataset):
    trainer = trainer_of(dataset, 120, 60)
    plain = len(encode(to_scene(trainer.model), effort=1, omit="nothing", layers=0))
    whitened(trainer)
    assert len(encode(to_scene(trainer.model), effort=1, omit="nothing", layers=0)) < plain


# -- prefixes ----------------------------------------------------------------------------------------------------------


def test_prefixes_are_nested_and_of_every_size(monkeypatch):
    monkeypatch.setattr(prefixes, "FEWEST", 4)
    rank = torch.tensor([0.5, -torch.inf, 3.0, 2.0, 0.0, 1.0] + [4.0 + i for i in range(58)], dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    drawn = [draw_prefix(rank, generator) for _ in range(200)]
    sizes = sorted({int(chosen.sum()) for chosen in drawn})
    assert sizes[0] == 4 and sizes[-1] > 55 and len(sizes) > 20
    for chosen in drawn:
        assert not chosen[1]
        assert rank[chosen].min() > rank[~chosen].max()


def test_anchors_of_a_first_slice_rank_alike_and_absent_ones_not_at_all(dataset, monkeypatch):
    monkeypatch.setattr(prefixes, "FEWEST", 20)
    monkeypatch.setattr("pd4dgs_codec.model.sensitivity.FEW", 5)
    model = trainer_of(dataset).model
    with torch.no_grad():
        model.mask_logits[::3, 0] = -20.0
    rank = rank_anchors(model, dataset.train[:2])
    assert torch.equal(rank.isfinite(), model.masks(0) > MASK_THRESHOLD)
    assert int(rank.isfinite().sum()) > 20 >= int((rank == rank.max()).sum()) > 1


@pytest.mark.parametrize("fused", (True, False))
def test_a_picture_of_some_anchors_is_that_of_a_model_without_the_others(dataset, monkeypatch, fused):
    model = trainer_of(dataset).model
    if not fused:
        monkeypatch.setattr(type(model), "_fusible", lambda self: False)
    assert model._fusible() == fused
    view = dataset.test[0]
    only = torch.arange(len(model.anchor_q)) % 2 == 0
    part = render(model, 0, view.time, view.camera, only=only)
    assert set(torch.unique(part.gaussians.anchors % 2).tolist()) == {0}
    with torch.no_grad():
        model.mask_logits[~only] = -20.0
    torch.testing.assert_close(part.image, render(model, 0, view.time, view.camera).image)
