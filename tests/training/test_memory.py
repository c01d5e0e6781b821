"""The estimate of training memory: sums of real array sizes, and a refusal that says what to try."""

import dataclasses
import json
import os
import threading
import tracemalloc
import weakref

import numpy as np
import pytest
from PIL import Image

from nerfvol.cameras.camera import Intrinsics
from nerfvol.cameras.lens import BrownConrady
from nerfvol.cameras.paths import orbit
from nerfvol.datasets import decoding
from nerfvol.datasets.load import load_dataset
from nerfvol.datasets.photographs import FACTORS, Photographs, estimate_bytes
from nerfvol.datasets.store import ImageStore
from nerfvol.datasets.tiles import TileBank
from nerfvol.errors import InputError
from nerfvol.kernels import ops
from nerfvol.native import native
from nerfvol.training.memory.base import gib
from nerfvol.training.memory.octree import (
    MOST_LEAVES,
    OtherMemory,
    affordable_leaves,
    change_bytes,
    estimate_training,
    largest_octree,
    octree_bytes,
    require_memory,
    splits_within,
)
from nerfvol.training.memory.splats import photographs_bytes, photographs_held
from tests.fixtures.rooms import draw, facing_cameras, trace_planes, write_photographs
from tests.fixtures.runs import settings, start
from tests.fixtures.tiny import make_sphere_octree, write_scene


@pytest.fixture(scope="module")
def dataset(tiny_scene):
    return load_dataset(tiny_scene, "train")


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_octree_bytes_are_those_of_its_arrays(degree):
    octree = make_sphere_octree(6).with_sh_degree(degree)
    state = ops.TrainState(octree)
    held = [octree.corners, octree.leaf_level, octree.leaf_ijk, octree.values]
    held += [value for value in vars(state).values() if isinstance(value, np.ndarray)]
    real = sum(array.nbytes for array in held)
    # A node, a fifth of which counts for a leaf, is the only size that differs from shape to shape.
    assert real == pytest.approx(octree_bytes(octree.n_leaves, degree, octree.n_vertices), rel=0.02)


@pytest.mark.parametrize("degree", [1, 2])
def test_changing_an_octree_takes_what_was_planned_for(degree):
    """Splitting a fifth of the leaves; the second moments follow when the old values are gone."""

    def change(new, transfer):
        nonlocal octree, state
        octree = new
        state = ops.TrainState(new, transfer.vertices(state.moments))

    tracemalloc.start()
    try:
        octree = make_sphere_octree(6).with_sh_degree(degree)
        state = ops.TrainState(octree)
        before = octree_bytes(octree.n_leaves, degree, octree.n_vertices)
        tracemalloc.reset_peak()
        # A slab of them: leaves with neighbours of their own size, as they are in a surface.
        change(*octree.subdivide(octree.leaf_ijk[:, 2] < np.quantile(octree.leaf_ijk[:, 2], 0.21)))
        share = before / octree_bytes(octree.n_leaves, degree, octree.n_vertices)
        assert 0.35 < share < 0.5  # octree.BEFORE_SHARE
        sizes = octree.n_leaves, degree, octree.n_vertices
        planned = octree_bytes(*sizes) + change_bytes(*sizes)
        assert 0.9 * planned < tracemalloc.get_traced_memory()[1] < 1.1 * planned
    finally:
        tracemalloc.stop()


def test_refusal_names_the_parts_and_a_way_out(dataset):
    estimate = estimate_training(dataset, 10_000_000, 1)
    require_memory(estimate, available=estimate.peak * 2)
    with pytest.raises(InputError, match=r"up to 10,000,000 leaves .* 1.00 GiB of memory are free; use a larger"):
        require_memory(estimate, available=1 << 30)


def test_affordable_leaves_fit_and_no_more_would(dataset):
    free = 2 << 30
    leaves = affordable_leaves(dataset, 1, available=free)
    require_memory(estimate_training(dataset, leaves, 1), free)
    with pytest.raises(InputError):
        require_memory(estimate_training(dataset, int(leaves * 1.01), 1), free)
    assert affordable_leaves(dataset, 1, available=1 << 50) == MOST_LEAVES - 1
    with pytest.raises(InputError, match="training would need"):
        affordable_leaves(dataset, 1, available=150 << 20)


