"""The ray caster against ray marching, and the documented properties of the scenes."""

import hashlib
from itertools import combinations, product

import numpy as np
import pytest
from moving_bodies import movers

from pd4dgs_codec.data import synthetic as syn
from pd4dgs_codec.data.bodies import MOTIONS, NO_BODY, THINGS, Eye, bodies, enter, place, shade
from pd4dgs_codec.data.dancer import Dancer
from pd4dgs_codec.data.dataset import load
from pd4dgs_codec.data.random_bodies import PATHS, RANDOM, random_scene
from pd4dgs_codec.data.view import LaterView, pixels_later

LENS, SWEEPS = syn.ROOM.lens, syn.PATHS["sweeps"]

INSIDE = {
    "sphere": lambda m: (m**2).sum(axis=0) <= 1,
    "box": lambda m: np.abs(m).max(axis=0) <= 1,
    "cylinder": lambda m: (m[0] ** 2 + m[1] ** 2 <= 1) & (np.abs(m[2]) <= 1),
}


@pytest.fixture(scope="module")
def local():
    """All frames, in few pixels."""
    return load("synthetic:local?size=40x30")


@pytest.fixture(scope="module")
def large():
    """Few frames, in all pixels."""
    return load("synthetic:local?frames=3")


@pytest.mark.parametrize("shape", INSIDE)
def test_entry_agrees_with_marching(shape):
    rng = np.random.default_rng(0)
    o = np.array([2.1, -1.7, 1.9])
    d = -o[:, None] / 3 + rng.normal(size=(3, 300)) * 0.5
    found = enter(shape, o, list(d))
    s = np.linspace(0, 12, 6001)
    inside = np.stack([INSIDE[shape](o[:, None] + d[:, i : i + 1] * s) for i in range(300)])
    marched = np.where(inside.any(axis=1), s[inside.argmax(axis=1)], np.inf)
    both = np.isfinite(found) & np.isfinite(marched)
    assert both.sum() > 60 and (np.isfinite(found) & ~np.isfinite(marched)).sum() <= 6  # grazing rays slip the march
    assert not (np.isfinite(marched) & ~np.isfinite(found)).any()
    assert (np.abs(found[both] - marched[both]) <= 0.0021).all()


def marched_hidden(placed, origin, target, own):
    """Does any body but `own` hold a point of the open segment?"""
    p = origin[:, None] + (target - origin)[:, None] * np.linspace(0, 1, 3000, endpoint=False)
    return any(INSIDE[b.body.shape](b.inverse @ (p - b.c[:, None])).any() for i, b in enumerate(placed) if i != own)


def test_visibility_agrees_with_marching():
    """Points moved with their bodies; whether the camera sees them, against samples of the segment to the camera."""
    scene = bodies("fast", 0)
    body, point = syn._surface(scene, syn.ROOM.fixed[1], 0.6, LENS)
    rng = np.random.default_rng(1)
    chosen = rng.choice(np.flatnonzero(body > 1), 60, replace=False)  # not floor and wall: mostly visible
    body, point = body[chosen], point[:, chosen]
    verdicts = []
    for t in (0.0, 0.37, 0.9):
        placed = place(scene, t)
        eye = Eye(placed, syn.room_viewmat(SWEEPS * t, t))
        for k, seen in enumerate(syn._seen(eye, body, point, LENS)):
            at = placed[body[k]]
            world = at.A @ point[:, k] + at.c
            x, y, z = eye.viewmat[:3, :3] @ (world - eye.center)
            u, v = LENS.fx * x / z + LENS.cx, LENS.fy * y / z + LENS.cy
            # A back is hidden by its own body: look a little before the surface.
            near = world + 1e-3 * (eye.center - world)
            back = INSIDE[at.body.shape]((at.inverse @ (near - at.c))[:, None])[0]
            free = not back and not marched_hidden(placed, eye.center, world, body[k])
            verdicts.append((seen, free and 0 <= u <= LENS.width and 0 <= v <= LENS.height))
    seen, expected = np.array(verdicts).T
    assert (seen != expected).mean() <= 0.02  # grazing cases of the sampled segment
    assert 0.1 < seen.mean() < 0.95


