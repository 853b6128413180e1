"""Runs in the layouts of 4DGaussians, Deformable-3DGS and SC-GS, from their published formulas, and the quality lost by
learning from them.

The modules stand on their own: plain torch layers and `grid_sample`, so that tests compare the package's readers with
them. `python benchmarks/teachers.py` bends a ball of Gaussians with each, trains a model from each run, and prints
bytes, quality of the packed file against the run's own pictures from held-out cameras and times, and processor minutes.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from common import command
from torch import Tensor, nn
from torch.nn import functional

from pd4dgs_codec.interchange.splats import ply_bytes, sphere
from pd4dgs_codec.kinds.splats import SH_C0, Splats

OPTIONS = {
    "no_dx": False, "no_ds": False, "no_dr": False, "no_do": True, "no_dshs": True, "no_grid": False, "grid_pe": 0,
    "static_mlp": False, "empty_voxel": False, "apply_rotation": False,
}  # fmt: skip
FIT_STEPS, ITERATIONS = 300, 1500


def parameters(splats: Splats) -> dict[str, Tensor]:
    """What a PLY file of these Gaussians holds: logarithms of scales, logits of opacities."""
    p = torch.from_numpy(splats.opacities)
    return {
        "means": torch.from_numpy(splats.means), "quats": torch.from_numpy(splats.quats),
        "scales": torch.from_numpy(splats.scales).log(), "opacities": (p / (1 - p)).log(),
        "sh": torch.from_numpy(splats.sh),
    }  # fmt: skip


def save(run: Path, splats: Splats, network: nn.Module, file: str, options: dict[str, object]) -> Path:
    """A run with one iteration. file: path of the network in the run."""
    for path in (run / "point_cloud/iteration_7/point_cloud.ply", run / file):
        path.parent.mkdir(parents=True, exist_ok=True)
    (run / "point_cloud/iteration_7/point_cloud.ply").write_bytes(ply_bytes(splats))
    torch.save(network.state_dict(), run / file)
    (run / "cfg_args").write_text(f"Namespace({', '.join(f'{k}={v!r}' for k, v in options.items())})")
    return run


def head(width: int, outputs: int) -> nn.Sequential:
    """A head of 4DGaussians."""
    return nn.Sequential(nn.ReLU(), nn.Linear(width, width), nn.ReLU(), nn.Linear(width, outputs))


def hamilton(a: Tensor, b: Tensor) -> Tensor:
    """Products of quaternions wxyz by 4 x 4 matrices."""
    w, x, y, z = a.unbind(1)
    rows = [[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]
    return torch.einsum("ijn,nj->ni", torch.stack([torch.stack(row) for row in rows]), b)


class Planes(nn.Module):
    """The grid of 4DGaussians. resolution: cells of x, y, z and t; scales multiply those of space."""

    def __init__(self, resolution: tuple[int, ...], features: int, scales: tuple[int, ...], box: Tensor):
        super().__init__()
        self.aabb = nn.Parameter(box, requires_grad=False)  # the largest coordinates, then the least
        self.grids = nn.ModuleList()
        for scale in scales:
            cells = [*(scale * n for n in resolution[:3]), resolution[3]]
            pairs = itertools.combinations(range(4), 2)
            planes = [torch.rand(1, features, cells[b], cells[a]) + 0.5 for a, b in pairs]
            self.grids.append(nn.ParameterList(planes))

    def forward(self, means: Tensor, t: float) -> Tensor:
        """[n, features times scales]."""
        inside = (means - self.aabb[0]) * (2 / (self.aabb[1] - self.aabb[0])) - 1
        at = torch.cat([inside, torch.full_like(means[:, :1], t)], dim=1)
        features = []
        for planes in self.grids:
            product: Tensor | float = 1.0
            for plane, pair in zip(planes, itertools.combinations(range(4), 2), strict=True):
                where = at[None, None, :, list(pair)]
                product = product * functional.grid_sample(plane, where, align_corners=True, padding_mode="border")
            features.append(product[0, :, 0].T)
        return torch.cat(features, dim=1)


class FourD(nn.Module):
    """4DGaussians. options: those of its cfg_args that differ from OPTIONS. depth: its defor_depth."""

    def __init__(self, splats: Splats, depth: int = 1, width: int = 32, **options: object):
        super().__init__()
        self.rest, self.options = parameters(splats), OPTIONS | options
        net = nn.Module()
        low, high = self.rest["means"].amin(0), self.rest["means"].amax(0)
        net.grid = Planes((12, 10, 8, 14), 16, (1, 2), torch.stack([high * 0.9, low * 0.9]))  # some lie outside
        layers: list[nn.Module] = [nn.Linear(32, width)]
        for _ in range(depth - 1):
            layers += [nn.ReLU(), nn.Linear(width, width)]
        net.feature_out = nn.Sequential(*layers)
        coefficients = self.rest["sh"].shape[1]
        outputs = dict(pos_deform=3, scales_deform=3, rotations_deform=4, opacity_deform=1, shs_deform=3 * coefficients)
        for name, count in outputs.items():
            setattr(net, name, head(width, count))
        if self.options["static_mlp"]:
            net.static_mlp = head(width, 1)
        self.timenet = nn.Linear(9, 8)  # theirs has one too, and does not use it
        self.register_buffer("time_poc", 2.0 ** torch.arange(4))
        self.deformation_net = net

    def forward(self, t: float) -> dict[str, Tensor]:
        """The Gaussians at a time 0..1."""
        net, rest, off = self.deformation_net, self.rest, self.options
        hidden = net.feature_out(net.grid(rest["means"], t))
        keep = net.static_mlp(hidden) if off["static_mlp"] else torch.ones(len(hidden), 1)
        out = dict(rest)
        if not off["no_dx"]:
            out["means"] = rest["means"] * keep + net.pos_deform(hidden)
        if not off["no_ds"]:
            out["scales"] = rest["scales"] * keep + net.scales_deform(hidden)
        if not off["no_dr"]:
            turn = net.rotations_deform(hidden)
            out["quats"] = hamilton(rest["quats"], turn) if off["apply_rotation"] else rest["quats"] + turn
        if not off["no_do"]:
            out["opacities"] = rest["opacities"] * keep[:, 0] + net.opacity_deform(hidden)[:, 0]
        if not off["no_dshs"]:
            out["sh"] = rest["sh"] * keep[:, :, None] + net.shs_deform(hidden).reshape(rest["sh"].shape)
        out["quats"] = functional.normalize(out["quats"])
        return out | {"scales": out["scales"].exp(), "opacities": out["opacities"].sigmoid()}

    def save(self, run: Path, splats: Splats) -> Path:
        """A run of it."""
        folder = "point_cloud/iteration_7/"
        save(run, splats, self, folder + "deformation.pth", self.options | {"kplanes_config": {"resolution": [12, 10]}})
        torch.save(torch.ones(len(splats.means), dtype=torch.bool), run / folder / "deformation_table.pth")
        torch.save(torch.zeros(len(splats.means), 3), run / folder / "deformation_accum.pth")
        return run


def encoded(values: Tensor, octaves: int) -> Tensor:
    """The positional encoding of NeRF, with its input."""
    waves = [f(values * 2.0**i) for i in range(octaves) for f in (torch.sin, torch.cos)]
    return torch.cat([values, *waves], dim=1)


class Positional(nn.Module):
    """The layers of Deformable-3DGS and SC-GS, with their skip."""

    def __init__(self, is_blender: bool):
        super().__init__()
        self.is_blender = is_blender
        depth, self.width = 8, 64  # theirs are 8 and 256
        self.inputs = 63 + (30 if is_blender else 21)
        if is_blender:
            self.timenet = nn.Sequential(nn.Linear(13, 256), nn.ReLU(), nn.Linear(256, 30))
        wide = [self.inputs, *(self.width + self.inputs * (i == depth // 2) for i in range(depth - 1))]
        self.linear = nn.ModuleList([nn.Linear(n, self.width) for n in wide])

    def features(self, points: Tensor, t: float) -> tuple[Tensor, Tensor]:
        """What enters the layers and what leaves them, for points [n, 3] at a time 0..1."""
        times = encoded(torch.full_like(points[:, :1], t), 6 if self.is_blender else 10)
        if self.is_blender:
            times = self.timenet(times)
        given = hidden = torch.cat([encoded(points, 10), times], dim=1)
        for i, layer in enumerate(self.linear):
            hidden = torch.relu(layer(hidden))
            if i == len(self.linear) // 2:
                hidden = torch.cat([given, hidden], dim=1)
        return given, hidden


class Deformable(Positional):
    """Deformable-3DGS."""

    def __init__(self, splats: Splats, is_blender: bool = False, is_6dof: bool = False):
        super().__init__(is_blender)
        self.rest, self.is_6dof = parameters(splats), is_6dof
        if is_6dof:
            self.branch_w, self.branch_v = nn.Linear(self.width, 3), nn.Linear(self.width, 3)
        else:
            self.gaussian_warp = nn.Linear(self.width, 3)
        self.gaussian_rotation, self.gaussian_scaling = nn.Linear(self.width, 4), nn.Linear(self.width, 3)

    def forward(self, t: float) -> dict[str, Tensor]:
        """The Gaussians at a time 0..1; quaternions of any length, which enter the matrix's formula as they are."""
        rest, means = self.rest, self.rest["means"]
        _, hidden = self.features(means, t)
        if self.is_6dof:
            means = self._screw(self.branch_w(hidden), self.branch_v(hidden))
        else:
            means = means + self.gaussian_warp(hidden)
        return rest | {
            "means": means,
            "quats": functional.normalize(rest["quats"]) + self.gaussian_rotation(hidden),
            "scales": rest["scales"].exp() + self.gaussian_scaling(hidden),
            "opacities": rest["opacities"].sigmoid(),
        }

    def _screw(self, w: Tensor, v: Tensor) -> Tensor:
        """Means by the matrices of a screw (Modern Robotics, 3.51 and 3.88)."""
        angle = w.norm(dim=1, keepdim=True)
        (x, y, z), v = (w / angle + 1e-5).unbind(1), v / angle + 1e-5
        zero, a, one = torch.zeros_like(x), angle[:, :, None], torch.eye(3)
        cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=1).reshape(-1, 3, 3)
        turn = one + a.sin() * cross + (1 - a.cos()) * cross @ cross
        shift = (a * one + (1 - a.cos()) * cross + (a - a.sin()) * cross @ cross) @ v[:, :, None]
        return (turn @ self.rest["means"][:, :, None] + shift)[:, :, 0]

    def save(self, run: Path, splats: Splats) -> Path:
        """A run of it."""
        options = {"is_blender": self.is_blender, "is_6dof": self.is_6dof, "white_background": True}
        return save(run, splats, self, "deform/iteration_7/deform.pth", options)


