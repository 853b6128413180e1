"""How good a preparation is: numbers, a page of pictures, and what to record better."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pd4dgs_codec.prepare.frames import Choice, Look
from pd4dgs_codec.prepare.moving import Verdicts

#: Where advice begins: share of frames, pixels of a picture 1000 wide, points a picture, degrees, share of features.
MANY_BLURRED, MANY_LOST, LARGE_ERROR, FEW_POINTS, SMALL_ANGLE, MUCH_MOVES = 0.2, 0.05, 2.0, 50, 4.0, 0.4
#: Points whose angles are looked at, and pictures that the page shows.
POINTS, SHOWN = 2000, 6


@dataclass(frozen=True)
class Findings:
    """What the last stage found. model: a pycolmap.Reconstruction; verdicts and moving (bool [n]): of the features of
    each picture that has a pose, by its name."""

    model: Any
    verdicts: Mapping[str, Verdicts]
    moving: Mapping[str, np.ndarray]


def numbers(findings: Findings, looks: Sequence[Look], choice: Choice, times: Mapping[str, float]) -> dict[str, Any]:
    """The report as JSON holds it. Errors are in pixels of the pictures as written."""
    model = findings.model
    registered = {image.name: image for image in model.images.values() if image.has_pose}
    errors = _errors(model)
    camera = next(iter(model.cameras.values()))
    features = sum(map(len, findings.moving.values()))
    rows = []
    for name in sorted(times):
        row: dict[str, Any] = {"name": name, "seconds": times[name], "pose": name in registered}
        if name in registered:
            row |= {
                "points": registered[name].num_points3D,
                "reprojection_error": errors.get(registered[name].image_id),
            }
            row["moving_features"] = int(findings.moving[name].sum()) if name in findings.moving else 0
        rows.append(row)
    return {
        "frames": {
            "seen": len(looks),
            "blurred": len(choice.blurred),
            "repeated": len(choice.repeated),
            "chosen": len(choice.chosen),
            "registered": len(registered),
        },
        "seconds": looks[-1].time - looks[0].time,
        "camera": {
            "model": camera.model.name,
            "width": camera.width,
            "height": camera.height,
            "parameters": dict(zip(camera.params_info.split(", "), camera.params.tolist(), strict=True)),
        },
        "points": model.num_points3D(),
        "reprojection_error": float(model.compute_mean_reprojection_error()),
        "points_per_picture": float(np.median([image.num_points3D for image in registered.values()])),
        "angle_degrees": _angle(model),
        "moving_share": sum(int(each.sum()) for each in findings.moving.values()) / features if features else 0.0,
        "pictures": rows,
    }


def _errors(model: Any) -> dict[int, float]:
    """Mean reprojection error of each picture's points, pixels, by the picture's number."""
    errors = {}
    for image in model.images.values():
        seen = [point for point in image.points2D if point.has_point3D()] if image.has_pose else []
        if not seen:
            continue
        world = np.array([model.point3D(point.point3D_id).xyz for point in seen])
        camera, pose = model.camera(image.camera_id), image.cam_from_world().matrix()
        places = camera.img_from_cam(world @ pose[:, :3].T + pose[:, 3])
        gaps = places - np.array([point.xy for point in seen])
        errors[image.image_id] = float(np.nanmean(np.hypot(gaps[:, 0], gaps[:, 1])))
    return errors


def _angle(model: Any) -> float:
    """Median over points of the widest angle between two of the rays that see them, degrees."""
    centers = {key: model.image(key).projection_center() for key in model.reg_image_ids()}
    angles = []
    points = list(model.points3D.values())
    for point in points[:: max(1, len(points) // POINTS)]:
        rays = np.array([centers[each.image_id] for each in point.track.elements]) - point.xyz
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
        angles.append(float(np.degrees(np.arccos(np.clip(rays @ rays.T, -1, 1).min()))))
    return float(np.median(angles)) if angles else 0.0


def advice(report: Mapping[str, Any]) -> list[str]:
    """What to record better, a line each; none where nothing was found."""
    lines, frames = [], report["frames"]
    if frames["blurred"] > MANY_BLURRED * frames["seen"]:
        lines.append(f"{frames['blurred']} of {frames['seen']} frames are blurred: move slower, or with more light")
    lost = [row for row in report["pictures"] if not row["pose"]]
    if len(lost) > MANY_LOST * frames["chosen"]:
        span = f"between {lost[0]['seconds']:.1f} and {lost[-1]['seconds']:.1f} s"
        lines.append(f"{len(lost)} of {frames['chosen']} frames have no pose, {span}: turn and move slower there")
    error = report["reprojection_error"]
    if error * 1000 > LARGE_ERROR * report["camera"]["width"]:
        lines.append(f"reprojection error {error:.2f} pixels: lock zoom and focus, and switch stabilisation off")
    if report["points_per_picture"] < FEW_POINTS:
        found = f"{report['points_per_picture']:.0f} points in a picture"
        lines.append(f"{found}: have things with texture that stand still around what moves")
    if report["angle_degrees"] < SMALL_ANGLE:
        found = f"points are seen under {report['angle_degrees']:.1f} degrees"
        lines.append(f"{found}: walk around the scene, turning on the spot shows no depth")
    if report["moving_share"] > MUCH_MOVES:
        found = f"{100 * report['moving_share']:.0f} % of the features move"
        lines.append(f"{found}: stand back, so that more of the picture stands still")
    return lines


def draw(
    findings: Findings, looks: Sequence[Look], choice: Choice, times: Mapping[str, float], images: Path, path: Path
) -> None:
    """The page: the camera's path from above, error and points per picture, sharpness, and pictures with what was
    found to stand still in green and to move in red."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from PIL import Image

    model = findings.model
    images_by_name = {image.name: image for image in model.images.values() if image.has_pose}
    order = sorted(images_by_name)
    figure = pyplot.figure(figsize=(13, 11))
    top = figure.add_subplot(3, 3, 1)
    points = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    centers = np.array([images_by_name[name].projection_center() for name in order])
    low, high = np.percentile(np.concatenate([points, centers]), [1, 99], axis=0)
    top.plot(points[:, 0], points[:, 2], ",", color="grey")
    top.plot(centers[:, 0], centers[:, 2], ".-", color="tab:blue", markersize=3)
    span = 0.6 * max((high - low)[[0, 2]])
    middle = (low + high) / 2
    top.set(xlim=(middle[0] - span, middle[0] + span), ylim=(middle[2] - span, middle[2] + span), aspect="equal")
    top.set_title("camera path and points, from above")
    errors = _errors(model)
    left = figure.add_subplot(3, 3, 2)
    left.plot([times[n] for n in order], [errors.get(images_by_name[n].image_id, np.nan) for n in order], ".-")
    left.set(title="reprojection error, pixels", xlabel="seconds")
    right = figure.add_subplot(3, 3, 3)
    right.semilogy([each.time for each in looks], [each.sharpness for each in looks], color="grey")
    right.semilogy([looks[i].time for i in choice.chosen], [looks[i].sharpness for i in choice.chosen], "g.")
    right.semilogy([looks[i].time for i in choice.blurred], [looks[i].sharpness for i in choice.blurred], "rx")
    right.set(title="sharpness; green: chosen, red: blurred", xlabel="seconds")
    for k, at in enumerate(np.linspace(0, len(order) - 1, SHOWN).round().astype(int)):
        name = order[at]
        axis = figure.add_subplot(3, 3, 4 + k)
        with Image.open(images / name) as picture:
            axis.imshow(picture)
        if name in findings.verdicts:
            verdicts, moves = findings.verdicts[name], findings.moving[name]
            places = verdicts.places
            axis.plot(*places[~moves & verdicts.known].T, ",", color="lime")
            axis.plot(*places[moves].T, ".", color="red", markersize=3)
        axis.set_title(f"{times[name]:.2f} s", fontsize=8)
        axis.axis("off")
    figure.tight_layout()
    figure.savefig(path, dpi=100)
    pyplot.close(figure)