def test_first_hit_is_the_nearest_of_all_bodies():
    placed = place(bodies("static", 3), 0.0)
    eye = Eye(placed, syn.ROOM.fixed[0])
    xs, ys = syn.grid(LENS)
    depth, index = eye.first_hits(xs, ys)
    full = np.stack([eye.enter(b, xs[None, :], ys[:, None]) for b in placed])
    np.testing.assert_array_equal(depth, full.min(axis=0))
    np.testing.assert_array_equal(index, np.where(np.isinf(depth), NO_BODY, full.argmin(axis=0)))
    assert len(np.unique(index)) >= 10  # most bodies and the sky are in the picture


def test_shapes_and_split(local, large):
    assert len(local.train) == 60 and len(local.test) == 30 and local.masked
    v = large.train[0]
    assert v.image.shape == (120, 160, 3) and v.image.dtype == np.uint8 and v.mask is None
    assert all(0.8 < w.mask.mean() < 1 for w in local.test)
    assert {w.camera_id for w in local.test} == {1, 2} and {w.camera_id for w in local.train} == {0}
    assert {w.time for w in local.test} <= {w.time for w in local.train}
    assert local.train[0].time == 0 and local.train[-1].time == 1
    assert local.points.shape == (5000, 3) and local.points.dtype == np.float32
    assert ((local.points >= local.box[0] - 0.1) & (local.points <= local.box[1] + 0.1)).all()


def centers(views):
    """float32 [n, 3]: the cameras' places."""
    return np.stack([-v.viewmat[:3, :3].T @ v.viewmat[:3, 3] for v in views])


def azimuths(places):
    """Degrees in the room."""
    return np.degrees(np.arctan2(places[:, 0] - syn.ROOM_TARGET[0], syn.ROOM_TARGET[1] - places[:, 1]))


def test_camera_goes_back_and_forth_on_an_arc(local):
    places = centers(local.train)
    azimuth = azimuths(places)
    assert 60 <= np.ptp(azimuth) <= 90
    turns = np.flatnonzero(np.diff(np.sign(np.diff(azimuth))))
    assert len(turns) == 2 * SWEEPS - 1  # each place is passed at several instants, far apart
    crossings = np.flatnonzero(np.diff(np.sign(azimuth)))
    assert len(crossings) == 2 * SWEEPS and np.diff(crossings).min() >= 8
    for v in (local.test[0], local.test[-1]):
        assert np.linalg.norm(places - centers([v]), axis=1).min() > 0.2


def test_points_lie_on_visible_surfaces(large):
    """Points project onto pixels of the colour of the surface there, in the first frame, where nothing hides them."""
    v = large.train[0]
    placed = place(bodies("local", 0), 0.0)
    eye = Eye(placed, v.viewmat.astype(np.float64))
    c = v.viewmat[:3, :3] @ large.points.T + v.viewmat[:3, 3:]
    u, w = c[0] / c[2] * LENS.fx + LENS.cx, c[1] / c[2] * LENS.fy + LENS.cy
    ok = (c[2] > 0) & (u > 1) & (w > 1) & (u < 159) & (w < 119)
    depth, index = eye.first_hits(*syn.grid(LENS))
    ok[ok] = np.abs(depth[w[ok].astype(int), u[ok].astype(int)] - c[2][ok]) < 0.08
    assert ok.sum() > 1500
    line, column = w[ok].astype(int), u[ok].astype(int)
    points, body, errors = large.points[ok].astype(float), index[line, column], []
    for i in np.unique(body):
        mine = body == i
        seen = v.image[line[mine], column[mine]].astype(float)
        errors.append(np.abs(seen - 255 * shade(placed, i, points[mine].T, 0.0).T))
    assert np.median(np.concatenate(errors)) < 12


def digest(source) -> str:
    """Of a synthetic scene that is drawn anew."""
    d = syn._dataset.__wrapped__(syn.parse(f"synthetic:{source}"))
    h = hashlib.sha256(d.points.tobytes())
    for v in (*d.train, *d.test):
        h.update(v.image.tobytes() + v.viewmat.tobytes() + (b"" if v.mask is None else v.mask.tobytes()))
    return h.hexdigest()


def test_content_depends_on_the_string_alone(local):
    assert load("synthetic:local?size=40x30&seed=0") is local
    small = "frames=6&size=40x30"
    first = digest(f"local?{small}")
    np.random.seed(5)  # noqa: NPY002 - a global seed must not matter
    assert digest(f"local?seed=0&{small}") == first != digest(f"local?{small}&seed=1")


