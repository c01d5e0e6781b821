"""Training rays in tiles: whose pixels, in which directions, how often and with which weight."""

import dataclasses

import numpy as np
import pytest

from nerfvol.cameras.camera import Intrinsics, orbit
from nerfvol.datasets import averages, tiles
from nerfvol.datasets import dataset as dataset_module
from nerfvol.datasets.dataset import Dataset
from nerfvol.datasets.tiles import Cursor, Cursors, TileBank
from nerfvol.kernels.state import TILE_RAYS
from nerfvol.native import native
from nerfvol.region import SceneBounds

WHITE = (1.0, 1.0, 1.0)
SCENE = SceneBounds(np.array([[-1.0, -1, -1], [1, 1, 1]]), None, True)


def views(sizes, content, seed=0) -> Dataset:
    """Views of the given sizes, transparent but for a share ``content`` of their rows, which are noise."""
    generator = np.random.default_rng(seed)
    cameras, images = [], []
    for i, (width, height) in enumerate(sizes):
        lens = Intrinsics(width, height, 1.3 * width, 1.2 * width, 0.45 * width, 0.52 * height, k1=0.02)
        cameras.append(orbit(len(sizes), center=(0, 0, 0), radius=3, elevation_deg=10, intrinsics=lens)[i])
        image = np.zeros((height, width, 4), np.uint8)
        rows = round(content * height)
        image[:rows] = generator.integers(0, 255, (rows, width, 4))
        image[:rows, :, 3] = 255
        images.append(image)
    return Dataset(cameras, images, [str(i) for i in range(len(sizes))], SCENE, "test")


@pytest.fixture(scope="module")
def odd() -> Dataset:
    """Three sizes, none a multiple of 8 both ways, content above and plain background below."""
    return views([(20, 33), (24, 16), (20, 33), (13, 40)], 0.5)


def whole_batch(bank: TileBank):
    return bank.batch(np.arange(bank.n_tiles), np.ones(bank.n_tiles, np.float32))


def test_what_pads_a_tile_is_a_ray_of_that_tile(odd):
    """A padding ray that points elsewhere makes its packet as wide as all between, and slow as that: fern's 63 tiles of 3,024
    at the lower edge, padded with the first pixel's ray, took nine tenths of what drawing them all took."""
    bank = TileBank(odd, WHITE, 1)
    batch = whole_batch(bank)
    rays, weight = batch.rays_d.reshape(-1, TILE_RAYS, 3), batch.weight.reshape(-1, TILE_RAYS)
    padded = np.flatnonzero((weight == 0).any(1))
    assert len(padded)
    for tile in padded:
        own = rays[tile][weight[tile] > 0]
        assert all((own == ray).all(1).any() for ray in rays[tile])


@pytest.mark.parametrize("k", [1, 2])
def test_each_pixel_stands_once_with_its_own_ray_and_colour(odd, k):
    """All tiles together are all pixels, each with the ray that its camera gives it; the rest weighs nothing."""
    bank = TileBank(odd, WHITE, k)
    batch = whole_batch(bank)
    pictures = odd.pyramid(WHITE, k)
    origins = np.repeat(batch.rays_o, TILE_RAYS, 0)
    seen = 0
    for camera, picture in zip(odd.cameras, pictures, strict=True):
        origin, directions = camera.scaled(k).rays()
        rows = np.flatnonzero((origins == origin).all(1) & (batch.weight > 0))
        assert len(rows) == len(directions)
        # The kernels' rays and the camera's are the same float32 products in another order: a few roundings apart.
        order = np.argmax(batch.rays_d[rows] @ directions.T, axis=1)
        assert np.array_equal(np.sort(order), np.arange(len(directions)))
        np.testing.assert_allclose(batch.rays_d[rows], directions[order], atol=8 * np.finfo(np.float32).eps)
        np.testing.assert_array_equal(batch.target[rows], picture.reshape(-1, 3)[order] * np.float32(1 / 255))
        seen += len(rows)
    assert seen == (batch.weight > 0).sum() == sum(picture.shape[0] * picture.shape[1] for picture in pictures)
    np.testing.assert_allclose(np.linalg.norm(batch.rays_d, axis=1), 1, atol=1e-6)


def test_rays_of_a_tile_are_neighbours(odd):
    """Runs of 64 rays share an origin and a block of 8x8 pixels: what the kernels are fast for."""
    bank = TileBank(odd, WHITE, 1)
    batch = whole_batch(bank)
    assert batch.rays_o.shape == (bank.n_tiles, 3) and bank.n_rays == bank.n_tiles * TILE_RAYS
    directions = batch.rays_d.reshape(bank.n_tiles, TILE_RAYS, 3)
    live = batch.weight.reshape(bank.n_tiles, TILE_RAYS) > 0
    assert live[:, 0].all()
    spread = np.arccos(np.clip((directions * directions[:, :1]).sum(-1), -1, 1))[live].max()
    assert spread < 8 * np.sqrt(2) * 1.1 / (1.2 * 13)  # the diagonal of 8 pixels of the widest lens