class Nodes(nn.Module):
    """SC-GS with `count` nodes. coordinates: of nodes and Gaussians beside those of space. options: of cfg_args."""

    def __init__(self, splats: Splats, count: int = 20, coordinates: int = 2, **options: object):
        super().__init__()
        self.rest = parameters(splats)
        defaults = {"K": 3, "local_frame": False, "gs_with_motion_mask": False, "max_d_scale": -1.0}
        self.options = defaults | options
        net = self.network = Positional(bool(self.options.get("is_blender")))
        for name, outputs in dict(warp=3, scaling=3, rotation=4).items():
            setattr(net, f"gaussian_{name}", nn.Linear(net.width, outputs))
        if self.options["local_frame"]:
            net.local_rotation = nn.Linear(net.width, 4)
        rows = torch.randperm(len(self.rest["means"]))[:count]
        self.nodes = nn.Parameter(torch.cat([self.rest["means"][rows], torch.randn(count, coordinates) * 0.1], dim=1))
        self._node_radius = nn.Parameter(torch.randn(count) * 0.3 - 0.5)
        self._node_weight = nn.Parameter(torch.randn(count, 1))
        self.register_buffer("inited", torch.tensor(True))
        masked = bool(self.options["gs_with_motion_mask"])
        self.feature = torch.randn(len(self.rest["means"]), coordinates + masked) * 0.1

    def forward(self, t: float) -> dict[str, Tensor]:
        """The Gaussians at a time 0..1."""
        rest, net, on = self.rest, self.network, self.options
        x, nodes, coordinates = rest["means"], self.nodes[:, :3], self.nodes.shape[1] - 3
        here = torch.cat([x, self.feature[:, :coordinates]], dim=1)
        apart, near = torch.cdist(here.double(), self.nodes.double()).float().topk(int(str(on["K"])), largest=False)
        weights = torch.exp(-(apart**2) / (2 * torch.exp(self._node_radius)[near] ** 2))
        weights = weights * torch.sigmoid(self._node_weight)[near][..., 0] + 1e-7
        weights = (weights / weights.sum(dim=1, keepdim=True))[..., None]
        _, hidden = net.features(nodes, t)

        def mean(values: Tensor) -> Tensor:
            return (values[near] * weights).sum(dim=1)

        shift = net.gaussian_warp(hidden)
        if on["local_frame"]:
            turn = matrices(functional.normalize(net.local_rotation(hidden) + torch.tensor([1.0, 0, 0, 0])))
            around = (turn[near] @ (x[:, None] - nodes[near])[..., None])[..., 0] + nodes[near] + shift[near]
            moved = (around * weights).sum(dim=1) - x
        else:
            moved = mean(shift)
        mask = torch.sigmoid(self.feature[:, -1:]) if on["gs_with_motion_mask"] else torch.ones(len(x), 1)
        scaling = net.gaussian_scaling(hidden)
        if (limit := float(str(on["max_d_scale"]))) > 0:
            scaling = torch.tanh(scaling) * np.log(limit)
        return rest | {
            "means": x + moved * mask,
            "quats": functional.normalize(rest["quats"] + mean(net.gaussian_rotation(hidden)) * mask),
            "scales": rest["scales"].exp() + mean(scaling) * mask,
            "opacities": rest["opacities"].sigmoid(),
        }

    def save(self, run: Path, splats: Splats) -> Path:
        """A run of it, whose PLY file also has the features."""
        save(run, splats, self, "deform/iteration_7/deform.pth", self.options | {"white_background": True})
        path = run / "point_cloud/iteration_7/point_cloud.ply"
        head, body = path.read_bytes().split(b"end_header\n", 1)
        head += b"".join(b"property float fea_%d\n" % i for i in range(self.feature.shape[1])) + b"end_header\n"
        rows = np.frombuffer(body, "<f4").reshape(len(splats.means), -1)
        path.write_bytes(head + np.concatenate([rows, self.feature.numpy()], axis=1).astype("<f4").tobytes())
        return run


