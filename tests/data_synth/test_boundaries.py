"""Closed surfaces that hold media: nested, overlapping, of glass, of triangles, several media. Alphas are closed forms."""

import numpy as np
import pytest

from data_synth import Camera, Emission, InputError, Path, lights, look_at, materials, media, surfaces
from data_synth.scene import Scene
from tests.fixtures.hypothesis_tests import assert_means

SIGMA = np.array([0.4, 0.9, 1.7])
OTHER = np.array([2.0, 0.2, 0.6])


def box(sigma=SIGMA, **kwargs):
    return media.homogeneous((-2,) * 3, (2,) * 3, sigma, **kwargs)


def look(scene, eye=(0, -4.0, 0)):
    """T of the central ray along y, by the march and by paths (whose mean is tested)."""
    c = Camera(1, 1, 5.0, look_at(eye, (0, 9.0, 0)))
    scene.medium = scene.medium and scene.medium._replace(Le=np.ones((1, 3)))
    scene.media = [m._replace(Le=np.ones((1, 3))) for m in scene.media]
    marched = 1.0 - Emission().render(scene, c).rgb[0, 0]  # what glows with 1 wherever it absorbs shows 1 - T
    traced = Path(spp=3000, max_depth=0, jitter=False).render(scene, c)
    assert_means(1.0 - traced.rgb[0, 0], traced.variance[0, 0], marched, bias=1e-9)
    return -np.log(marched)


def balls(*places, material=None):
    return {
        "shapes": [
            surfaces.sphere(k if material is None else material, (0, y, 0), r) for k, (y, r) in enumerate(places)
        ]
    }


@pytest.mark.parametrize(
    "places, length", [(((-0.5, 0.8), (0.5, 0.8)), 2.6), (((0, 0.8), (0.1, 0.4)), 1.6), (((0, 0.8), (0, 0.79)), 1.6)]
)
def test_boundaries_of_one_kind_may_overlap_and_nest(places, length):
    scene = Scene(medium=box(), materials=[materials.null()], bounded=True, **balls(*places, material=0))
    assert look(scene) == pytest.approx(length * SIGMA, abs=1e-9)
    inside = look(scene, eye=(0, 0, 0))
    assert inside == pytest.approx((max(y + r for y, r in places)) * SIGMA, abs=1e-9)


def test_clear_glass_in_fog_holds_no_fog():
    """ior 1 neither mirrors nor bends: the closed form is the chord of the box less that of the ball."""
    for ior in (1.0, 1.0 + 1e-12):
        scene = Scene(medium=box(), materials=[materials.dielectric(ior)], **balls((0.3, 0.5)))
        assert look(scene) == pytest.approx(3.0 * SIGMA, abs=1e-6)
    scene = Scene(
        medium=box(),
        materials=[materials.null(), materials.dielectric(1.0)],
        bounded=True,
        **balls((0, 1.2), (0.3, 0.5)),
    )
    scene.materials[1] = materials.dielectric(1.0, medium=materials.CLEAR)
    assert look(scene) == pytest.approx(1.4 * SIGMA, abs=1e-9)


def test_null_boundaries_in_an_unbounded_medium_change_nothing():
    scene = Scene(medium=box(), materials=[materials.null()], **balls((0.3, 0.5)))
    assert look(scene) == pytest.approx(4.0 * SIGMA, abs=1e-9)


@pytest.mark.parametrize("first, second, want", [(0, 0, 1), (1, 0, 0), (0, 1, 1)])
def test_several_media_by_priority(first, second, want):
    """Two balls that overlap by 0.6: there the medium of higher priority counts, of equal ones the later material's."""
    scene = Scene(
        medium=box(), media=[box(OTHER)], bounded=True,
        materials=[materials.null(0, first), materials.null(1, second)], **balls((-0.5, 0.8), (0.5, 0.8)),
    )  # fmt: skip
    mine, others = (1.0, 1.6) if want == 1 else (1.6, 1.0)
    assert look(scene) == pytest.approx(mine * SIGMA + others * OTHER, abs=1e-9)
    swapped = look(scene, eye=(0, -0.1, 0))  # from within the overlap
    assert swapped == pytest.approx(0.4 * (OTHER if want == 1 else SIGMA) + 1.0 * OTHER, abs=1e-9)


def test_a_grid_in_a_ball_in_fog():
    """Medium 1 is a grid whose arrays stand behind those of medium 2; its lookups must find their own samples."""
    ramp = np.broadcast_to(np.linspace(0.5, 1.5, 9)[None, :, None], (9, 9, 9))
    grid = media.grid(ramp, (-1,) * 3, (1,) * 3, OTHER)
    scene = Scene(
        medium=box(), media=[box((9.0, 9.0, 9.0)), grid], materials=[materials.null(2)],
        **balls((0.2, 0.6), material=0),
    )  # fmt: skip
    mean = 1.0 + 0.5 * 0.2  # of the ramp along the chord, exact for a linear density
    assert look(scene) == pytest.approx(2.8 * SIGMA + 1.2 * mean * OTHER, rel=1e-4)


def test_a_mesh_bounds_like_the_box_that_it_is():
    v = np.array([[x, y, z] for x in (-0.7, 0.7) for y in (-0.5, 0.9) for z in (-0.6, 0.6)])
    f = [
        [0, 1, 3],
        [0, 3, 2],
        [4, 6, 7],
        [4, 7, 5],
        [0, 4, 5],
        [0, 5, 1],
        [2, 3, 7],
        [2, 7, 6],
        [0, 2, 6],
        [0, 6, 4],
        [1, 5, 7],
        [1, 7, 3],
    ]
    scene = Scene(medium=box(), triangles=surfaces.mesh(0, v, np.array(f)), materials=[materials.null()], bounded=True)
    assert look(scene, (0.03, -4.0, 0.01)) == pytest.approx(1.4 * SIGMA, rel=1e-3)
    assert look(scene, (0.0, 0.2, 0.01)) == pytest.approx(0.7 * SIGMA, rel=1e-3)


def test_nested_glass_refracts_by_both_indices():
    """A ball of water in a ball of water is no surface; a furnace of nested glass and fog disappears."""
    sky = np.array([0.7, 0.3, 0.5])
    scene = Scene(
        medium=media.homogeneous((-2,) * 3, (2,) * 3, 3.0, 1.0), opaque_sky=True, lights=[lights.environment(sky)],
        materials=[materials.dielectric(1.5, medium=materials.CLEAR), materials.dielectric(1.2, medium=0, priority=1)],
        **balls((0, 0.9), (0.2, 0.5)),
    )  # fmt: skip
    c = Camera(3, 3, 6.0, look_at((0.1, -3.0, 0.2), (0, 0, 0)))
    picture = Path(spp=600, jitter=False).render(scene, c)
    assert_means(picture.rgb, picture.variance, sky)
    one = Scene(materials=[materials.dielectric(1.33)], lights=[lights.sky(sky, 0.1, 0.9)], **balls((0, 0.9)))
    two = Scene(
        materials=[materials.dielectric(1.33), materials.dielectric(1.33)],
        lights=one.lights,
        **balls((0, 0.9), (0.1, 0.5)),
    )
    a, b = (Path(spp=20, jitter=False).render(s, c, seed=3).rgb for s in (one, two))
    assert np.allclose(a, b, atol=1e-9)


def test_media_that_are_not_defined_are_refused():
    scene = Scene(medium=box(Le=1.0), materials=[materials.null(2)], **balls((0, 0.5)))
    with pytest.raises(InputError, match="medium 2"):
        scene.world()
    with pytest.raises(InputError, match="medium"):
        materials.dielectric(1.5, medium=-3)