def test_background_tiles_are_the_background_and_nothing_else(odd):
    white, black = TileBank(odd, WHITE, 1), TileBank(odd, (0.0, 0.0, 0.0), 1)
    assert 0 < len(white.background_tiles) < white.n_tiles
    assert np.array_equal(
        white.background_tiles, black.background_tiles
    )  # transparent pixels take whatever colour is behind
    targets = whole_batch(white).target.reshape(white.n_tiles, -1)
    assert np.array_equal((targets == 1).all(1), white.is_background)
    assert np.array_equal(
        np.sort(np.concatenate([white.foreground_tiles, white.background_tiles])), np.arange(white.n_tiles)
    )
    # of the background tiles a picture keeps one, and how many there are is known before
    assert sum(map(len, white.pixels)) == len(white.foreground_tiles) + len(odd)
    assert tiles.foreground_share(odd, WHITE, views=100) == len(white.foreground_tiles) / white.n_tiles


def drawn(bank: TileBank, n: int, count: int, share: float = 0.6, seed: int = 5):
    cursors = Cursors()
    return [bank.draw(n, share, seed, cursors) for _ in range(count)], cursors


def test_the_expected_loss_is_the_mean_over_all_pixels(odd):
    """Over whole epochs of both queues, weights times errors add up to the mean over pixels, whatever the share."""
    bank = TileBank(odd, WHITE, 1)
    n_foreground, n_background = len(bank.foreground_tiles), len(bank.background_tiles)
    share = 0.75
    steps = (
        n_foreground * n_background
    )  # 4 tiles a step: 3 of the foreground, 1 of the background; whole epochs of both
    everything = whole_batch(bank)
    error = (everything.target**2).mean(-1)
    wanted = (error * everything.weight).sum() / bank.n_tiles
    batches, cursors = drawn(bank, 4, steps, share)
    assert cursors == Cursors(Cursor(3 * n_background, 0), Cursor(n_foreground, 0))
    found = np.mean([((b.target**2).mean(-1) * b.weight).sum() / 4 for b in batches])
    assert found == pytest.approx(wanted, rel=1e-5)
    assert np.mean([b.weight.sum() for b in batches]) == pytest.approx(
        4 * everything.weight.mean() * TILE_RAYS, rel=1e-5
    )


def test_an_epoch_visits_each_tile_once_and_orders_differ(odd):
    bank = TileBank(odd, WHITE, 1)
    n = len(bank.foreground_tiles)
    cursors = Cursors()
    epochs = []
    for _ in range(2):
        order = [tuple(bank.draw(1, 1.0, 3, cursors).rays_d[0]) for _ in range(n)]
        assert len(set(order)) == n
        epochs.append(order)
    assert epochs[0] != epochs[1] and set(epochs[0]) == set(epochs[1])
    other = [tuple(bank.draw(1, 1.0, 4, cursors).rays_d[0]) for cursors in [Cursors()] for _ in range(n)]
    assert other != epochs[0]


def test_the_cursors_are_all_there_is_to_remember(odd):
    """A bank made again with the cursors of the old one goes on with the same tiles, also across epochs."""
    batches, *_ = drawn(TileBank(odd, WHITE, 1), 7, 12)
    cursors = Cursors()
    for i, expected in enumerate(batches):
        cursors = Cursors.of(dataclasses.asdict(cursors))
        batch = TileBank(odd, WHITE, 1).draw(7, 0.6, 5, cursors)
        for name in ("rays_o", "rays_d", "target", "weight"):
            assert np.array_equal(getattr(batch, name), getattr(expected, name)), (i, name)


@pytest.mark.parametrize("content", [0.0, 1.0])
def test_only_background_or_only_foreground_tiles(content):
    """With one of the queues empty the other fills the batch, at weight 1."""
    dataset = views([(16, 16), (16, 24)], content)
    bank = TileBank(dataset, WHITE, 1)
    assert (len(bank.foreground_tiles) == 0) == (content == 0)
    batch = bank.draw(6, 0.8, 0, Cursors())
    assert batch.rays_o.shape == (6, 3) and (batch.weight == 1).all()


def test_the_angle_of_a_pixel(odd):
    one, two = TileBank(odd, WHITE, 1), TileBank(odd, WHITE, 2)
    assert one.pixel_angle == pytest.approx(np.median([1 / (1.3 * w) for w in (20, 24, 20, 13)]))
    # A scaled lens drops what does not fill a block, but its focal length is exactly half.
    assert two.pixel_angle == pytest.approx(2 * one.pixel_angle)


def test_two_backgrounds_are_made_a_picture_at_a_time(odd, monkeypatch):
    """All pictures before both would be in memory at once, of which the tiles that are kept are a fraction."""
    made = []

    def sort_out(pictures, backgrounds):
        made.append("sorted")
        return tiles_of(pictures, backgrounds)

    def composited(image, background, k):
        made.append("composited")
        return composite_average(image, background, k)

    tiles_of, composite_average = tiles._sort_out, averages.composite_average
    monkeypatch.setattr(tiles, "_sort_out", sort_out)
    monkeypatch.setattr(dataset_module, "composite_average", composited)
    TileBank(dataclasses.replace(odd, threads=1), WHITE, 1, (0.0, 0.0, 0.0))
    assert made == ["composited", "composited", "sorted"] * len(odd)


