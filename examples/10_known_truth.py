"""10  A medium whose transmittance is known, three ways: a Gaussian cloud by closed form, data_synth and an octree.

    python examples/10_known_truth.py [SIGMA]

At distance b from the middle a ray has the optical depth sigma s sqrt(2 pi) exp(-b^2 / 2 s^2), s the standard deviation.
"""

import sys

import numpy as np

import nerfvol
from data_synth import media
from data_synth.transmittance import sample_transmittance
from nerfvol.kernels import ops
from nerfvol.octree.rows import explin_inverse

sigma, s = float([*sys.argv, 4.0][1]), 0.2  # 1 / scene unit in the middle; scene units
edge = np.arange(-1, 1 + 1 / 64, 1 / 32)
gauss = np.exp(-(edge[:, None, None] ** 2 + edge[:, None] ** 2 + edge**2) / (2 * s * s)).astype(np.float32)
medium = media.grid(gauss, (-1, -1, -1), (1, 1, 1), sigma_t=sigma)

n = 64  # the same density in an octree: 64^3 leaves of level 6, values at their corners
ijk = np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), -1).reshape(-1, 3)
octree = nerfvol.Octree.from_leaves(np.full(n**3, 6), ijk, (-1, -1, -1), 2.0, sh_degree=0, density_scale=1.0)
density = sigma * np.exp(-(octree.vertex_positions() ** 2).sum(1) / (2 * s * s))
octree.density = explin_inverse(np.maximum(density, 1e-9))  # raw density: what the file and the optimiser hold
print("distance  closed form  data_synth, march  data_synth, ratio tracking   octree")
for b in np.linspace(0, 0.5, 6):
    exact = np.exp(-sigma * s * np.sqrt(2 * np.pi) * np.exp(-b * b / (2 * s * s)))
    o, d = np.array([-2.0, 0.003, b]), np.array([1.0, 0.0, 0.0])
    march = sample_transmittance(medium, o, d, method="march").mean()
    ratio = sample_transmittance(medium, o, d, method="ratio", n=20_000).mean()
    drawn = 1 - ops.render_rays(octree, o[None], d[None], early_stop_eps=0.0, outputs=("opacity",))["opacity"][0]
    print(f"{b:8.1f}  {exact:11.4f}  {march:17.4f}  {ratio:26.4f}  {drawn:7.4f}")