def test_more_seconds_go_on_with_the_motion_and_pixels_come_when_they_are_asked_for():
    usual, longer = (
        load(f"synthetic:local?size=40x30&frames={n}{more}") for n, more in ((60, ""), (119, "&seconds=10"))
    )
    assert longer.time_range == (0, 10) and len(load("synthetic:local?size=40x30&seconds=2").train) == 24
    assert np.array_equal(usual.train[0].image, longer.train[0].image)
    assert abs(usual.train[59].image.astype(int) - longer.train[58].image).mean() < 3, "after 4.9 s"
    with pixels_later():
        later = load("synthetic:local?size=40x30&frames=119&seconds=10")
    assert type(later.train[0]) is LaterView and later.fingerprint() == longer.fingerprint()
    assert np.array_equal(later.test[3].mask, longer.test[3].mask)


def test_size_and_frames_options(large):
    """The field of view from top to bottom, the motion and its seconds stay."""
    other = load("synthetic:local?size=96x48&frames=7")
    assert len(other.train) == 7 and [v.time for v in other.train] == [i / 6 for i in range(7)]
    assert other.time_range == large.time_range and len(other.test) == 2 * 5
    for v in (*other.train, *other.test):
        assert v.image.shape == (48, 96, 3) and (v.mask is None or v.mask.shape == (48, 96))
    wide, usual = other.train[0], large.train[0]
    np.testing.assert_allclose(wide.K[1] / 48, usual.K[1] / 120, rtol=1e-6)
    assert wide.K[0, 0] == wide.K[1, 1]
    middle = wide.image[:, 16:80].astype(float)  # 64 of 96 columns show what 160 of 160 do
    blocks = usual.image.astype(float).reshape(24, 5, 32, 5, 3).mean((1, 3))
    assert np.abs(middle.reshape(24, 2, 32, 2, 3).mean((1, 3)) - blocks).mean() < 6  # the axis is .3 pixels off


def shoot(scene, viewmat, t):
    return syn.render(scene, viewmat, t, LENS, syn.ROOM.background)


def test_seed_and_name_change_the_picture():
    scenes = [("static", 0), ("static", 1), ("global", 0), ("local", 0), ("fast", 0)]
    pictures = [shoot(bodies(*scene), syn.room_viewmat(0.25, 0.5), 0.5) for scene in scenes]
    for a, b in combinations(pictures, 2):
        assert (a != b).any(axis=2).mean() > 0.01


@pytest.mark.parametrize("name", MOTIONS)
def test_motion_of_each_scene(name):
    """From a fixed camera: static never changes; the others do, fast more per frame than global."""
    scene = bodies(name, 0)
    camera = syn.ROOM.fixed[0]
    a, b = (shoot(scene, camera, t).astype(float) for t in (0.30, 0.30 + 1 / 59))
    change = np.abs(a - b).mean()
    assert change == 0 if name == "static" else change > (1.0 if name == "fast" else 0.05)


def test_downscale_matches_the_full_picture(large):
    half = load("synthetic:local?frames=3", downscale=2)
    v, w = half.train[1], large.train[1]
    assert v.image.shape == (60, 80, 3) and (v.width, v.height) == (80, 60)
    mean = w.image.reshape(60, 2, 80, 2, 3).mean(axis=(1, 3))
    assert np.abs(v.image - mean).max() <= 0.5
    np.testing.assert_allclose(v.K[:2], w.K[:2] / 2, rtol=1e-6)
    m, n = half.test[0].mask, large.test[0].mask
    np.testing.assert_array_equal(m, n.reshape(60, 2, 80, 2).all(axis=(1, 3)))


def test_a_camera_passes_once_or_jumps():
    places = {path: syn.parse(f"synthetic:static?path={path}").viewmats() for path in syn.PATHS}
    turned = {path: azimuths(np.stack([-m[:3, :3].T @ m[:3, 3] for m in found])) for path, found in places.items()}
    assert (np.diff(turned["pass"]) > 0).all() and all(70 < np.ptp(found) <= 80 for found in turned.values())
    assert np.abs(np.diff(turned["jump"])).mean() > 15 > 8 > np.abs(np.diff(turned["sweeps"])).mean()
    assert syn.parse("synthetic:static?path=jump&seed=1").viewmats()[0].tolist() != places["jump"][0].tolist()


