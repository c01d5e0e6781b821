"""Distillation: an analytic field comes back with the error that interpolation predicts; topology, merging, pruning."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from nerfvol.cameras.camera import Intrinsics, orbit
from nerfvol.config.field import DistillConfig
from nerfvol.datasets.dataset import Dataset
from nerfvol.errors import InputError
from nerfvol.field.layout import Domain
from nerfvol.octree.rows import explin
from nerfvol.octree.tree import Octree
from nerfvol.region import SceneBounds
from nerfvol.starts.cells import EVERYWHERE, Frame, candidate_cells, dilated, finer_cells, largest_sigma
from nerfvol.starts.field import distill
from nerfvol.starts.values import REACH, WIDE_REACH, write_values
from nerfvol.starts.visible import ENOUGH_VIEWS, judged_downscale, largest_weights, needed, views_of_leaves
from nerfvol.views import render_image
from tests.fixtures.fields import CENTER, DOMAIN, Blob, full_octree, interpolate, random_points


def views(field: Blob, n: int = 6, size: int = 48) -> Dataset:
    lens = Intrinsics(size, size, 1.5 * size, 1.5 * size, size / 2, size / 2)
    cameras = orbit(n, center=DOMAIN.center, radius=3.0, elevation_deg=15, intrinsics=lens)
    images = [np.rint(field.image(camera, (1, 1, 1)) * 255).astype(np.uint8) for camera in cameras]
    low, high = DOMAIN.aabb.double().numpy()
    return Dataset(
        cameras, images, [f"v{i}" for i in range(n)], SceneBounds(np.stack([low, high]), None, False), "test"
    )


def black_views(n: int, size: int = 48) -> Dataset:
    """Views whose pictures show something everywhere, and take no time to make."""
    lens = Intrinsics(size, size, 1.5 * size, 1.5 * size, size / 2, size / 2)
    cameras = orbit(n, center=DOMAIN.center, radius=3.0, elevation_deg=15, intrinsics=lens)
    images, bounds = [np.zeros((size, size, 3), np.uint8) for _ in cameras], DOMAIN.aabb.double().numpy()
    return Dataset(cameras, images, [f"v{i}" for i in range(n)], SceneBounds(bounds, None, False), "test")


@pytest.mark.parametrize("reach", [0, REACH, WIDE_REACH])
def test_error_of_the_values_is_second_order(reach: float) -> None:
    """Halving the leaves divides the error of the coefficient by four; the linear colour is met at every size."""
    field, points, errors = Blob(), random_points(3000, 0.6), []
    truth_sigma, truth_sh = field.sh(points)
    levels = [3, 4, 5]
    for level in levels:
        octree = full_octree(level)
        write_values(octree, field, reach)
        _, sigma, coefficients = interpolate(octree, points)
        errors.append(np.sqrt(np.mean((sigma - truth_sigma) ** 2)))
        if not reach:
            np.testing.assert_allclose(coefficients, truth_sh, atol=1e-5)
    slope = -np.polyfit(levels, np.log2(errors), 1)[0]
    assert slope == pytest.approx(2, abs=0.15)
    # The bound of trilinear interpolation, in raw density where the Gaussian is a parabola: h^2 / 8 times the sum of
    # second derivatives, 3 / s^2, and at most the peak to multiply it.
    if not reach:
        h = 2 / 2 ** levels[-1]
        assert errors[-1] < field.peak * h * h / 8 * 3 / field.width**2


def test_opacity_is_the_closed_form() -> None:
    """A line integral of a Gaussian is an error function: rays at several distances from the middle."""
    from nerfvol.kernels.ops import render_rays

    field = Blob(peak=3.0)
    octree = full_octree(5, density_scale=4.0)  # what an "empty" vertex has is then 0.0013 / u
    write_values(octree, field, 0)
    miss = torch.linspace(0, 0.5, 16)
    o = torch.stack([CENTER[0] + miss, CENTER[1] + 0 * miss, CENTER[2] - 3 + 0 * miss], dim=-1)
    d = torch.tensor([[0.0, 0, 1]]).expand(16, 3).contiguous()
    opacity = torch.from_numpy(render_rays(octree, o, d, (1, 1, 1), 0.0, ("opacity",))["opacity"])
    half_length = math.erf(1 / (field.width * math.sqrt(2)))
    tau = field.peak * torch.exp(-(miss**2) / (2 * field.width**2)) * field.width * math.sqrt(2 * math.pi) * half_length
    # Coefficient error of the test above at this level, h^2 / 8 * 3 / s^2 = 2.3 %, on tau exp(-tau) <= 1 / e; and the
    # empty vertices along 2 u.
    torch.testing.assert_close(opacity, -torch.expm1(-tau), rtol=0, atol=0.023 / math.e + 0.003)


def test_whole_distillation_loses_little() -> None:
    field = Blob()
    dataset = views(field, ENOUGH_VIEWS, 24)
    config = DistillConfig(level=5, coarse_level=3)
    octree, report = distill(
        field, DOMAIN, dataset, (1, 1, 1), config, render_field=lambda camera: field.image(camera, (1, 1, 1))
    )
    octree.validate()
    assert report.field_psnr > 50  # only the rounding to 8 bits
    assert report.octree_psnr > 35 and report.lost_db == report.field_psnr - report.octree_psnr
    assert report.leaves == octree.n_leaves == sum(report.leaves_per_level.values()) < 32**3 // 3
    assert report.pruned == 0 and report.merged > 0 and len(report.leaves_per_level) >= 2
    assert report.candidates == report.leaves + report.merged
    assert f"{report.leaves} leaves" in str(report) and "dB lost" in str(report)


def test_candidates_cover_what_is_dense_and_little_else() -> None:
    config = DistillConfig(level=5, coarse_level=3, empty_opacity=0.01)
    field, frame = Blob(width=0.1), Frame.of(DOMAIN, 5)
    _, level, ijk = candidate_cells(field, frame, config, [])
    assert (level == 5).all() and len(np.unique(ijk, axis=0)) == len(ijk)
    threshold = -math.log1p(-0.01) / (2 / 32)
    # The sphere where a leaf is just opaque enough, plus a dilated cell and half a cell diagonal.
    radius = 0.1 * math.sqrt(2 * math.log(20 / threshold))
    everywhere = np.array(list(np.ndindex(32, 32, 32)))
    distance = np.linalg.norm(frame.origin + (everywhere + 0.5) / 16 - np.array(DOMAIN.center), axis=1)
    keys = {tuple(c) for c in ijk.tolist()}
    found = np.array([tuple(c) in keys for c in everywhere.tolist()])
    assert found[distance < radius].all()
    assert not found[distance > radius + (1 + math.sqrt(3)) * 2 / 32 + math.sqrt(3) / 16].any()


def test_neighbours_of_what_is_dense_are_candidates() -> None:
    """A cube of 2 x 2 x 2 leaves: it and the layer around it, in which its surface is interpolated."""

    class Cube(Blob):
        def density(self, positions: np.ndarray) -> np.ndarray:
            return np.where(np.abs(positions - CENTER).max(-1) < 1 / 16, 50.0, 0.0)

    _, _, ijk = candidate_cells(Cube(), Frame.of(DOMAIN, 5), DistillConfig(level=5, coarse_level=3), [])
    assert len(ijk) == 4**3 and ijk.min() == 14 and ijk.max() == 17


def test_a_hazy_field_is_looked_at_coarsely() -> None:
    """Too many candidates: the cells that fit hold all of the field, and come with the frame whose finest they are."""
    candidates = [candidate_cells(Blob(), Frame.of(DOMAIN, level), DistillConfig(level=level, coarse_level=3), [])
                  for level in (5, 4, 3)]  # fmt: skip
    fine, coarse, coarsest = (len(ijk) for _, _, ijk in candidates)
    assert fine > 4 * coarse > 16 * coarsest > 0
    for most, which in [(2 * fine, 0), (fine - 1, 1), (coarse, 1), (coarse - 1, 2), (coarsest, 2)]:
        messages: list[str] = []
        config = DistillConfig(level=5, coarse_level=3, max_leaves=most)
        frame, *found = candidate_cells(Blob(), Frame.of(DOMAIN, 5), config, messages)
        assert all(np.array_equal(*pair) for pair in zip(found, candidates[which][1:], strict=True)), most
        assert frame.finest == 5 - which and not messages


class Wrapped(Blob):
    """A ball with a sharp rim in a thin haze that fills the cube, which no view needs."""

    def __init__(self, haze: float = 0.01, rim: float = 0.02) -> None:
        super().__init__()
        self.haze, self.rim = haze, rim

    def density(self, positions: np.ndarray) -> np.ndarray:
        distance = np.linalg.norm(positions - CENTER, axis=-1)
        return self.haze + 60 / (1 + np.exp(np.minimum((distance - 0.3) / self.rim, 80.0)))


def test_haze_that_no_view_needs_costs_no_detail() -> None:
    """The finest leaves of all of it would not fit; twenty views see that the ball alone is needed, and it has them."""
    # The least that a vertex can hold is 0.05 / u here, of which leaves of a quarter show 0.013 to 0.022.
    config = DistillConfig(level=5, coarse_level=3, max_leaves=8_000, prune_weight=0.03)
    frame, _, ijk = candidate_cells(Wrapped(), Frame.of(DOMAIN, 5), config, [])
    assert frame.finest == 4 and len(ijk) == 16**3  # all of the cube, which at the finest size would be 32**3
    octree, report = distill(Wrapped(), DOMAIN, black_views(2 * ENOUGH_VIEWS), (1, 1, 1), config)
    assert not report.messages and report.candidates <= config.max_leaves and report.pruned > 2_000
    distance = np.abs(np.linalg.norm(octree.leaf_centers() - CENTER, axis=1) - 0.3)
    assert (distance < 0.03).sum() > 200 and (octree.leaf_level[distance < 0.03] == 5).all()


def test_of_few_views_haze_what_does_not_fit_is_split_last() -> None:
    """Nothing may be removed, and the rim, the thickest, is split before the haze; what was not is told."""
    config = DistillConfig(level=5, coarse_level=3, max_leaves=12_000, merge_tolerance=0.0)
    octree, report = distill(Wrapped(), DOMAIN, black_views(3), (1, 1, 1), config)
    assert report.pruned == report.merged == 0 and 11_000 < octree.n_leaves <= config.max_leaves
    assert (octree.leaf_sizes() ** 3).sum() == pytest.approx(8)  # the haze is there, in leaves of two sizes
    distance = np.abs(np.linalg.norm(octree.leaf_centers() - CENTER, axis=1) - 0.3)
    assert (octree.leaf_level[distance < 0.03] == 5).all()
    assert len(report.messages) == 1
    assert f"{(octree.leaf_level == 4).sum():,} leaves of its thinnest parts were not split" in report.messages[0]


def test_parts_that_hold_nothing_are_no_leaves() -> None:
    """Of the leaves that are split those parts stay that hold something or touch one that does, as of all cells."""

    class Wall(Blob):
        def density(self, positions: np.ndarray) -> np.ndarray:
            return np.where(np.abs(positions[:, 0] - CENTER[0]) < 1 / 16, 5.0, 0.0)

    level, ijk, left = finer_cells(Wall(), full_octree(4), Frame.of(DOMAIN, 4), DistillConfig(level=5))
    assert left == 0 and (level == 5).all()
    # The wall fills the parts 15 and 16 of 32 along x; they and one more on each side stay.
    assert set(ijk[:, 0].tolist()) == {14, 15, 16, 17} and len(np.unique(ijk, axis=0)) == len(ijk) == 4 * 32 * 32


@pytest.mark.parametrize("n_views", [8, ENOUGH_VIEWS])
def test_distilled_octrees_show_what_their_field_shows(n_views: int) -> None:
    """Views that nobody trained on: within 0.3 dB of the field, against a truth that is sharper than both."""
    field, truth = Wrapped(haze=0.0, rim=0.02), Wrapped(haze=0.0, rim=0.01)
    octree, _ = distill(field, DOMAIN, black_views(n_views), (1, 1, 1), DistillConfig(level=5, coarse_level=3))
    lens = Intrinsics(48, 48, 72, 72, 24, 24)
    held_out = orbit(2, center=DOMAIN.center, radius=3.0, elevation_deg=40, intrinsics=lens)

    def psnr(image) -> float:
        errors = [np.mean((image(camera) - truth.image(camera, (1, 1, 1))) ** 2) for camera in held_out]
        return float(np.mean(-10 * np.log10(errors)))

    shown = psnr(lambda camera: render_image(octree, camera, (1, 1, 1), outputs=("rgb",))["rgb"])
    assert shown > psnr(lambda camera: field.image(camera, (1, 1, 1))) - 0.3


def test_a_field_that_does_not_fit_keeps_its_densest_cells() -> None:
    """Fewer leaves than the coarsest take: the threshold rises until they fit; the middle of the blob stays."""
    messages: list[str] = []
    _, level, ijk = candidate_cells(
        Blob(), Frame.of(DOMAIN, 5), DistillConfig(level=5, coarse_level=3, max_leaves=100), messages
    )
    assert 8 <= len(ijk) <= 100 and (level == 3).all()
    assert len(messages) == 1
    assert "only what is more opaque than" in messages[0] and "fits into 100 leaves" in messages[0]
    middle = np.array(list(np.ndindex(2, 2, 2))) + 3
    assert {tuple(cell) for cell in middle.tolist()} <= {tuple(cell) for cell in ijk.tolist()}


def test_photographs_are_distilled_coarsely() -> None:
    """Where nothing else is said: their fields are hazy."""
    objects = views(Blob(), 1).scene
    photographs = dataclasses.replace(objects, background_cube=8 * objects.aabb)
    assert [DistillConfig().for_scene(scene).level for scene in (objects, photographs)] == [8, 6]
    assert DistillConfig(level=7).for_scene(photographs).level == 7


def test_nothing_is_left_before_a_lens() -> None:
    """Of a field that is dense everywhere around photographs, what stands right before a camera goes."""

    class Everywhere(Blob):
        def density(self, positions: np.ndarray) -> np.ndarray:
            return np.full(len(positions), 0.3)

    dataset = views(Everywhere(), 3)
    bounds = dataset.scene.aabb
    middle = bounds.mean(0)
    dataset.scene = dataclasses.replace(dataset.scene, background_cube=middle + 4 * (bounds - middle))
    domain = dataclasses.replace(DOMAIN, outer=4.0)
    config = DistillConfig(level=4, coarse_level=3, prune_weight=0.0, merge_tolerance=0.0)
    octree, report = distill(Everywhere(), domain, dataset, (1, 1, 1), config)
    assert report.leaves > 4**3 and not dataset.before_a_lens(octree.leaf_centers()).any()


def test_cells_are_searched_throughout() -> None:
    """A coefficient that rises along x, y or z: the largest of a cell is that of its last sample on that axis."""
    cells, origin = np.array([[0, 2, 5], [7, 1, 0]]), np.array([0.5, -1.0, 2.0])
    corners = origin + 0.4 * cells
    for axis in range(3):

        class Ramp(Blob):
            def density(self, positions: np.ndarray, axis: int = axis) -> np.ndarray:
                return positions[:, axis] + 10

        np.testing.assert_allclose(
            largest_sigma(Ramp(), cells, origin, 0.4, EVERYWHERE), corners[:, axis] + 10 + 0.35, rtol=1e-6
        )


@pytest.mark.parametrize("compiled", [True, False])
def test_dilation_is_every_neighbour(monkeypatch, compiled) -> None:
    """Random cells of a sparse grid, against all pairs."""
    if not compiled:
        monkeypatch.setattr("nerfvol.starts.cells.native", lambda: None)
    random = np.random.default_rng(0)
    cells = np.unique(random.integers(0, 12, (600, 3)), axis=0)
    cells = (cells + random.integers(0, 3) * (1 << 18)).astype(np.int32)
    holds = random.random(len(cells)) < 0.03
    near = (np.abs(cells[:, None] - cells[None, holds]).max(2) <= 1).any(1)
    assert 0.2 < near.mean() < 0.9
    np.testing.assert_array_equal(dilated(cells, holds), near)
    assert not dilated(cells, np.zeros(len(cells), bool)).any()


def test_dilation_is_one_cell() -> None:
    cells = np.array(list(np.ndindex(5, 5, 5)))
    holds = (cells == (2, 2, 2)).all(1) | (cells == (0, 0, 4)).all(1)
    kept = dilated(cells, holds)
    near = [(np.abs(cells - np.array(c)).max(1) <= 1) for c in ((2, 2, 2), (0, 0, 4))]
    np.testing.assert_array_equal(kept, near[0] | near[1])


def test_leaves_grow_outside_the_detail() -> None:
    """With a background: full level inside the inner cube, one level less at each doubling of the distance."""

    class Everywhere(Blob):
        def density(self, positions: np.ndarray) -> np.ndarray:
            return np.full(len(positions), 5.0)

    domain = Domain((0.0, 0.0, 0.0), 1.0, outer=4.0)
    frame = Frame.of(domain, 3)
    assert frame.size == 8 and frame.finest == 5
    _, level, ijk = candidate_cells(Everywhere(), frame, DistillConfig(level=3, coarse_level=1), [])
    octree = Octree.from_leaves(level, ijk, frame.origin, frame.size, 1, 1.0)
    volume = (octree.leaf_sizes() ** 3).sum()
    assert volume == pytest.approx(8**3)  # a partition of the root cube
    distance = np.abs(octree.leaf_centers()).max(1)
    assert (octree.leaf_level[distance < 1] == 5).all()
    assert (octree.leaf_level[(distance > 1) & (distance < 2)] == 4).all()
    assert (octree.leaf_level[distance > 2] == 3).all()


def test_hidden_leaves_have_no_weight() -> None:
    """An opaque shell: what the cameras see has weight, the core behind it none."""
    octree = full_octree(4)
    octree.density = np.full(octree.n_vertices, 3.0)  # 300 / u in leaves of 1/8: each hides what is behind
    weights = largest_weights(octree, views(Blob()), (1, 1, 1), 1)
    ring = np.minimum(octree.leaf_ijk, 15 - octree.leaf_ijk).min(1)
    assert weights[ring >= 3].max() < 1e-3
    side = (octree.leaf_ijk[:, 0] == 15) & (np.abs(octree.leaf_ijk[:, 1:] - 7.5).max(1) < 3)
    assert side.sum() > 20 and weights[side].min() > 0.5


def test_few_views_remove_nothing() -> None:
    """What nineteen views do not need another may; twenty can tell, but only of what they have in their picture."""
    octree = full_octree(4)
    octree.density = np.full(octree.n_vertices, 3.0)
    few, enough = (black_views(n) for n in (ENOUGH_VIEWS - 1, ENOUGH_VIEWS))
    assert needed(octree, few, (1, 1, 1), 0.005).all()
    hidden = ~needed(octree, enough, (1, 1, 1), 0.005)
    assert hidden.sum() > 500 and largest_weights(octree, enough, (1, 1, 1), 1)[hidden].max() < 0.005
    # Half of the pictures, cut at their middle: what only the others have is in the pictures of half of the views.
    for i in range(0, ENOUGH_VIEWS, 2):
        lens = enough.cameras[i].intrinsics
        enough.cameras[i] = dataclasses.replace(
            enough.cameras[i], intrinsics=lens.cropped(0, 0, lens.width, lens.height // 2)
        )
        enough.images[i] = enough.images[i][: lens.height // 2]
    seen = views_of_leaves(octree, enough)
    expected = np.zeros(octree.n_leaves, int)
    blocks = octree.origin + ((octree.leaf_ijk >> 3) + 0.5) * (8 * octree.leaf_sizes()[:, None])
    for camera in enough.cameras:
        pixels = camera.project(blocks)
        expected += ((pixels >= 0) & (pixels < (48, camera.intrinsics.height))).all(1)
    np.testing.assert_array_equal(seen, expected)
    assert {ENOUGH_VIEWS, ENOUGH_VIEWS // 2} <= set(seen.tolist())
    np.testing.assert_array_equal(needed(octree, enough, (1, 1, 1), 0.005)[seen < ENOUGH_VIEWS], True)


def test_fields_without_an_sh_head_are_projected() -> None:
    """Colour of degree 1 in the direction comes back exactly; degree 2 in it does not disturb degree 1."""

    class View(Blob):
        has_sh = False

        def __call__(self, positions: np.ndarray, viewdirs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            sigma, rgb = super().__call__(positions, viewdirs)
            return sigma, rgb + (viewdirs[:, :1] * viewdirs[:, 1:2])

    octree, expected = full_octree(3), full_octree(3)
    write_values(octree, View(), 0)
    write_values(expected, Blob(), 0)
    np.testing.assert_allclose(octree.sh, expected.sh, atol=2e-6)
    np.testing.assert_array_equal(octree.density, expected.density)


def test_colour_in_front_of_a_surface_is_the_surfaces() -> None:
    """Averaging weighs colour by the coefficient: empty neighbours do not bleed in."""

    class Half(Blob):
        def density(self, positions: np.ndarray) -> np.ndarray:
            return np.where(positions[:, 0] > CENTER[0], 100.0, 0.0)

        def sh(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            solid = (positions[:, 0] > CENTER[0]).astype(np.float32)
            return self.density(positions), np.broadcast_to((solid - 0.5)[:, None, None], (len(solid), 3, 4))

    octree = full_octree(3)
    write_values(octree, Half())
    face = np.abs(octree.vertex_positions()[:, 0] - DOMAIN.center[0]) < 1e-6
    np.testing.assert_allclose(octree.sh[face], 0.5, atol=1e-4)
    np.testing.assert_allclose(octree.density_scale * explin(octree.density[face]), 50, rtol=1e-4)


def test_empty_fields_are_an_error() -> None:
    config = DistillConfig(level=4, coarse_level=2)
    with pytest.raises(InputError, match="field is empty.*--init direct"):
        distill(Blob(peak=1e-6), DOMAIN, views(Blob()), (1, 1, 1), config)
    hidden = dataclasses.replace(config, prune_weight=1.1)
    with pytest.raises(InputError, match="training views can see"):
        distill(Blob(), DOMAIN, black_views(ENOUGH_VIEWS), (1, 1, 1), hidden)


@pytest.mark.parametrize("reach", [0, REACH])
def test_values_do_not_depend_on_the_parts(monkeypatch, reach) -> None:
    """Vertices are filled a part at a time, to spare memory; each alone. Sums are of float64 products either way."""
    whole, parts = (full_octree(3).subdivide(np.arange(512) % 3 == 0)[0] for _ in range(2))
    write_values(whole, Blob(), reach)
    monkeypatch.setattr(
        "nerfvol.starts.cells.CHUNK", 100
    )  # of the vertices of two sizes of leaves; the last part is shorter
    write_values(parts, Blob(), reach)
    np.testing.assert_allclose(parts.values, whole.values, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("side, factor", [(24, 1), (399, 1), (400, 2), (800, 4), (4000, 4)])
def test_leaves_are_judged_by_images_of_some_size(side, factor):
    """Small images as they are; of large ones about 200 pixels, and never less than a quarter of what there is."""
    lens = Intrinsics(side, side // 2 or 1, side, side, side / 2, side / 4)
    dataset = Dataset(
        orbit(1, center=(0, 0, 0), radius=3, elevation_deg=10, intrinsics=lens),
        [],
        ["a"],
        SceneBounds(np.array([[-1.0] * 3, [1.0] * 3]), None, True),
        "test",
    )
    assert judged_downscale(dataset) == factor
