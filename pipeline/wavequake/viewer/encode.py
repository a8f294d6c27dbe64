"""Numbers of a film as text of a page: 16-bit integers with a scale, packed, with a check sum."""

import json
import zlib
from base64 import b64encode
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavequake.viewer.film import Array, Film, Stage, Take, displacements
from wavequake.words import printable

LIMIT = 10_000_000  # bytes of a page
DECADES = 4.0
SHOWN = 0.02  # of the size of a stage: how far the largest displacement is drawn


@dataclass
class Blocks:
    """Packed arrays by name; equal ones are kept once."""

    texts: dict[str, str] = field(default_factory=dict)
    names: dict[str, str] = field(default_factory=dict)

    def add(self, values: NDArray[Any], dtype: str, scale: Array | float = 1.0) -> dict[str, Any]:
        """Keep an array and return how a page finds and reads it."""
        raw = np.ascontiguousarray(values, dtype=np.dtype(dtype).newbyteorder("<")).tobytes()
        packed = b64encode(zlib.compress(raw, 9)).decode()
        name = self.names.setdefault(packed, f"b{len(self.texts)}")
        self.texts[name] = packed
        return {
            "id": name,
            "dtype": dtype,
            "shape": list(values.shape),
            "scale": np.atleast_1d(np.asarray(scale, dtype=np.float64)).tolist(),
            "crc32": zlib.crc32(raw),
        }

    def add_scaled(self, values: Array) -> dict[str, Any]:
        """Keep numbers as 16-bit integers, with a scale for each place of the last axis."""
        largest = np.nanmax(np.abs(values), axis=tuple(range(values.ndim - 1)), initial=0.0)
        scale = np.where(largest > 0.0, largest / 32767.0, 1.0)
        return self.add(np.rint(np.nan_to_num(values) / scale), "int16", scale)

    @property
    def size(self) -> int:
        """Characters."""
        return sum(map(len, self.texts.values()))


def encode(film: Film) -> tuple[str, Blocks]:
    """Return the description of a film as JSON, and its arrays.

    Where the page would be larger than 10 MB, every second image is left out, again and again, then the last
    takes; the description says so.
    """
    every, with_images = 1, any(take.images is not None for take in film.takes)
    stages, said, blocks = _fitting(film, every)
    while len(said) < len(film.takes) and with_images and every <= 16:
        every *= 2
        stages, said, blocks = _fitting(film, every)
    left_out = len(film.takes) - len(said)
    notes = [f"1 of {every} images is shown"] if every > 1 else []
    notes += [f"{left_out} of {len(film.takes)} cases did not fit into 10 MB"] if left_out else []
    record = {
        "title": film.title,
        "source": film.source,
        "notes": notes,
        "decades": DECADES,
        "stages": stages,
        "takes": said,
    }
    return json.dumps(_shown(record), separators=(",", ":"), ensure_ascii=True).replace(
        "<", "\\u003c"
    ), blocks


def _fitting(film: Film, every: int) -> tuple[list[dict[str, Any]], list[dict[str, Any]], Blocks]:
    """Return stages of a film, its first takes that fit into a page, one at least, and their arrays."""
    blocks, said = Blocks(), list[dict[str, Any]]()
    stages = [_stage(stage, blocks) for stage in film.stages]
    for take in film.takes:
        before = Blocks(dict(blocks.texts), dict(blocks.names))
        one = _take(film.stages[take.stage], take, blocks, every)
        if said and blocks.size >= 0.96 * LIMIT:
            return stages, said, before
        said.append(one)
    return stages, said, blocks


def _shown(value: Any) -> Any:
    """Return a description with its texts printable."""
    if isinstance(value, dict):
        return {key: _shown(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_shown(one) for one in value]
    return printable(value) if isinstance(value, str) else value


def _stage(stage: Stage, blocks: Blocks) -> dict[str, Any]:
    palette = list(dict.fromkeys(stage.colors))
    return {
        "points": blocks.add(stage.points, "float32"),
        "faces": blocks.add(stage.faces, "int32"),
        "body": blocks.add(stage.body, "int32"),
        "palette": palette,
        "colors": blocks.add(np.array([palette.index(one) for one in stage.colors]), "int32"),
        "names": list(stage.names),
        "pivots": blocks.add(stage.pivots, "float32"),
        "axes": blocks.add(stage.axes.reshape(-1, 9), "float32"),
        "lines": [[color, np.round(points, 5).tolist()] for color, points in stage.lines],
        "labels": [[name, np.round(point, 5).tolist()] for name, point in stage.labels],
        "up": stage.up.tolist(),
        "terms": None if stage.terms is None else blocks.add_scaled(stage.terms),
    }


def _short(values: Array) -> list[list[float | None]]:
    """Return numbers to 5 digits, None for one that is not finite."""
    return [[float(f"{v:.5g}") if np.isfinite(v) else None for v in row] for row in values.tolist()]


def _take(stage: Stage, take: Take, blocks: Blocks, every: int) -> dict[str, Any]:
    moved = displacements(stage, take)
    largest = float(np.linalg.norm(moved, axis=2).max(initial=0.0))
    size = float(np.ptp(stage.points, axis=0).max()) if len(stage.points) else 0.0
    along = np.abs(np.einsum("tvi,vi->tv", moved, stage.axes[stage.body, :, 2])).max(initial=0.0)
    record: dict[str, Any] = {
        "label": take.label,
        "note": take.note,
        "stage": take.stage,
        "time": np.round(take.time, 9).tolist(),
        "largest": largest,
        "normal": bool(along > 1e-6 * largest),
        "factor": SHOWN * size / largest if largest > 0.0 else 0.0,
        "series": [
            {
                "name": name,
                "unit": unit,
                "values": _short(values),
            }
            for name, (unit, values) in take.series.items()
        ],
    }
    if take.poses is not None:
        used = [axis for axis in range(6) if np.any(take.poses[..., axis])]
        if used:
            record["dofs"], record["poses"] = used, blocks.add_scaled(take.poses[..., used])
    if take.figures is not None:
        record["figures"] = blocks.add_scaled(take.figures)
    if take.shapes is not None and take.weights is not None:
        record["shapes"] = blocks.add_scaled(take.shapes)
        record["weights"] = blocks.add(take.weights, "float32")
    if take.planes is not None:
        record["planes"] = blocks.add_scaled(take.planes)
    record["maps"] = [
        {
            "name": one.name,
            "unit": one.unit,
            "reach": one.reach,
            "cells": blocks.add(one.cells, "int16" if one.cells.max() < 32768 else "int32"),
            "shapes": blocks.add_scaled(one.shapes[..., None]),
            "weights": blocks.add(one.weights, "float32"),
        }
        for one in take.maps
    ]
    if take.track is not None:
        record["track"] = _short(take.track)
    if take.images is not None:
        shown = take.images[::every]
        top = float(np.nanmax(shown)) or 1.0
        with np.errstate(divide="ignore"):
            level = 1.0 + np.log10(np.maximum(np.nan_to_num(shown), 0.0) / top) / DECADES
        record["images"] = blocks.add(np.rint(255.0 * np.clip(level, 0.0, 1.0)), "uint8")
        record["every"], record["pixel"] = every, take.pixel
    return record
