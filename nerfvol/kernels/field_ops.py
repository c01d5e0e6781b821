"""The operators on compiled fields, on numpy arrays: argument checks around the kernels.

What is computed: ``field_reference``, which has the same functions in torch. Threads and instruction sets are those of ``ops``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from nerfvol.kernels.checks import check_background, check_early_stop
from nerfvol.kernels.field_state import (
    FieldBatch,
    FieldLoss,
    FieldRates,
    FieldState,
    FieldStepReport,
    March,
    Occupancy,
)
from nerfvol.native import native

if TYPE_CHECKING:
    from nerfvol.config.field import FieldShape

__all__ = [
    "FieldBatch", "FieldLoss", "FieldRates", "FieldState", "FieldStepReport", "March", "Occupancy", "evaluate",
    "loss_gradient", "march_rays", "refusal", "render_rays", "train_step",
]  # fmt: skip

Float = NDArray[np.float32]
OUTPUTS = ("rgb", "opacity", "depth")


def refusal(shape: FieldShape) -> str | None:
    """Why the kernels cannot hold a field of this shape; None: they can."""
    if native() is None:
        return "the kernels are not compiled"
    if shape.encoding == "hash" and shape.hash_features not in (1, 2, 4, 8):
        return f"an entry of the grid holds 1, 2, 4 or 8 features, not {shape.hash_features}"
    if shape.encoding == "hash" and (shape.hash_levels > 16 or shape.finest > 1 << 19):
        return "a grid has at most 16 levels of at most 2^19 cells"
    if max(shape.n_frequencies, shape.n_frequencies_dir) > 16:
        return "encodings have at most 16 frequencies"
    if shape.depth > 8 or shape.width > 1000:
        return f"a network has at most 8 layers of at most 1000 neurons, not {shape.depth} of {shape.width}"
    return None


def _settings(made: Any, given: FieldLoss | FieldRates) -> Any:
    """``given`` as the kernels' class, field by field."""
    for name, value in vars(given).items():
        setattr(made, name, check_background(value) if name == "background" else float(value))
    return made


def _check_loss(loss: FieldLoss) -> Any:
    check_background(loss.background)
    check_early_stop(loss.early_stop_eps)
    weights = (loss.colour, loss.distortion, loss.entropy, loss.negligible)
    if not np.isfinite(weights).all() or min(weights) < 0:
        raise ValueError(f"weights of the loss must be finite and not negative, got {loss}")
    compiled = native()
    assert compiled is not None
    return _settings(compiled.FieldLoss(), loss)


def _check_rates(rates: FieldRates) -> Any:
    numbers = list(vars(rates).values())
    if not np.isfinite(numbers).all() or min(numbers) < 0:
        raise ValueError(f"rates must be finite and not negative, got {rates}")
    if not (rates.beta1 < 1 and 0 < rates.beta2 < 1):
        raise ValueError(f"Adam needs 0 <= beta1 < 1 and 0 < beta2 < 1, got {rates.beta1}, {rates.beta2}")
    compiled = native()
    assert compiled is not None
    return _settings(compiled.FieldRates(), rates)


def rows_of_three(name: str, array: Any, n: int | None = None) -> Float:
    """``array`` (n, 3) as contiguous float32; ValueError where it has another shape."""
    a = np.ascontiguousarray(array, np.float32)
    if a.ndim != 2 or a.shape[1] != 3 or n not in (None, len(a)):
        raise ValueError(f"{name} must be ({'n' if n is None else n}, 3), got {a.shape}")
    return a


def _check_batch(batch: FieldBatch) -> tuple[Float, ...]:
    o = rows_of_three("rays_o", batch.rays_o)
    d, target = rows_of_three("rays_d", batch.rays_d, len(o)), rows_of_three("target", batch.target, len(o))
    jitter = np.ascontiguousarray(batch.jitter, np.float32)
    if jitter.shape != (len(o),):
        raise ValueError(f"jitter must be ({len(o)},), got {jitter.shape}")
    if not len(o):
        raise ValueError("a step needs at least one ray")
    return o, d, jitter, target


def train_step(
    state: FieldState,
    batch: FieldBatch,
    march: March,
    loss: FieldLoss,
    rates: FieldRates,
    moves: Sequence[bool] | None = None,
) -> FieldStepReport:
    """One step on ``state`` in place. Bitwise the same for any number of threads.

    moves: for each level of the grid whether Adam moves it in this step; where it does not, the gradient is kept and added to
    the next step's. None: all. Raises ValueError where an argument is not what it should be.
    """
    given = [True] * state.n_levels if moves is None else list(moves)
    if len(given) != state.n_levels:
        raise ValueError(f"moves must have {state.n_levels} entries, one a level, got {len(given)}")
    return _step(state, batch, march, loss, rates, np.array(given, np.uint8))