@pytest.mark.parametrize("second", [None, (0.0, 0.0, 0.0)])
def test_images_count(dataset, second):
    """Tiles by what a bank really holds; the files' pixels as long as they cannot be released for a larger octree."""
    bank = TileBank(dataset, (1.0, 1.0, 1.0), 1, second)
    held = [
        *bank.pixels,
        *(bank.second_pixels if second else ()),
        bank.row,
        bank.image,
        bank.tile,
        bank.is_background,
        bank.foreground_tiles,
        bank.background_tiles,
    ]
    foreground = len(bank.foreground_tiles) / len(bank.row)
    share = OtherMemory(foreground, held_out_bytes=77, backgrounds=1 if second is None else 2)
    tiles = sum(array.nbytes for array in held)
    small, large = (estimate_training(dataset, leaves, 1, share).images for leaves in (0, 10**6))
    assert large - 77 == pytest.approx(tiles, rel=0.1)
    assert small == large + dataset.nbytes
    # An octree that is there has next to it what is there.
    assert estimate_training(dataset, 10**6, 1, share, vertices=10**6).images == small
    fixed = dataclasses.replace(dataset, images=dataset.images[:])  # nothing to read these from again
    assert estimate_training(fixed, 10**6, 1, share).images == small


def test_a_field_counts(dataset):
    """Next to a large octree by what it leaves behind, whatever its size; next to a small one by its distillation."""

    def estimates(leaves):
        return (estimate_training(dataset, leaves, 1, OtherMemory(1.0, 77, field=field)) for field in (False, True))

    (plain, field), (larger, larger_field) = estimates(10**7), estimates(2 * 10**7)
    assert field.peak - plain.peak == larger_field.peak - larger.peak > 0 and "distil" not in plain.sentence()
    (plain, small), (_, smaller) = estimates(1000), estimates(1)
    assert small.peak == smaller.peak > field.peak - larger.peak + plain.peak
    assert small.distillation > dataset.nbytes + 77 and f"before that {gib(small.distillation)}" in small.sentence()


def test_an_octree_is_bounded_by_its_surface_the_pixels_and_its_start():
    plenty, view = 10**9, 800 * 800
    assert largest_octree([6], plenty) == 8**6  # full from the start, and never more than all cells
    assert largest_octree([5, 9, 10], 100) == 8**5  # what it begins with, however few pixels
    for level in (6, 9):  # a surface: four times as many cells for half the side, in whichever stage they are finest
        assert largest_octree([2, level + 1], plenty) == 4 * largest_octree([2, level], plenty) < 8 ** (level + 1)
        assert largest_octree([2, level, 4], plenty) == largest_octree([2, level], plenty)
    bound = largest_octree([5, 9, 10], view)
    assert view < bound < largest_octree([5, 9, 10], plenty)
    assert largest_octree([5, 9, 10], 2 * view) == pytest.approx(2 * bound)
    assert 8**5 < largest_octree([5, 9, 10], view, photographs=True) < bound


def test_splits_stay_within_the_bound(capsys):
    split = np.array([True, True, False, True, True])
    gain = np.array([1.0, 3.0, 9.0, 2.0, 3.0])
    assert splits_within(split, gain, None) is split and splits_within(split, gain, 33) is split
    assert not capsys.readouterr().out
    assert splits_within(split, gain, 32).tolist() == [False, True, False, True, True]
    assert splits_within(split, gain, 19).tolist() == [False, True, False, False, True]
    assert "memory allows 19 leaves: 2 of 4" in capsys.readouterr().out
    assert not splits_within(split, gain, 4).any()