def test_without_compiled_code_the_batch_is_the_same(odd, monkeypatch):
    bank = TileBank(odd, WHITE, 1)
    compiled = whole_batch(bank)
    monkeypatch.setattr(tiles, "native", lambda: None)
    plain = whole_batch(bank)
    # three products and two sums of numbers up to 1, in another order
    np.testing.assert_allclose(plain.rays_d, compiled.rays_d, rtol=0, atol=4 * np.finfo(np.float32).eps)
    for name in ("rays_o", "target", "weight"):
        np.testing.assert_array_equal(getattr(plain, name), getattr(compiled, name))


def gathered(**change):
    """Three tiles of two pictures, of 2 and 3 tiles, by the compiled code alone."""
    arrays = dict(
        directions=[np.zeros((n, TILE_RAYS, 3), np.float32) for n in (2, 3)],
        pixels=[np.zeros((n, TILE_RAYS, 3), np.uint8) for n in (2, 3)],
        rotations=np.zeros((2, 3, 3), np.float32), image=np.array([0, 1, 1]), tile=np.array([1, 0, 2]),
        row=np.array([1, 2, 0]),
        out=np.zeros((3, TILE_RAYS, 3), np.float32), target=np.zeros((3, TILE_RAYS, 3), np.float32),
    )  # fmt: skip
    native().gather_tiles(**arrays | change)


@pytest.mark.skipif(native() is None, reason="no compiled kernels")
@pytest.mark.parametrize("image, tile, row", [(0, 2, 0), (1, 3, 0), (1, 10**6, 0), (1, -1, 0), (2, 0, 0),
                                              (-1, 0, 0), (0, 0, 2), (1, 0, 3), (1, 0, -1)])  # fmt: skip
def test_tiles_outside_their_picture_are_refused(image, tile, row):
    """The compiled code reads where it is told: it looks first."""
    gathered()
    with pytest.raises(ValueError, match="a tile lies outside its picture"):
        gathered(image=np.array([0, 1, image]), tile=np.array([1, 0, tile]), row=np.array([1, 2, row]))


@pytest.mark.skipif(native() is None, reason="no compiled kernels")
@pytest.mark.parametrize("change", [
    {"tile": np.array([1, 0])}, {"row": np.array([1, 2])}, {"out": np.zeros((2, TILE_RAYS, 3), np.float32)},
    {"target": np.zeros((2, TILE_RAYS, 3), np.float32)}, {"rotations": np.zeros((1, 3, 3), np.float32)},
    {"directions": [np.zeros((9, TILE_RAYS, 3), np.float32)]},
    {"pixels": [np.zeros((n, TILE_RAYS, 3), np.uint8) for n in (2, 2)]},
    {"directions": [np.zeros((n, TILE_RAYS, 3), np.float32) for n in (2, 2)]},
])  # fmt: skip
def test_arrays_that_do_not_fit_each_other_are_refused(change):
    with pytest.raises(ValueError):
        gathered(**change)


@pytest.mark.parametrize("k", [1, 2])
def test_the_same_tiles_before_a_second_background(k):
    """The same rays, and colours that differ by what shines through: (1 - alpha) (second - first)."""
    dataset, second = views([(20, 66), (24, 48)], 0.5, seed=3), (0.0, 0.5, 0.25)
    for i, image in enumerate(dataset.images):
        image[:16] = 255  # opaque and white: foreground, though it cannot be seen before white
        image[18:22, :, 3] = 90 + i
    bank = TileBank(dataset, WHITE, k, second)
    everything = np.arange(bank.n_tiles), np.ones(bank.n_tiles, np.float32)
    one, two = bank.batch(*everything), bank.batch(*everything, second=True)
    for name in ("rays_o", "rays_d", "weight"):
        assert np.array_equal(getattr(one, name), getattr(two, name))
    clear = dataclasses.replace(dataset, images=[
        np.dstack([np.full((*i.shape[:2], 3), 255, np.uint8), 255 - i[..., 3:]]) for i in dataset.images
    ])  # fmt: skip
    through = whole_batch(TileBank(clear, (0.0, 0.0, 0.0), k)).target
    # Three roundings to 8 bits, half a level each
    np.testing.assert_allclose(
        two.target - one.target, through * (np.array(second) - WHITE), atol=1.5 / 255 + 1e-6, rtol=0
    )
    assert np.array_equal(bank.is_background, (through == 1).reshape(bank.n_tiles, -1).all(1))
    cursors, others = Cursors(), Cursors()
    a, b = bank.draw(5, 0.6, 1, cursors), bank.draw(5, 0.6, 1, others, second=True)
    assert np.array_equal(a.rays_d, b.rays_d) and not np.array_equal(a.target, b.target) and cursors == others