def loss_gradient(
    state: FieldState, batch: FieldBatch, march: March, loss: FieldLoss
) -> tuple[Float, Float, FieldStepReport]:
    """Gradients of the loss in table (entries, features) and network (n,); changes nothing but ``state``'s own gradients, which
    are zero afterwards."""
    state.table_gradient[...] = 0
    report = _step(state, batch, march, loss, FieldRates(), None)
    table, network = state.table_gradient.copy(), state.network_gradient.copy()
    state.table_gradient[...] = 0
    state.network_gradient[...] = 0
    return table, network, report


def _step(
    state: FieldState,
    batch: FieldBatch,
    march: March,
    loss: FieldLoss,
    rates: FieldRates,
    moves: NDArray[np.uint8] | None,
) -> FieldStepReport:
    rays, terms, adam = _check_batch(batch), _check_loss(loss), _check_rates(rates)
    compiled = native()
    assert compiled is not None
    table, network = (
        [state.array(name + part) for part in ("", "_first", "_second", "_gradient")] for name in ("table", "network")
    )
    shape = state.kernel_shape
    r = compiled.field_step(shape, *rays, march.kernel, terms, adam, table, network, state.updates, moves)
    return FieldStepReport(r.loss, r.squared_error, r.samples, r.used)


def render_rays(
    state: FieldState,
    rays_o: Float,
    rays_d: Float,
    march: March,
    background: Sequence[float],
    early_stop_eps: float = 1e-3,
    outputs: Sequence[str] = OUTPUTS,
) -> dict[str, Float]:
    """Draws rays (n, 3), directions unit: rgb (n, 3) over ``background``, not clipped, opacity (n,), expected depth (n,), u.

    Raises ValueError where an argument is not what it should be.
    """
    o = rows_of_three("rays_o", rays_o)
    d = rows_of_three("rays_d", rays_d, len(o))
    if unknown := set(outputs) - set(OUTPUTS):
        raise ValueError(f"outputs must be among {OUTPUTS}, got {sorted(unknown)}")
    red, green, blue = check_background(background)
    terms = _check_loss(FieldLoss((red, green, blue), early_stop_eps=early_stop_eps))
    compiled = native()
    assert compiled is not None
    out = {k: np.empty((len(o), 3) if k == "rgb" else len(o), np.float32) for k in OUTPUTS if k in outputs}
    arrays = (state.array("table"), state.array("network"))
    shape = state.kernel_shape
    compiled.field_render(shape, *arrays, o, d, march.kernel, terms, *(out.get(name) for name in OUTPUTS))
    return out


def evaluate(
    state: FieldState,
    positions: Float,
    viewdirs: Float | None = None,
    where: March | None = None,
    values: bool = True,
) -> tuple[Float, Float | None]:
    """sigma (n,) in 1/u at scene positions (n, 3); and, with ``values``, SH coefficients (n, 3, K), or with an rgb head colours
    (n, 3) along ``viewdirs`` (n, 3).

    where: points outside its occupied cells are empty, their values zero. Raises ValueError where an argument does not fit.
    """
    x = rows_of_three("positions", positions)
    with_sh = state.shape.head == "sh"
    dirs = None if viewdirs is None or with_sh else rows_of_three("viewdirs", viewdirs, len(x))
    if values and not with_sh and dirs is None:
        raise ValueError("a field with an rgb head needs viewdirs")
    compiled = native()
    assert compiled is not None
    count = 3 * (state.shape.sh_degree + 1) ** 2 if with_sh else 3
    sigma = np.empty(len(x), np.float32)
    rows = np.empty((len(x), count), np.float32) if values else None
    arrays = (state.array("table"), state.array("network"))
    cells = None if where is None else where.kernel
    compiled.field_evaluate(state.kernel_shape, *arrays, x, dirs, cells, sigma, rows)
    return sigma, rows if rows is None or not with_sh else rows.reshape(len(x), 3, -1)


def march_rays(state: FieldState, batch: FieldBatch, march: March) -> NDArray[np.bool_]:
    """(n, steps) which steps of each ray are looked at."""
    o, d, jitter, _ = _check_batch(batch)
    compiled = native()
    assert compiled is not None
    steps = len(march.edges) - 1
    bits = np.empty((len(o), -(-steps // 64)), np.uint64)
    compiled.field_march(state.kernel_shape, o, d, jitter, march.kernel, bits)
    return np.unpackbits(bits.view(np.uint8), axis=1, bitorder="little")[:, :steps].astype(bool)
