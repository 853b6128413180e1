"""Follows what moves through all views, from the key instant outwards, before any picture of another instant is learnt.

The points that `movers` finds hang together in bodies. Colours tell a body's pixels from others (ratio of histograms:
Swain and Ballard, Color indexing, 1991), their mean is where a view sees it (mean shift: Comaniciu, Ramesh and Meer,
Kernel-based object tracking, 2003), and its path is the smoothest on which all views see it there, to within their
noise. One view shows no depth, and the rays of many do not meet, but a smooth path passes by all of them in one place
only (Avidan and Shashua, Trajectory triangulation, 2000). No model of the scene is needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool3d

from pd4dgs_codec.data.view import Dataset, thinned
from pd4dgs_codec.train.movers import ALIKE, CELLS, NEAR, Photo, moving_starts

#: Views that are searched at most.
VIEWS = 240
#: Bodies that are followed at most, the largest first, and points that each has afterwards, at most.
BODIES, POINTS = 12, 300
#: Bins of a colour channel; samples across a body's disc, two thirds as many across its hull; instants between which a
#: path is straight.
BINS, SAMPLES, KNOTS = 12, 21, 48
#: Views see a body's middle to within a part SPREAD of its radius. Its path is the stiffest that agrees so well with
#: views it has not seen. STIFF: weights of its squared acceleration, radii per squared length of the recording.
SPREAD, STIFF = 0.1, (2.5e-3, 2.5e-4, 2.5e-5)
#: Views of the first ROUNDS rounds, rounds in which they become all, and moves of a disc in each, which has WIDE radii
#: of the body.
FIRST, ROUNDS, GROWS, SHIFTS, WIDE = 4, 3, 20, 4, 1.1
TINY = 1e-9  #: keeps quotients finite


class Track(NamedTuple):
    """points: [n, 3], world, of a body at the key instant. times: [T], normalised. offsets: [T, 3], its way."""

    points: Tensor
    times: Tensor
    offsets: Tensor


@torch.no_grad()
def followed(dataset: Dataset, points: Tensor, key: float) -> list[Track]:
    """The tracks of the bodies to which `points` [n, 3], world, at the key instant `key` belong; none of what stays."""
    views = _Views([Photo(view) for view in thinned(dataset.train, VIEWS)], key, dataset.near)
    cell = float((dataset.box[1] - dataset.box[0]).max()) / CELLS
    colour = views.colours(points)
    bodies = sorted(bodies_of(points, colour, cell), key=len, reverse=True)[:BODIES]
    tracks, ways = list[Track](), list[Tensor]()
    for rows in bodies:
        body = _Body(views, points[rows], cell) if len(rows) > NEAR else None
        if body is None or not body.follow():
            continue
        way = body.places
        if all(float((way - other).norm(dim=1).mean()) > body.radius for other in ways):
            ways.append(way)
            tracks.append(body.track())
    return [track for track in tracks if len(track.points) > NEAR]


def moving_bodies(dataset: Dataset, key: float) -> tuple[Tensor, list[Track]]:
    """Returns (float32 [n, 3] start points of what moves at the key instant `key`: what `movers` finds, and the hulls
    of the bodies that can be followed from there, also on the sides that no view near the key instant shows; the tracks
    of these bodies)."""
    points = moving_starts(dataset, key)
    tracks = followed(dataset, points, key)
    return torch.cat([points, *(track.points for track in tracks)]), tracks


def bodies_of(points: Tensor, colour: Tensor, apart: float) -> list[Tensor]:
    """int64 [n] of each body: the `points` [n, 3] that hang together over gaps of less than `apart`, with colours [n,
    3] that are alike."""
    label, near = torch.arange(len(points)), torch.cdist(points, points) < apart
    near &= torch.cdist(colour, colour, p=torch.inf) < ALIKE
    while len(points):
        lower = torch.where(near, label, len(points)).amin(1)
        lower = lower[lower]
        if (lower == label).all():
            break
        label = lower
    return [(label == one).nonzero()[:, 0] for one in set(label.tolist())]


class _Views:
    """All views, the nearest to the key instant first. time: [V]. eye: [V, 3]. bins: [pixels], of their colours."""

    def __init__(self, pictures: Sequence[Photo], key: float, near: float):
        self.key = key
        self.pictures = pictures = sorted(pictures, key=lambda picture: abs(picture.time - key))
        self.near = near
        self.time = torch.tensor([picture.time for picture in pictures], dtype=torch.float64)
        viewmat, self.K = (
            torch.stack([torch.tensor(getattr(p.view, name), dtype=torch.float64) for p in pictures])
            for name in ("viewmat", "K")
        )
        self.turn, self.shift = viewmat[:, :3, :3], viewmat[:, :3, 3]
        self.eye = -torch.einsum("vji,vj->vi", self.turn, self.shift)
        self.size = torch.tensor([(p.valid.shape[1], p.valid.shape[0]) for p in pictures])
        bins = [(p.colour * BINS).long().clamp(max=BINS - 1) @ torch.tensor([BINS**2, BINS, 1]) for p in pictures]
        self.bins = torch.cat([own.where(p.valid, BINS**3).flatten() for own, p in zip(bins, pictures, strict=True)])
        self.first = self.size.prod(1).cumsum(0) - self.size.prod(1)

    def colours(self, points: Tensor) -> Tensor:
        """[n, 3]: the median colours of points near the key instant."""
        return torch.stack([picture.at(points)[0] for picture in self.pictures[:NEAR]]).median(0).values

    def project(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """(pixels [V, n, 2], x and y; depths [V, n]) of places [V, n, 3] in the first V views."""
        n = len(places)
        local = torch.einsum("vij,vnj->vni", self.turn[:n], places) + self.shift[:n, None]
        found = torch.einsum("vij,vnj->vni", self.K[:n], local)
        return found[..., :2] / found[..., 2:].clamp(min=self.near), local[..., 2]

    def rays(self, pixels: Tensor) -> Tensor:
        """Unit vectors [V, 3] through pixels [V, 2]."""
        n = len(pixels)
        local = torch.linalg.solve(self.K[:n], torch.cat([pixels, torch.ones(n, 1)], 1)[..., None])
        ray = torch.einsum("vji,vj->vi", self.turn[:n], local[..., 0])
        unit: Tensor = ray / ray.norm(dim=1, keepdim=True)
        return unit

    def bins_at(self, pixels: Tensor) -> Tensor:
        """int64 [V, n]: the bins at pixels [V, n, 2]; BINS³ outside and where a view is not valid."""
        n = len(pixels)
        at, size = pixels.floor().long(), self.size[:n, None]
        inside = ((at >= 0) & (at < size)).all(-1)
        at = at.clamp(min=0).minimum(size - 1)
        return self.bins[self.first[:n, None] + at[..., 1] * size[..., 0] + at[..., 0]].where(inside, BINS**3)


def _histogram(bins: Tensor, weight: Tensor | None = None) -> Tensor:
    """[BINS³ + 1]: shares of the colours, blurred by a bin; 0 outside."""
    count = torch.bincount(bins.flatten(), weight, BINS**3 + 1)[:-1].double().view(1, 1, BINS, BINS, BINS)
    blurred = avg_pool3d(avg_pool3d(count, 2, 1, 1), 2, 1)
    return torch.cat([blurred.flatten() / blurred.sum().clamp(min=TINY), torch.zeros(1)])


class _Seen(NamedTuple):
    """Where the first V views see a body. ray: [V, 3], of length 1. flat: [V, 3, 3], removes what is along the ray.
    weight: [V], 0 where it is hidden or not in the picture."""

    ray: Tensor
    flat: Tensor
    weight: Tensor


class _Body:
    """A body on its way. radius: that of a disc that views see. knots: [K, 3], its places at K instants, float64."""

    def __init__(self, views: _Views, points: Tensor, cell: float):
        points = points.double()
        middle = points.median(0).values
        self.views, self.size = views, max(float((points - middle).norm(dim=1).median()), cell / 4)
        self.radius, self.times = self.size, views.time.unique()  # type: ignore[no-untyped-call]
        count = min(len(self.times), KNOTS)
        self.start, self.knots = middle, middle.repeat(count, 1)
        at = torch.cat([views.time, torch.tensor([views.key])])
        at = (at - self.times[0]) / (self.times[-1] - self.times[0]) * (count - 1)
        rows = (1 - (at[:, None] - torch.arange(count)).abs()).clamp(min=0)
        self.rows, self.row = rows[:-1], rows[-1]  # [V, K] of the views and [K] of the key instant
        bend = torch.eye(count).double().diff(n=2, dim=0)
        self.bend = bend.T @ bend * float(count**3)
        self.first = self.colours = _histogram(views.bins_at(views.project(points.expand(NEAR, -1, -1))[0]))
        self.others = _histogram(views.bins)
        side = torch.linspace(-1, 1, SAMPLES, dtype=torch.float64)
        disc = torch.cartesian_prod(side, side)
        self.disc = disc[disc.norm(dim=1) <= 1]

    @property
    def here(self) -> Tensor:
        """[3]: where it is at the key instant."""
        found: Tensor = self.row @ self.knots
        return found

    @property
    def places(self) -> Tensor:
        """[V, 3]: where it is in each view."""
        found: Tensor = self.rows @ self.knots
        return found

    def follow(self) -> bool:
        """Finds the path in more and more views. Whether half of them see the body, the median of these within half
        a radius of its path, and by SPREAD radii farther from any place at which it could stand, and whether the path
        still passes within a radius of where the points stand: else it has left for another body of like colours."""
        counts = [min(FIRST, len(self.rows))] * ROUNDS
        while counts[-1] < len(self.rows):
            counts.append(min(counts[-1] - (-len(self.rows) // GROWS), len(self.rows)))
        for k, count in enumerate([*counts, *[len(self.rows)] * ROUNDS]):
            seen = self._seen(count, first=k < ROUNDS)
            if (seen.weight > 0).sum() < FIRST - 1:
                return False
            self._fit(seen)
        if (self.here - self.start).norm() > self.radius:
            return False
        good = seen.weight > 0
        stays = torch.linalg.lstsq(seen.flat.sum(0), (seen.flat @ self.views.eye[..., None]).sum(0)).solution[:, 0]
        own, still = (
            float((seen.flat @ (self.views.eye - place)[..., None])[good, :, 0].norm(dim=1).median()) / self.radius
            for place in (self.places, stays)
        )
        return own <= 0.5 and still > own + SPREAD and bool(good.double().mean() > 0.5)

    def track(self) -> Track:
        """The track, with points that views show as the body's: its hull, as it moves (visual hull: Laurentini,
        The visual hull concept for silhouette-based image understanding, 1994)."""
        side = torch.linspace(-1, 1, 2 * SAMPLES // 3, dtype=torch.float64)
        ball = torch.cartesian_prod(side, side, side) * self.radius
        pixels, _ = self.views.project(self.places[:, None] + ball)
        share = self._like(self.views.bins_at(pixels)).mean(0)
        hull = ball[share > share.max() / 2]
        hull = hull[torch.randperm(len(hull), generator=torch.Generator().manual_seed(0))[:POINTS]]
        index = [int((self.views.time == time).nonzero()[0, 0]) for time in self.times]
        return Track((self.here + hull).float(), self.times.float(), (self.places[index] - self.here).float())

    def _like(self, bins: Tensor) -> Tensor:
        """0..1: how probably pixels of these colours are the body's."""
        return (self.colours / (self.colours + self.others).clamp(min=TINY))[bins]

    def _seen(self, count: int, *, first: bool) -> _Seen:
        """Where `count` views see the body; updates its colours and radius."""
        views = self.views
        predicted, depth = views.project(self.places[:count, None])
        predicted, depth = predicted[:, 0], depth[:, 0]
        radius = views.K[:count, 0, 0] * self.radius / depth.clamp(min=views.near)
        middle, reach = predicted, WIDE * radius + 1
        for _ in range(SHIFTS):
            pixels = middle[:, None] + reach[:, None, None] * self.disc
            like = self._like(views.bins_at(pixels))
            middle = ((like[..., None] * pixels).sum(1) + TINY * middle) / (like.sum(1, keepdim=True) + TINY)
        area = like.mean(1) * (reach / radius).square()  # in discs of its radius
        margin = torch.minimum(middle, views.size[:count] - middle).amin(1)
        shown = (depth > views.near) & (margin > 0.5 * radius) & (area > SPREAD)
        usual = area[shown].median() if shown.any() else area.new_ones(())
        weight = torch.minimum(area / usual, usual / area.clamp(min=TINY)).square() * shown
        if not first:
            weight = weight / (1 + ((middle - predicted).norm(dim=1) / (0.5 * radius)).square())
        if shown.any():
            core = views.bins_at(middle[:, None] + (0.5 * radius + 1)[:, None, None] * self.disc)
            now = _histogram(core, weight[:, None].expand_as(core).flatten())
            self.colours = (self.first + now) / 2
            grown = (self.radius * area.sqrt())[shown][: 2 * NEAR].median()
            self.radius = min(max(float(grown), self.size), 2 * self.size)
        ray = views.rays(middle)
        return _Seen(ray, torch.eye(3) - ray[:, :, None] * ray[:, None], weight)

    def _fit(self, seen: _Seen) -> None:
        """Sets the knots to the stiffest path that is near the rays, each left out in turn."""
        count, knots = len(seen.ray), len(self.knots)
        rows, flat = self.rows[:count], seen.flat
        weight = seen.weight / (SPREAD * self.radius) ** 2 / len(self.views.time)
        normal = torch.einsum("v,vi,vj,vab->aibj", weight, rows, rows, flat).reshape(3 * knots, -1)
        right = torch.einsum("v,vi,vab,vb->ai", weight, rows, flat, self.views.eye[:count]).flatten()
        bend = torch.kron(torch.eye(3).double(), self.bend) / self.radius**2
        tries = []
        for stiff in STIFF:
            inverse = torch.linalg.inv(normal + stiff * bend + TINY * normal.diagonal().mean() * torch.eye(3 * knots))
            path = (inverse @ right).view(3, knots).T
            spread = torch.einsum("vi,aibj,vj->vab", rows, inverse.view(3, knots, 3, knots), rows)
            miss = (flat @ (self.views.eye[:count] - rows @ path)[..., None])[..., 0]
            leverage = weight[:, None, None] * (flat @ spread @ flat)
            without = torch.linalg.solve((1 + TINY) * torch.eye(3) - leverage, miss)
            error = (without.norm(dim=1) / (SPREAD * self.radius)).clamp(max=3).square()
            tries.append((float(error[seen.weight > 0].mean()), path))
        enough = max(1.0, min(error for error, _ in tries))
        self.knots = next(path for error, path in tries if error <= enough)