@pytest.mark.parametrize("name", THINGS)
def test_scenes_on_white(name):
    """As in D-NeRF: no points, a camera that jumps over the hemisphere, things that are whole in each picture. Two
    still cameras, away from all others, show each instant; something moves there."""
    d = load(f"synthetic:{name}?size=48x48&frames=20")
    assert len(d.train) == 20 and len(d.test) == 40 and d.points is None and not d.masked
    assert d.background == (1, 1, 1) and all(v.mask is None for v in (*d.train, *d.test))
    places = centers(d.train)
    np.testing.assert_allclose(np.linalg.norm(places, axis=1), 4, rtol=1e-5)
    assert (places[:, 2] > 0).all() and np.linalg.norm(np.diff(places, axis=0), axis=1).mean() > 3
    for camera in (1, 2):
        views = [v for v in d.test if v.camera_id == camera]
        assert [v.time for v in views] == [v.time for v in d.train]
        assert np.linalg.norm(places - centers(views[:1]), axis=1).min() > 0.1
        truth = np.stack([v.image for v in views]).astype(int)
        assert 0.01 < (np.ptp(truth, axis=0).max(axis=2) > 16).mean() < 0.5
    for v in d.train:
        border = np.concatenate([v.image[0], v.image[-1], v.image[:, 0], v.image[:, -1]])
        assert (border == 255).all() and (v.image < 200).any()


@pytest.mark.parametrize("seed", range(6))
def test_the_dancer_moves_in_a_closed_cycle_on_the_ground(seed):
    """Every part goes a continuous way that ends where it began, some feet are on the ground, and limbs are whole."""
    dancer = Dancer(seed)
    figure = dancer.bodies()[1:]
    times = np.linspace(0, 1, 61)
    centers = np.stack([[body.pose(t)[1] for body in figure] for t in times])
    np.testing.assert_allclose(centers[0], centers[-1], atol=1e-9)
    assert np.abs(centers).max() < 1.2
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=2)
    assert 0.01 < steps.max() < 0.06  # the fastest is the lantern
    assert (steps.max(axis=0) > 0).all()
    for t in times[::6]:
        bones = dancer.bones(t)
        soles = [bones[f"{side} foot"][1][2] for side in ("left", "right")]
        assert min(soles) == pytest.approx(0.08) and max(soles) < 0.2
        for side, limb, joint in product(("left", "right"), ("arm", "leg"), ("elbow", "knee")):
            if (limb, joint) in (("arm", "elbow"), ("leg", "knee")):
                halves = [bones[f"{side} {limb} {k}"] for k in range(2)]
                ends = halves[0][1] + halves[0][0][:, 2], halves[1][1] - halves[1][0][:, 2]
                np.testing.assert_allclose(ends, [bones[f"{side} {joint}"][1]] * 2, atol=1e-9)


def test_seeds_of_the_dancer_differ_in_build_clothes_and_motion():
    view = syn.FIGURE.fixed[0]
    pictures = [shoot(Dancer(seed).bodies(), view, 0.5) for seed in (0, 1, 2)]
    for a, b in combinations(pictures, 2):
        assert (a != b).any(axis=2).mean() > 0.05
    a, b = (Dancer(seed) for seed in (0, 1))
    assert a.tall != b.tall and a.phase != b.phase and a.hue != b.hue


def test_the_dancer_is_a_set_in_the_layout_of_d_nerf():
    d = load("synthetic:dancer?size=48x48&frames=30")
    assert len(d.train) == 30 and len(d.test) == 2 * 14 and d.points is None and d.background == (1, 1, 1)
    for v in d.train:
        border = np.concatenate([v.image[0], v.image[-1], v.image[:, 0], v.image[:, -1]])
        assert (border == 255).all() and (v.image < 160).any()


# -- random scenes -----------------------------------------------------------------------------------------------------


def ways(bodies, instants=65):
    """Places [n, instants, 3] of bodies over time."""
    return np.stack([[body.pose(t)[1] for t in np.linspace(0, 1, instants)] for body in bodies])


def test_random_scenes_are_of_all_kinds():
    """3 to 8 bodies besides floor and wall, of which some move and some do not; every kind of way, camera and place."""
    scenes = [random_scene(seed) for seed in range(40)]
    assert {scene.path for scene in scenes} == set(PATHS)
    assert {(scene.room, scene.background == (1, 1, 1)) for scene in scenes} >= {(True, True), (False, True)}
    assert any(not scene.room and scene.background != (1, 1, 1) for scene in scenes)
    counts = []
    for scene in scenes:
        way = ways(scene.bodies[2 * scene.room :])
        moves = np.ptp(way, axis=1).max(axis=1) > 0
        counts.append(len(way))
        assert 0 < moves.sum() < len(way)
    assert min(counts) == 3 and max(counts) == 8


