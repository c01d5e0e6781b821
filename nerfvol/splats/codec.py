"""Compact storage of splats: quantised, decorrelated, predicted, deflated; about a quarter of the bytes of float32.

Splats are put in Morton order, so that neighbours in the file are neighbours in space, and every number becomes a 16-bit
code of a channel, packed as an octree's (octree/codec.py). Channels, in this order:

- 0-2: means, asinh((mean - middle) / extent) / POSITION_STEP divided by 256 and rounded down; 3-5: what is left, 0..255.
  Fine in the middle of a scene, relative far outside; middle and extent are those of most splats.
- 6-8: log-scales / SCALE_STEP; 9-11: rotation vectors (axis times angle, at most pi) / ROTATION_STEP; 12: logits / LOGIT_STEP.
- 13 + axis K + k: colour coefficient k of grey, red-blue and green-magenta / DC_STEP (k = 0) or SH_STEP.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nerfvol.errors import shown
from nerfvol.octree.codec import TO_GREY, Bytes, pack_codes, plane_name, round_codes, unpack_codes
from nerfvol.octree.topology import morton
from nerfvol.splats.points import Y00
from nerfvol.splats.splats import Splats

POSITION_STEP = 2.0**-16
FINE = 256
SCALE_STEP = 1 / 24
ROTATION_STEP = 1 / 96
LOGIT_STEP = 1 / 16
LARGEST_LOGIT = 12.0
DC_STEP = 1 / 128 / Y00
SH_STEP = 1 / 48 / Y00
COLOURS = 13
"""The first channel of a colour."""
_NUMBERS = ("position_step", "extent", "scale_step", "rotation_step", "logit_step", "dc_step", "sh_step")


def n_channels(basis: int) -> int:
    """Channels of splats with ``basis`` coefficients a colour channel."""
    return COLOURS + 3 * basis


def encode(splats: Splats) -> tuple[dict[str, Bytes], dict[str, Any]]:
    """Byte planes by name, and the JSON-able parameters that :func:`decode` needs. The order of the splats changes."""
    means = splats.means.astype(np.float64)
    low, high = (np.quantile(means, q, axis=0) for q in (0.1, 0.9)) if splats.n else (np.zeros(3), np.ones(3))
    # rounded, so that what was decoded is encoded to the same codes
    extent = 2.0 ** np.rint(np.log2(max(float((high - low).max()) / 2, 1e-9)))
    middle = np.rint((low + high) / 2 / extent * 4) * extent / 4
    curve = np.arcsinh((means - middle) / extent) / POSITION_STEP
    position = np.clip(np.rint(curve), -(1 << 22), (1 << 22) - 1).astype(np.int64)
    order = np.argsort(morton((position >> 3) + (1 << 19)), kind="stable")
    position, part = position[order], splats.select(order)
    grey = np.einsum("ac,nck->ank", TO_GREY, part.sh)
    steps = np.where(np.arange(part.sh.shape[2]) == 0, DC_STEP, SH_STEP).astype(np.float32)
    columns = [
        *(position // FINE).T, *(position % FINE).T, *(part.log_scales / SCALE_STEP).T,
        *_rotation_codes(part.quats).T,
        np.clip(part.logits, -LARGEST_LOGIT, LARGEST_LOGIT) / LOGIT_STEP,
        *(grey / steps).transpose(0, 2, 1).reshape(3 * len(steps), part.n),
    ]  # fmt: skip
    packed = [pack_codes(round_codes(np.asarray(column))) for column in columns]
    parameters = {
        "position_step": POSITION_STEP, "middle": middle.tolist(), "extent": float(extent), "scale_step": SCALE_STEP,
        "rotation_step": ROTATION_STEP, "logit_step": LOGIT_STEP, "dc_step": float(DC_STEP), "sh_step": float(SH_STEP),
        "differences": [int(differences) for differences, _ in packed],
    }  # fmt: skip
    names = [
        (plane_name(i, plane), data)
        for i, (_, pair) in enumerate(packed)
        for plane, data in zip(("low", "high"), pair, strict=True)
    ]
    return {name: np.frombuffer(data, np.uint8) for name, data in names}, parameters


def decode(
    n: int, basis: int, read: Callable[[str], Bytes], parameters: Mapping[str, Any]
) -> dict[str, NDArray[np.float32]]:
    """means, log_scales, quats, logits and sh of ``n`` splats by name; ``read`` gives a byte plane by name.

    Raises:
        ValueError: the parameters or a plane are not what :func:`encode` writes (the message says which).
    """
    step = {name: _number(parameters, name) for name in _NUMBERS}
    differences, middle = parameters.get("differences"), parameters.get("middle")
    if not isinstance(differences, list) or len(differences) != n_channels(basis):
        raise ValueError(f"its codec parameter 'differences' is not a list of {n_channels(basis)}")
    if (
        not isinstance(middle, list)
        or len(middle) != 3
        or not all(type(x) in (int, float) and abs(x) < 1e15 for x in middle)
    ):
        raise ValueError("its codec parameter 'middle' is not a list of three numbers")

    def channel(index: int) -> NDArray[np.float32]:
        planes = [read(plane_name(index, plane)) for plane in ("low", "high")]
        return unpack_codes(index, planes, n, bool(differences[index])).astype(np.float32)

    means = np.empty((n, 3), np.float32)
    for axis in range(3):
        curve = (channel(axis) * np.float32(FINE) + channel(3 + axis)) * np.float32(step["position_step"])
        means[:, axis] = middle[axis] + step["extent"] * np.sinh(np.clip(curve, -80, 80))
    grey = np.stack([channel(COLOURS + i) for i in range(3 * basis)]).reshape(3, basis, n)
    grey *= np.where(np.arange(basis) == 0, step["dc_step"], step["sh_step"]).astype(np.float32)[:, None]
    return {
        "means": means,
        "log_scales": np.stack([channel(6 + i) for i in range(3)], 1) * np.float32(step["scale_step"]),
        "quats": quaternions(np.stack([channel(9 + i) for i in range(3)], 1) * np.float32(step["rotation_step"])),
        "logits": channel(12) * np.float32(step["logit_step"]),
        "sh": np.ascontiguousarray(np.einsum("ac,akn->nck", TO_GREY, grey)),
    }


def _rotation_codes(quats: NDArray[np.float32]) -> NDArray[np.float64]:
    """Rounded to nearest, but never to more than half a turn, which would be another vector's."""
    exact = rotation_vectors(quats) / ROTATION_STEP
    codes = np.rint(exact)
    beyond = np.linalg.norm(codes, axis=1) * ROTATION_STEP > np.pi
    return np.where(beyond[:, None], np.trunc(exact), codes)


def rotation_vectors(quats: NDArray[np.float32]) -> NDArray[np.float64]:
    """Axis times angle (n, 3), at most pi long, of quaternions (n, 4) of any length."""
    q = quats.astype(np.float64)
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    q = np.where(q[:, :1] < 0, -q, q)
    sine = np.linalg.norm(q[:, 1:], axis=1, keepdims=True)
    return q[:, 1:] * np.where(sine > 1e-12, 2 * np.arctan2(sine, q[:, :1]) / np.maximum(sine, 1e-12), 2.0)


def quaternions(vectors: NDArray[np.floating]) -> NDArray[np.float32]:
    """The inverse: unit quaternions (n, 4)."""
    angle = np.linalg.norm(vectors.astype(np.float64), axis=1, keepdims=True)
    sine = np.where(angle > 1e-6, np.sin(angle / 2) / np.maximum(angle, 1e-6), 0.5)
    return np.concatenate([np.cos(angle / 2), vectors * sine], axis=1).astype(np.float32)


def _number(parameters: Mapping[str, Any], name: str) -> float:
    value = parameters.get(name)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 1e-12 < value < 1e12:
        raise ValueError(f"its codec parameter {name!r} is {shown(value)}, expected a positive number")
    return float(value)
