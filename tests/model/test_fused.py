"""The fused functions of the CPU against the plain torch graph: the same Gaussians and the same gradients."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from test_model import ALL_HEADS, CAMERA, small_model, stir

from pd4dgs_codec.draw import simd
from pd4dgs_codec.draw.layers import Layers
from pd4dgs_codec.model.model import Gaussians, Model
from pd4dgs_codec.model.networks import EXACT, MLP, Noise, Rounding
from pd4dgs_codec.model.picture import render
from pd4dgs_codec.scene import Widths

PARTS = ("means", "quats", "scales", "opacities", "colors")


def roundings() -> dict[str, Rounding]:
    return {"exact": EXACT, "noise": Rounding(Noise(5)), "rounded": Rounding(attributes=True, weights=True)}


def drawn(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(sum(shape)))


def whole(*shape: int) -> torch.Tensor:
    """-1, 0 and 1."""
    return drawn(*shape).clamp(-1, 1).round()


def gradients(model: Model, gaussians: Gaussians) -> dict[str, torch.Tensor | None]:
    """Those of one random weighting of what is drawn."""
    model.zero_grad(set_to_none=True)
    sum((getattr(gaussians, name) * drawn(*getattr(gaussians, name).shape)).sum() for name in PARTS).backward()
    return {name: None if p.grad is None else p.grad.clone() for name, p in model.named_parameters()}


def check(model: Model, level: int, rounding: str = "exact") -> Gaussians:
    """Both forms agree to a few roundings of float32."""
    assert model._fusible()
    found = model.gaussians(level, 0.37, CAMERA, roundings()[rounding])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(model, "_fusible", lambda: False)
        expected = model.gaussians(level, 0.37, CAMERA, roundings()[rounding])
    for name in ("slots", "anchors"):
        assert torch.equal(getattr(found, name), getattr(expected, name))
    for name in (*PARTS, "raw_opacity"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name), rtol=1e-5, atol=1e-5)
    both = gradients(model, found), gradients(model, expected)
    assert [n for n, g in both[0].items() if g is None] == [n for n, g in both[1].items() if g is None]
    for name, gradient in both[1].items():
        if gradient is not None:
            scale = float(gradient.abs().max())
            torch.testing.assert_close(both[0][name], gradient, rtol=1e-4, atol=1e-5 * scale, msg=name)
    return found


@pytest.mark.parametrize("rounding", roundings())
@pytest.mark.parametrize("level", [0, 1, 2])
def test_it_is_the_plain_graph(level, rounding):
    model = stir(small_model(anchors=300, opacity=-0.1), 0.3)
    for field in model.deformations.values():
        field.key = 50_000
    gaussians = check(model, level, rounding)
    assert 0 < len(gaussians.slots) < 10 * len(gaussians.anchors)


@pytest.mark.parametrize("rounding", roundings())
def test_it_is_so_with_step_classes(rounding):
    model = small_model(anchors=300, opacity=-0.1)
    model.step_class.copy_(torch.arange(300) % 7)
    model.centre.copy_(torch.linspace(-0.5, 0.5, len(model.centre)))
    check(stir(model, 0.3), 2, rounding)


BLIND = Widths(viewing=("color",))


@pytest.mark.parametrize("widths", [Widths(16, 4), Widths(1, 1), Widths(5, 13), BLIND])
def test_it_is_so_at_other_widths(widths):
    gaussians = check(stir(small_model(widths=widths, anchors=300, opacity=0.0), 0.3), 2)
    assert 0 < len(gaussians.slots) < widths.slots * len(gaussians.anchors)


@pytest.mark.parametrize("level", [0, 1, 2])
def test_one_anchor_is_left_as_it_is(level):
    """Columns of a single row are contiguous, so that what is made of them in place would change the row."""
    model = stir(small_model(anchors=1, opacity=3.0), 0.3)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    assert len(check(model, level).slots)
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())


@pytest.mark.parametrize("parts", [2, 5])
def test_it_is_so_in_as_many_parts_as_there_are_threads(monkeypatch, parts):
    for module in ("draw.gaussians", "draw.layers", "model.hexplane"):
        monkeypatch.setattr(f"pd4dgs_codec.{module}.kernel_threads", lambda: parts)
    check(stir(small_model(opacity=-0.1), 0.3), 2)


@pytest.mark.parametrize("count", [0, 1, 47, 48, 400])
@pytest.mark.parametrize("parts", [1, 3])
def test_layers_and_their_gradients_are_those_of_torch(count, parts, monkeypatch):
    """The last layer reads some of its input, and the outputs of the others are used elsewhere, too. All bits agree,
    since float32 holds sums of small whole numbers in any order."""
    monkeypatch.setattr("pd4dgs_codec.draw.layers.kernel_threads", lambda: parts)
    shapes = ((40, 13), (24, 40), (21, 8))
    layers = [(whole(*shape).requires_grad_(), whole(shape[0]).requires_grad_()) for shape in shapes]
    x, base = (whole(count, width).requires_grad_() for width in (13, 21))
    hidden = [torch.relu(x @ layers[0][0].T + layers[0][1])]
    hidden.append(torch.relu(hidden[0] @ layers[1][0].T + layers[1][1]))
    out = base + hidden[1][:, :8] @ layers[2][0].T + layers[2][1]

    packed = Layers([(w.detach().numpy(), b.detach().numpy()) for w, b in layers])
    found = base.detach().numpy().copy()
    kept = packed.add(found, x.detach().numpy(), keep=True)
    np.testing.assert_array_equal(found, out.detach())
    ends = np.cumsum([0, *(-(-w // simd.WIDE) * simd.WIDE for w in (40, 24))])
    for values, first, end in zip(hidden, ends, ends[1:], strict=False):
        np.testing.assert_array_equal(kept[:, first : first + values.shape[1]], values.detach())
        assert (kept[:, first + values.shape[1] : end] == 0).all()

    g, elsewhere = whole(count, 21), [whole(*h.shape) for h in hidden]
    ((out * g).sum() + sum((h * e).sum() for h, e in zip(hidden, elsewhere, strict=True))).backward()
    g_hidden = np.zeros_like(kept)
    for values, first in zip(elsewhere, ends, strict=False):
        g_hidden[:, first : first + values.shape[1]] = values
    g_x, gradients = packed.backward(g.numpy(), x.detach().numpy(), kept, g_hidden)
    np.testing.assert_array_equal(g_x, x.grad)
    for pair, own in zip(layers, gradients, strict=True):
        for parameter, gradient in zip(pair, own, strict=True):
            np.testing.assert_array_equal(gradient, parameter.grad)
            assert gradient.size == 0 or np.abs(gradient).max() < 2**20  # no sum on the way left the whole numbers


@pytest.mark.parametrize(
    "heads", [(("position", "scaling"), ("position", "feature")), (ALL_HEADS[0], ()), ((), ALL_HEADS[1]), ((), ())]
)
def test_heads_and_fields_may_be_absent(heads):
    check(stir(small_model(heads), 0.3), 2)


@pytest.mark.parametrize(("opacity", "kept"), [(-3.0, 0), (3.0, 800)])
def test_no_gaussian_or_every_one_is_seen(opacity, kept):
    assert len(check(small_model(opacity=opacity), 2).slots) == kept


@pytest.mark.parametrize("rounding", roundings())
@pytest.mark.parametrize("channels", [8, 4])  # by the kernels, and in plain torch
def test_a_view_without_anchors_shows_the_background_and_gives_zero_gradients(rounding, channels):
    model = stir(small_model(channels=channels), 0.3)
    away = replace(CAMERA, viewmat=np.diag([-1, 1, -1, 1]).astype(np.float32) @ CAMERA.viewmat)
    for level in range(3):
        picture = render(model, level, 0.37, away, roundings()[rounding])
        assert len(picture.gaussians.anchors) == 0
        assert torch.equal(picture.image, torch.tensor(model.info.background).expand_as(picture.image))
        model.zero_grad(set_to_none=True)
        (picture.image * drawn(*picture.image.shape)).sum().backward()
        assert not any(p.grad.any() for p in model.parameters() if p.grad is not None)


def test_networks_of_other_depths_and_widths_take_the_plain_form():
    assert not small_model(channels=4)._fusible()
    for widths in ((35, 16, 16, 10), (35, 12, 10)):
        model = small_model()
        model.networks["opacity"] = MLP(widths)
        assert not model._fusible()
        assert len(model.gaussians(2, 0.5, CAMERA).slots)


def test_repeated_runs_give_the_same_bits():
    model = stir(small_model(), 0.3)
    first, second = (gradients(model, model.gaussians(2, 0.37, CAMERA)) for _ in range(2))
    assert all(torch.equal(first[name], second[name]) for name in first if first[name] is not None)