@pytest.mark.parametrize("seed", range(8))
def test_random_bodies_stay_apart_and_in_view(seed):
    """The inscribed balls of bodies never meet, nor do those of a room leave it through the floor; before a plain
    background each training picture has nothing but background along its border."""
    scene = random_scene(seed)
    bodies = scene.bodies[2 * scene.room :]
    way = ways(bodies, 41)
    radii = [np.linalg.svd(body.pose(0.3)[0], compute_uv=False).min() for body in bodies]
    for a, b in combinations(range(len(bodies)), 2):
        assert np.linalg.norm(way[a] - way[b], axis=1).min() > radii[a] + radii[b]
    if scene.room:
        assert all(line[:, 2].min() > radius - 1e-9 for line, radius in zip(way, radii, strict=True))
        return
    for v in load(f"synthetic:{RANDOM}?seed={seed}&size=48x48&frames=12&path=jump").train:
        border = np.concatenate([v.image[0], v.image[-1], v.image[:, 0], v.image[:, -1]])
        assert (border == border[0]).all() and (v.image != border[0]).any()


def test_the_lost_ball_is_within_reach():
    """As in D-NeRF, a body goes half around a still one, by less than its radius between 100 views."""
    scene = random_scene(242)
    assert scene.path == "jump" and scene.background == (1, 1, 1) and not scene.room
    way = ways(scene.bodies, 100)
    moving = np.ptp(way, axis=1).max(axis=1) > 0
    assert np.abs(way[~moving][0]).max() < 0.2
    (around,) = way[moving]
    distance = np.linalg.norm(around, axis=1)
    assert np.ptp(distance) < 1e-6 and distance[0] > 0.9
    length = np.linalg.norm(np.diff(around, axis=0), axis=1)
    assert 0.4 < length.sum() / (2 * np.pi * distance[0]) < 0.6
    (A,) = (body.pose(0)[0] for body, moves in zip(scene.bodies, moving, strict=True) if moves)
    assert length.max() < 0.25 * np.cbrt(np.linalg.det(A))


def test_cameras_that_stand_still_show_every_instant():
    d = load("synthetic:random?seed=0&size=24x24&frames=5&path=still")
    assert len(d.train) == syn.CAMERAS * 5 and {v.camera_id for v in d.test} == {syn.CAMERAS, syn.CAMERAS + 1}
    for camera in range(syn.CAMERAS):
        views = [v for v in d.train if v.camera_id == camera]
        assert [v.time for v in views] == [0, 0.25, 0.5, 0.75, 1] and np.ptp(centers(views), axis=0).max() == 0
    assert len(np.unique(centers(d.train), axis=0)) == syn.CAMERAS


def test_pictures_without_a_body_differ_where_it_is():
    """The body's pixels, its shadow and its edges are all that differ; nothing else moves in the scene."""
    source = "synthetic:flyby?size=64x64&frames=7"
    d = load(source)
    (ball,) = movers(source, d.test)
    truth = np.stack([v.image for v in d.test]).astype(int)
    changed = (np.abs(truth - ball.without).max(axis=3) > 3)[ball.shown]
    assert changed.mean() > 0.97
    fixed = [v for v in d.test if v.camera_id == 1]
    assert np.ptp(ball.without[: len(fixed)], axis=0).max() == 0 < np.ptp(truth[: len(fixed)], axis=0).max()
    pixels = 0.18 / 4 * d.test[0].K[0, 0]  # at the mean distance
    assert pixels * 0.7 < ball.radius < pixels * 1.3
    assert ball.step == pytest.approx(np.linalg.norm([2 / 6, 2.4 * (0.25 - (0.5 - 1 / 6) ** 2)]) / 0.36, rel=1e-6)


def test_pixels_of_a_body_count_within_the_masks():
    source = "synthetic:fast?size=40x30&frames=9"
    d = load(source)
    found = movers(source, d.test)
    assert len(found) == 6  # a crate, which turns in its place, three balls, a rod and its bob
    assert min(body.step for body in found) == 0 < found[1].step
    for body in found:
        assert not (body.shown & ~np.stack([v.mask for v in d.test])).any()