def test_second_moments_begin_on_a_cache_line():
    octree = make_sphere_octree(6)
    crooked = np.empty(octree.values.size + 16, np.float32)
    crooked = crooked[(-crooked.ctypes.data % 64) // 4 + 4 :][: octree.values.size].reshape(octree.values.shape)
    crooked[:] = 1
    for state in (ops.TrainState(octree), ops.TrainState(octree, crooked)):
        assert state.moments.ctypes.data % 64 == 0
    assert (state.moments == 1).all()


def test_released_images_are_read_again(tiny_scene):
    dataset = load_dataset(tiny_scene, "train")
    before = [image.copy() for image in dataset.images]
    dataset.release()
    assert dataset.can_reload and dataset.nbytes == 0 and len(dataset.images) == len(dataset) and dataset.nbytes == 0
    assert all(np.array_equal(a, b) for a, b in zip(dataset.images, before, strict=True))
    assert dataset.nbytes == sum(image.nbytes for image in before)
    assert dataset.images[0] is dataset.images[0]  # and not once more for whoever asks next
    moved = dataclasses.replace(dataset, scene=dataset.scene)
    moved.release()  # the images of both, and both can read them again
    assert dataset.nbytes == 0 and np.array_equal(dataset.images[3], before[3]) and moved.nbytes > 0
    part = dataclasses.replace(dataset, images=dataset.images[:2])
    part.release()  # its images are not those of the files: it keeps them
    assert len(part.images) == 2 and not part.can_reload and part.nbytes > 0


def test_released_images_give_their_memory_back(tmp_path):
    """tracemalloc sees numpy's memory. The store held the only references."""
    write_scene(tmp_path, {"train": 8, "val": 1}, size=120)
    tracemalloc.start()
    try:
        dataset = load_dataset(tmp_path, "train")
        held, nbytes = tracemalloc.get_traced_memory()[0], dataset.nbytes
        dataset.release()
        assert held - tracemalloc.get_traced_memory()[0] > 0.99 * nbytes == 0.99 * 8 * 120 * 120 * 4
    finally:
        tracemalloc.stop()


def test_a_pyramid_level_need_not_stand_beside_what_is_made_of_it(dataset):
    """tracemalloc sees numpy's memory: of the level, 3 bytes a pixel, only an image at a time is there."""
    pictures = [np.zeros((200, 200, 4), np.uint8)] * len(dataset)
    large = dataclasses.replace(dataset, images=pictures, threads=1)
    tracemalloc.start()
    try:
        sums = large.pyramid((1.0, 1.0, 1.0), 1, lambda image: image.sum(axis=(0, 1)))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert len(sums) == len(dataset) and peak < 3 * 200 * 200 * len(dataset)


def many_photographs(folder, n):
    """A transforms.json of ``n`` photographs of 40x30, names of one file."""
    lens = Intrinsics(40, 30, 50.0, 50.0, 20.0, 15.0)
    picture = np.random.default_rng(0).integers(0, 255, (30, 40, 3), np.uint8)
    Image.fromarray(picture).save(folder / "0000.jpg")
    frames = []
    for i, camera in enumerate(orbit(n, center=(0, 0, 0), radius=3.0, elevation_deg=20.0, intrinsics=lens)):
        if i:
            os.link(folder / "0000.jpg", folder / f"{i:04d}.jpg")
        frames.append({"file_path": f"{i:04d}.jpg", "transform_matrix": camera.c2w.tolist()})
    shared = {"w": 40, "h": 30, "fl_x": 50.0, "fl_y": 50.0, "cx": 20.0, "cy": 15.0}
    (folder / "transforms.json").write_text(json.dumps(shared | {"frames": frames}))
    return folder


def test_many_photographs_are_shrunk_as_many_at_a_time_as_there_are_threads(tmp_path, monkeypatch):
    """Bytes are counted, not megabytes of pictures made: at full size one picture for each thread."""
    held, most, lock, read = [0], [0], threading.Lock(), decoding.read_pixels

    def count(more):
        with lock:
            held[0] += more
            most[0] = max(most[0], held[0])

    def counted(*arguments):
        pixels = read(*arguments)
        count(pixels.nbytes)
        weakref.finalize(pixels, count, -pixels.nbytes)
        return pixels

    monkeypatch.setattr(decoding, "read_pixels", counted)
    data = load_dataset(many_photographs(tmp_path, 150), "train", downscale=2, threads=3)
    assert data.nbytes == len(data) * 20 * 15 * 3 and len(data) > 120 and held[0] == 0
    assert 0 < most[0] <= 3 * 40 * 30 * 3


@pytest.mark.parametrize("share", [0.5, 2.0])
def test_what_photographs_keep_is_what_is_stated(tmp_path, share):
    data = load_dataset(many_photographs(tmp_path, 40), "train")
    whole = Photographs(data)
    bound = int(share * estimate_bytes(whole.cameras, FACTORS))
    photographs = Photographs(data, most_bytes=bound)
    for factor in FACTORS:
        photographs.level(factor)
    stated, kept = photographs_held(data, photographs, FACTORS)
    assert 0.9 * stated < data.nbytes + photographs.nbytes <= stated and kept == pytest.approx(min(1, share), rel=1e-3)


def test_half_of_the_free_memory_is_for_photographs():
    assert photographs_bytes(10 << 30) == 5 << 30


@pytest.mark.skipif(native() is None, reason="the reference path takes minutes")
def test_photographs_are_decoded_once(tmp_path, monkeypatch):
    """Splats keep the photographs that they undistort: released beside them, the table of photographs would read them again,
    and hold them twice (1.83 GiB for 2,000 small ones where 1.27 was said)."""
    cameras = facing_cameras(9, Intrinsics(48, 32, 46.0, 46.0, 24.0, 16.0, lens=BrownConrady(k1=0.02)))
    scene = write_photographs(tmp_path / "scene", cameras, [draw(c, trace_planes, 1) for c in cameras])
    reads, get = [], ImageStore.get

    def counted(self):
        reads.append(len(self)) if self._images is None else None
        return get(self)

    monkeypatch.setattr(ImageStore, "get", counted)
    start(settings(scene, tmp_path / "run", representation="splats", init="random", splats={"steps": 3}))
    assert (tmp_path / "run" / "photographs.csv").is_file()
    assert 7 not in reads  # of nine, two are held out