def matrices(quats: Tensor) -> Tensor:
    """Rotations [n, 3, 3] of unit quaternions wxyz: I + 2 w [v] + 2 [v]^2."""
    w, x, y, z = quats.unbind(1)
    zero = torch.zeros_like(w)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=1).reshape(-1, 3, 3)
    return torch.eye(3) + 2 * w[:, None, None] * cross + 2 * cross @ cross


# -- lost quality -----------------------------------------------------------------------------------------------------


def ball(count: int = 1500) -> Splats:
    """A striped ball of Gaussians."""
    means = sphere(count).astype(np.float32)
    bands = (np.sin(9 * means[:, 2:]) > 0) * np.float32([0.8, 0.3, -0.6]) + means * 0.25
    sh = ((bands + 0.1) / SH_C0)[:, None].astype(np.float32) * np.float32(0.5)
    quats = np.tile(np.float32([1, 0, 0, 0]), (count, 1))
    wide = np.full((count, 3), 2.2 / np.sqrt(count), np.float32)
    sh = np.concatenate([sh, np.zeros((count, 15, 3), np.float32)], axis=1)
    return Splats(means, quats, wide, np.full(count, 0.95, np.float32), sh)


def bent(means: Tensor, t: float) -> Tensor:
    """The target of the motion: the ball leans and turns more at its top."""
    angle = torch.sin(torch.tensor(2 * np.pi * t)) * 0.7 * means[:, 2]
    x, y, z = means.unbind(1)
    return torch.stack([x * angle.cos() - y * angle.sin() + 0.4 * t * z, x * angle.sin() + y * angle.cos(), z], dim=1)


