"""A compiled field with the space that it fills: what is drawn, and what distilling evaluates."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from nerfvol.kernels import field_ops
from nerfvol.kernels.field_state import FieldState, Float, March
from nerfvol.sh import eval_colour

if TYPE_CHECKING:
    from nerfvol.cameras.camera import Camera


EARLY_STOP = 1e-3
"""Transmittance below which a ray ends, in training and where a picture is not asked for more exactly."""


class CompiledField:
    """A field that is empty where its occupancy grid says so, as it was in training; a PointField and more.

    The rest of it is whatever the network happens to hold in space that training skips. Points in skipped cells cost nothing.
    """

    def __init__(self, state: FieldState, march: March, background: Sequence[float]) -> None:
        self.state, self.march, self.background = state, march, tuple(background)
        self.has_sh = state.shape.head == "sh"
        self.sh_degree = state.shape.sh_degree if self.has_sh else 0

    def picture(self, camera: Camera) -> np.ndarray:
        """(height, width, 3) float32 as ``camera`` sees it, clipped to [0, 1]."""
        return self.render(camera, self.background)["rgb"].clip(0, 1)

    def render(
        self,
        camera: Camera,
        background: Sequence[float],
        outputs: Sequence[str] = ("rgb",),
        early_stop_eps: float = EARLY_STOP,
    ) -> dict[str, Float]:
        """One view, see field_ops.render_rays: float32 (H, W, 3) or (H, W) for each of ``outputs``; rgb is not clipped."""
        origin, directions = camera.rays()
        directions = directions.reshape(-1, 3)
        origins = np.broadcast_to(np.asarray(origin, np.float32), directions.shape)
        out = field_ops.render_rays(self.state, origins, directions, self.march, background, early_stop_eps, outputs)
        size = camera.intrinsics.height, camera.intrinsics.width
        return {name: array.reshape(*size, *array.shape[1:]) for name, array in out.items()}

    def evaluate(self, positions: Float, values: bool = True) -> tuple[Float, Float | None]:
        """sigma (n,) in 1/u at scene positions (n, 3) and, with ``values``, SH coefficients (n, 3, K); numpy arrays.

        Raises:
            ValueError: values are wanted of a field with an rgb head, which has no coefficients.
        """
        if values and not self.has_sh:
            raise ValueError("this field has a view-dependent rgb head: it has no SH coefficients to give")
        return field_ops.evaluate(self.state, positions, where=self.march, values=values)

    def density(self, positions: Float) -> Float:
        """(n, 3) -> sigma (n,) in 1/u."""
        return self.evaluate(positions, values=False)[0]

    def sh(self, positions: Float) -> tuple[Float, Float]:
        """(n, 3) -> sigma (n,), sh (n, 3, (sh_degree + 1)**2); ValueError unless the field has the SH head."""
        sigma, values = self.evaluate(positions)
        assert values is not None
        return sigma, values

    def __call__(self, positions: Float, viewdirs: Float) -> tuple[Float, Float]:
        """(n, 3), (n, 3) unit -> sigma (n,), rgb (n, 3)."""
        if self.has_sh:
            sigma, sh = self.sh(positions)
            return sigma, eval_colour(sh, viewdirs)
        sigma, colour = field_ops.evaluate(self.state, positions, np.ascontiguousarray(viewdirs), self.march)
        assert colour is not None  # directions were given
        return sigma, colour
