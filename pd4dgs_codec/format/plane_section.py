"""The planes section of mode ans: the residuals of all plane channels as they are, or split by their activity.

Byte 0 is the form. Form 0: the rest is one channels payload of all channels, plane by plane. Form 1: stages. Stage 0
holds channels 0 and 1 of every plane, stage s >= 1 channels 2^s .. 2^(s+1) - 1, as far as there are such. A block of
one varint C in 1..8 per stage from 1 on comes first: in that stage each channel is split into C classes of cells by the
relative magnitudes (`stages.Activity`) of the plane's earlier channels, summed over the 3 x 3 cells around,
the border repeated. In a stage, planes come in order, then channels, then classes, each with its cells row by row.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import accumulate

import numpy as np

from pd4dgs_codec.entropy.channels import decode_joined
from pd4dgs_codec.entropy.varint import ByteReader, put_varint
from pd4dgs_codec.errors import UnsupportedFeature
from pd4dgs_codec.format.stages import (
    PLAIN,
    STAGED,
    Activity,
    CodedSection,
    Group,
    Places,
    activity_classes,
    cheapest_class_count,
    coded_stages,
    parts_of,
    read_class_count,
    read_stages,
    smaller_form,
)

Shape = tuple[int, int, int]  #: channels, rows, columns


def write_planes(residuals: Sequence[np.ndarray], priors: str, effort: int) -> tuple[bytes, float]:
    """(section bytes, sum of R(a) over all channels) of residuals int32 [C, H, W] per plane, in the smaller form."""
    channels = [channel.ravel() for plane in residuals for channel in plane]
    section, rate_bits = smaller_form(lambda: channels, lambda: _write_staged(residuals, effort), priors, effort)
    return section.data, rate_bits


def read_planes(data: bytes, shapes: Sequence[Shape]) -> list[np.ndarray]:
    """Residuals int32 [C, H, W] per plane; the inverse of write_planes. shapes were checked against the limits."""
    reader = ByteReader(data)
    form = reader.byte("the form of the planes")
    if form == PLAIN:
        symbols = decode_joined(reader.rest(), [h * w for c, h, w in shapes for _ in range(c)])
        ends = accumulate(c * h * w for c, h, w in shapes)
        return [symbols[end - c * h * w : end].reshape(c, h, w) for (c, h, w), end in zip(shapes, ends, strict=True)]
    if form != STAGED:
        raise UnsupportedFeature(f"form {form} of the planes, expected {PLAIN} or {STAGED}")
    number = _stage_count(shapes)
    counts = [read_class_count(reader, stage) for stage in range(1, number)]
    planes = [np.zeros((c, h * w), np.int32) for c, h, w in shapes]
    read_stages(reader, number, _groups(planes, shapes, counts))
    return [plane.reshape(shape) for plane, shape in zip(planes, shapes, strict=True)]


def _write_staged(residuals: Sequence[np.ndarray], effort: int) -> CodedSection:
    shapes: list[Shape] = [plane.shape for plane in residuals]
    planes = [plane.reshape(len(plane), -1) for plane in residuals]
    counts, activities = [], [Activity(plane.shape[1]) for plane in planes]
    for stage in range(_stage_count(shapes)):
        first, end = _bounds(stage)
        if stage:
            groups = [
                (plane[first:end], _around(activity.now, shape))
                for plane, activity, shape in zip(planes, activities, shapes, strict=True)
            ]
            counts.append(cheapest_class_count(groups))
        for plane, activity in zip(planes, activities, strict=True):
            activity.add(plane[first:end])
    out = bytearray([STAGED])
    for count in counts:
        put_varint(out, count)
    return coded_stages(out, map(parts_of, _groups(planes, shapes, counts)), effort)


def _stage_count(shapes: Sequence[Shape]) -> int:
    """All planes of a layer have the same number of channels."""
    return max(1, (shapes[0][0] - 1).bit_length())


def _bounds(stage: int) -> tuple[int, int]:
    """Its first channel, and that of the next stage."""
    return (1 << stage if stage else 0), 2 << stage


def _groups(planes: Sequence[np.ndarray], shapes: Sequence[Shape], counts: Sequence[int]) -> Iterator[list[Group]]:
    """Per stage, what it codes of each plane. `planes` int32 [C, H * W] are read only as far as the stages before
    reach."""
    activities = [Activity(plane.shape[1]) for plane in planes]
    for stage, count in enumerate((1, *counts)):
        first, end = _bounds(stage)
        groups: list[Group] = []
        for plane, activity, shape in zip(planes, activities, shapes, strict=True):
            places = Places.whole(plane.shape[1])
            if count > 1:
                places = Places.by(activity_classes(_around(activity.now, shape), count), count)
            groups.append((plane[first:end], places))
        yield groups
        if any(later > 1 for later in counts[stage:]):
            for plane, activity in zip(planes, activities, strict=True):
                activity.add(plane[first:end])


def _around(activity: np.ndarray, shape: Shape) -> np.ndarray:
    """[H * W]: activity [H * W] summed over 3 x 3 cells, the border repeated."""
    _, height, width = shape
    cells = activity.reshape(height, width)
    around: np.ndarray = _of_three(_of_three(cells).T).T.ravel()
    return around


def _of_three(cells: np.ndarray) -> np.ndarray:
    """[H, W]: each cell with the one before and the one behind it in its row, the first and the last repeated."""
    sums: np.ndarray = cells.copy(order="K")
    sums[:, 1:] += cells[:, :-1]
    sums[:, :-1] += cells[:, 1:]
    sums[:, 0] += cells[:, 0]
    sums[:, -1] += cells[:, -1]
    return sums