def fit(model: FourD | Deformable, steps: int = FIT_STEPS) -> None:
    """Trains a network to bend the ball, with scales and rotations that stay about the same."""
    optimiser = torch.optim.Adam(model.parameters(), 2e-3)
    rng, scales = np.random.default_rng(0), model.rest["scales"].exp()
    for _ in range(steps):
        t = float(rng.uniform())
        found = model(t)
        targets = {"means": bent(model.rest["means"], t), "quats": model.rest["quats"], "scales": scales}
        loss = sum((found[name] - target).square().mean() for name, target in targets.items())
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()


def main() -> None:
    """The table."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    torch.manual_seed(0)
    print("| run | bytes of the run | .pd4 bytes | held-out dB | processor minutes |\n" + "| - " * 5 + "|")
    for name, model in (("4DGaussians", FourD(ball())), ("Deformable-3DGS", Deformable(ball(), is_blender=True))):
        fit(model)
        with tempfile.TemporaryDirectory() as folder:
            run, made, packed = Path(folder) / "run", Path(folder) / "model.pt", Path(folder) / "scene.pd4"
            model.save(run, ball())
            size = sum(path.stat().st_size for path in run.rglob("*") if path.is_file())
            start = time.process_time()
            source = f"teacher:{run}?size=120x120&background=white"
            command("train", source, "-o", made, "--preset", "tiny", "--iterations", ITERATIONS)
            command("encode", made, "-o", packed)
            quality = command("eval", packed, source)["levels"][-1]["mpsnr"]
            minutes = (time.process_time() - start) / 60
            print(f"| {name} | {size:,} | {packed.stat().st_size:,} | {quality:.2f} | {minutes:.1f} |", flush=True)


if __name__ == "__main__":
    main()
