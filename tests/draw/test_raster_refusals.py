"""What `rasterization` refuses, with one clear line."""

import pytest
import torch
from raster_scenes import NAMES, camera, scene

from pd4dgs_codec.errors import NotFinite, RenderError
from pd4dgs_codec.model.autograd.rasterization import rasterization

OPTIONS = [
    ({"rasterize_mode": "antialiased"}, "rasterize_mode"),
    ({"sh_degree": 3}, "sh_degree"),
    ({"absgrad": True}, "absgrad"),
    ({"covars": torch.eye(3).expand(5, 3, 3)}, "covars"),
    ({"render_mode": "rgb"}, "render_mode"),
    ({"backend": "opengl"}, "backend"),
    ({"near_plane": -1.0}, "near_plane"),
    ({"near_plane": 2.0, "far_plane": 1.0}, "far_plane"),
    ({"near_plane": float("nan")}, "near_plane"),
    ({"eps2d": -0.1}, "eps2d"),
    ({"eps2d": float("inf")}, "eps2d"),
    ({"radius_clip": float("nan")}, "radius_clip"),
    ({"backgrounds": torch.zeros(3)}, "backgrounds"),
    ({"backgrounds": torch.zeros(1, 4)}, "backgrounds"),
    ({"backend": "gsplat"}, "gsplat"),
]


@pytest.mark.parametrize("options, word", OPTIONS, ids=[str(sorted(o)) + w for o, w in OPTIONS])
def test_options(options, word):
    with pytest.raises(RenderError, match=word) as caught:
        rasterization(*scene(5), *camera(8, 8), 8, 8, **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("width, height", [(0, 8), (8, -1), (8.0, 8), (True, 8), (70000, 8)])
def test_sizes(width, height):
    with pytest.raises(RenderError, match="expected an integer from 1 to 65535"):
        rasterization(*scene(5), *camera(8, 8), width, height)


@pytest.mark.parametrize("name", NAMES)
def test_shapes_and_types(name):
    for change in (lambda t: t[:-1], lambda t: t[..., None], lambda t: t.int(), lambda t: t.tolist()):
        tensors = [t.detach() for t in scene(5)]
        tensors[NAMES.index(name)] = change(tensors[NAMES.index(name)])
        with pytest.raises(RenderError, match="expected"):
            rasterization(*tensors, *camera(8, 8), 8, 8)


def test_no_channels():
    with pytest.raises(RenderError, match="0 channels"):
        rasterization(*scene(5, channels=0), *camera(8, 8), 8, 8)


def test_colours_that_are_not_finite_have_an_error_of_their_own():
    tensors = [t.detach() for t in scene(5)]
    tensors[4][2, 1] = float("nan")
    with pytest.raises(NotFinite, match="colors"):
        rasterization(*tensors, *camera(8, 8), 8, 8)


CAMERAS = [
    ("viewmats", (0, slice(0, 3), slice(0, 3)), 0.0, "flattens the scene"),
    ("viewmats", (0, 3, 0), 0.5, "last row"),
    ("viewmats", (0, 0, 0), float("nan"), "not finite"),
    ("Ks", (0, 0, 1), 0.1, "skew"),
    ("Ks", (0, 2, 2), 2.0, "expected"),
    ("Ks", (0, 0, 0), 0.0, "positive"),
    ("Ks", (0, 1, 1), -5.0, "positive"),
    ("Ks", (0, 0, 2), float("inf"), "not finite"),
]


@pytest.mark.parametrize("name, place, value, word", CAMERAS)
def test_cameras(name, place, value, word):
    cameras = dict(zip(("viewmats", "Ks"), camera(8, 8), strict=True))
    cameras[name][place] = value
    with pytest.raises(RenderError, match=word):
        rasterization(*scene(5), cameras["viewmats"], cameras["Ks"], 8, 8)


def test_camera_shapes_and_gradients():
    viewmats, Ks = camera(8, 8)
    for bad in ((viewmats[0], Ks), (viewmats, Ks[0]), (viewmats, Ks.expand(2, 3, 3))):
        with pytest.raises(RenderError, match="shape"):
            rasterization(*scene(5), *bad, 8, 8)
    with pytest.raises(RenderError, match="gradients"):
        rasterization(*scene(5), viewmats.requires_grad_(), Ks, 8, 8)


def test_second_derivatives_are_refused():
    tensors = scene(5)
    out, _, _ = rasterization(*tensors, *camera(8, 8), 8, 8)
    (first,) = torch.autograd.grad(out.square().sum(), tensors[4], create_graph=True)
    with pytest.raises(RuntimeError, match="differentiat"):
        first.sum().backward()
