"""Nothing that does not fit reaches a kernel; and without kernels everything still runs, saying so once."""

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
import torch

from nerfvol import native as native_module
from nerfvol.kernels import on_torch, ops
from nerfvol.octree.tree import Octree

RATES = ops.Rates(0.1, 0.1, 0.1)


@pytest.fixture
def octree() -> Octree:
    return Octree.from_leaves([1, 1], [[0, 0, 0], [1, 1, 1]], (-1, -1, -1), 2.0, 1)


def rays(n: int = 64) -> tuple[np.ndarray, np.ndarray]:
    return np.full((-(-n // 64), 3), -2, np.float32), np.full((n, 3), 3**-0.5, np.float32)


def batch(n: int = 64, **change) -> ops.Batch:
    o, d = rays(n)
    arrays = dict(rays_o=o, rays_d=d, target=np.zeros((n, 3), np.float32), weight=np.ones(n, np.float32)) | change
    return ops.Batch(**arrays)


def every_operator(octree: Octree, o, d, background=(1, 1, 1), eps=0.0):
    values = torch.from_numpy(octree.values)
    n = len(d)
    options = ops.LossOptions(background, early_stop_eps=eps)
    zeros = np.zeros((n, 3), np.float32), np.ones(n, np.float32)
    yield lambda: ops.render_rays(octree, o, d, background, eps)
    yield lambda: on_torch.render_values(octree, values, o, d, background, eps)
    yield lambda: ops.train_step(octree, ops.TrainState(octree), ops.Batch(o, d, *zeros), options, RATES, 0.01)
    yield lambda: on_torch.loss_gradient(octree, values, ops.Batch(o, d, *zeros), options)


def spoiled(a: np.ndarray, value: float) -> np.ndarray:
    a = a.copy()
    a[len(a) // 2, 1] = value
    return a


BAD_RAYS = {
    "directions with two components": lambda o, d: (o, d[:, :2]),
    "directions in one row": lambda o, d: (o, d.ravel()),
    "origins with two components": lambda o, d: (o[:, :2], d),
    "too many origins": lambda o, d: (np.repeat(o, 5, 0), d),
    "too few origins": lambda o, d: (o[:-1], d),
    "an origin that is NaN": lambda o, d: (spoiled(o, np.nan), d),
    "an origin a ray, one of them NaN": lambda o, d: (spoiled(o.repeat(64, 0)[:150], np.nan), d),
    "an infinite origin": lambda o, d: (spoiled(o, np.inf), d),
    "a direction that is NaN": lambda o, d: (o, spoiled(d, np.nan)),
    "an infinite direction": lambda o, d: (o, spoiled(d, -np.inf)),
}


@pytest.mark.parametrize("what", BAD_RAYS)
@pytest.mark.parametrize("operator", range(4))
def test_rays_that_make_no_sense_are_refused(octree, operator, what):
    o, d = BAD_RAYS[what](*rays(150))
    with pytest.raises(ValueError, match="rays_[od]"):
        list(every_operator(octree, o, d))[operator]()


@pytest.mark.parametrize("background", [(1, 1), (1, 1, 1, 1), (0, np.nan, 0), (np.inf, 0, 0), ()])
@pytest.mark.parametrize("operator", range(4))
def test_backgrounds_that_make_no_sense_are_refused(octree, operator, background):
    with pytest.raises(ValueError, match="background"):
        list(every_operator(octree, *rays(), background))[operator]()


@pytest.mark.parametrize("eps", [-0.1, 1.0, np.nan, np.inf])
@pytest.mark.parametrize("operator", range(4))
def test_thresholds_that_make_no_sense_are_refused(octree, operator, eps):
    with pytest.raises(ValueError, match="early_stop_eps"):
        list(every_operator(octree, *rays(), eps=eps))[operator]()


@pytest.mark.skipif(native_module.native() is None, reason="no compiled kernels")
@pytest.mark.parametrize("degree, shape", [(1, (15, 8)), (1, (14, 16)), (1, (16, 16)), (3, (15, 16)), (0, (15, 64))])
def test_values_of_another_shape_are_refused(degree, shape):
    octree = Octree.from_leaves([1, 1], [[0, 0, 0], [1, 1, 1]], (-1, -1, -1), 2.0, degree)
    octree.values = np.zeros(shape, np.float32)
    with pytest.raises(ValueError, match="values"):
        ops.render_rays(octree, *rays())
    with pytest.raises(ValueError):
        ops.train_step(octree, ops.TrainState(octree), batch(), ops.LossOptions(), RATES, 0.01)


def test_values_of_another_octree_are_refused(octree):
    with pytest.raises(ValueError, match="values"):
        on_torch.render_values(octree, torch.zeros(3, 16), *rays())


def test_other_precisions_and_layouts_are_converted(octree):
    """float64, Fortran order, slices: the same image."""
    octree.density = 2.0
    o, d = rays()
    expected = ops.render_rays(octree, o, d)["rgb"]
    wide = np.asfortranarray(np.column_stack([d, d])).astype(np.float64)[:, :3]
    assert np.array_equal(ops.render_rays(octree, o.astype(np.float64), wide)["rgb"], expected)
    assert np.array_equal(ops.render_rays(octree, torch.from_numpy(o), torch.from_numpy(d))["rgb"], expected)


@pytest.mark.parametrize(
    "change",
    [
        {"target": np.zeros((63, 3), np.float32)},
        {"target": np.zeros((64, 4), np.float32)},
        {"weight": np.ones(65, np.float32)},
        {"weight": np.ones((64, 1), np.float32)},
    ],
)
def test_batches_that_do_not_fit_their_rays_are_refused(octree, change):
    with pytest.raises(ValueError, match="do not fit"):
        ops.train_step(octree, ops.TrainState(octree), batch(**change), ops.LossOptions(), RATES, 0.01)
    with pytest.raises(ValueError, match="do not fit"):
        on_torch.loss_gradient(octree, torch.from_numpy(octree.values), batch(**change), ops.LossOptions())
    with pytest.raises(ValueError, match="do not fit"):
        ops.leaf_statistics(octree, batch(**change), ops.LossOptions(), 0.01, ops.LeafStatistics(octree))


@pytest.mark.parametrize("name", ["moments", "slots", "max_weight", "error", "footprint"])
def test_the_state_of_another_octree_is_refused(octree, name):
    """The kernels write to these arrays: one that is too short would be memory that belongs to someone else."""
    for spoil in (lambda a: a[:-1], lambda a: a.astype(np.float64)):
        state = ops.TrainState(octree)
        setattr(state, name, spoil(getattr(state, name)))
        with pytest.raises(ValueError, match=name):
            ops.train_step(octree, state, batch(), ops.LossOptions(), RATES, 0.01)
        if name not in ("moments", "slots"):
            with pytest.raises(ValueError, match=name):
                ops.leaf_statistics(octree, batch(), ops.LossOptions(), 0.01, state)
    with pytest.raises(ValueError, match="moments"):
        ops.TrainState(octree, np.zeros((3, 16), np.float32))


def test_moments_of_another_precision_are_kept_not_lost(octree):
    state = ops.TrainState(octree, np.zeros(octree.values.shape))
    ops.train_step(octree, state, batch(), ops.LossOptions(), RATES, 0.01)
    assert state.moments.any()


def test_unknown_outputs_builds_and_thread_counts_are_refused(octree):
    with pytest.raises(ValueError, match="colour"):
        ops.render_rays(octree, *rays(), outputs=("colour",))
    with pytest.raises(ValueError, match="choose from"):
        ops.set_isa("sse9")
    with pytest.raises(ValueError, match="threads"):
        ops.set_threads(0)


# ------------------------------------------------------------------ without the compiled module
WHOLE = """
    import warnings, numpy as np
    from nerfvol.kernels import ops
    from nerfvol.octree import Octree
    octree = Octree.from_leaves([1, 2], [[0, 0, 0], [2, 2, 2]], (-1, -1, -1), 2.0, 1)
    octree, _ = octree.subdivide([True, False])
    octree.density = 1.0
    o, d = np.full((2, 3), -2, np.float32), np.full((100, 3), 3**-0.5, np.float32)
    state = ops.TrainState(octree)
    batch = ops.Batch(o, d, np.zeros((100, 3), np.float32), np.full(100, 0.01, np.float32))
    options = ops.LossOptions(colour=0.1, distortion=0.1)
    reports = [ops.train_step(octree, state, batch, options, ops.Rates(.1, .1, .1), 0.01) for _ in range(3)]
    ops.leaf_statistics(octree, batch, options, 0.01, state)
    ops.release_arenas()
    assert ops.arena_bytes() == 0
    image = ops.render_rays(octree, o, d)
    assert [tuple(v.shape) for v in image.values()] == [(100, 3), (100,), (100,), (100,), (100, 3)]
    assert all(np.isfinite(v).all() for v in image.values())
    assert reports[2].squared_error < reports[0].squared_error and state.moments.any() and state.footprint.any()
    ops.set_threads(1)
    print(ops.isa(), ops.available_isas(), ops.get_threads(), round(float(image["opacity"][0]), 4))
"""


def run(code: str, **environment) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)],
        env={**os.environ, "OMP_NUM_THREADS": "1", **environment},
        capture_output=True,
        text=True,
        timeout=600,
    )


def test_everything_runs_on_the_reference_when_asked_and_in_silence():
    done = run(WHOLE, NERFVOL_REFERENCE="1", PYTHONWARNINGS="error::UserWarning")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("reference ['reference'] 1") and not done.stderr


def test_a_missing_module_is_said_once_and_everything_runs():
    hidden = "    import sys; sys.modules['_nerfvol_kernels'] = None\n"
    done = run(hidden + WHOLE, PYTHONWARNINGS="always", NERFVOL_REFERENCE="", NERFVOL_ISA="")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("reference")
    assert done.stderr.count("ReferencePathWarning") == 1
    assert "C++17 compiler" in done.stderr


@pytest.mark.skipif(native_module.native() is None, reason="no compiled kernels")
def test_compiled_kernels_run_without_torch():
    """Its import takes longer than rendering a picture and a fifth of a small run's memory."""
    whole_program = (
        "    import nerfvol.training.train, nerfvol.views, nerfvol.measure.scores, nerfvol.config.training as t\n"
        "    t.Config()\n"
    )
    done = run("    import sys; sys.modules['torch'] = None\n" + whole_program + WHOLE)
    assert done.returncode == 0, done.stderr


SHORT_OF_MEMORY = """
    import resource
    from pathlib import Path
    import numpy as np
    from nerfvol.kernels import ops
    from nerfvol.native import native
    ops.set_threads(3)
    codes = np.zeros(1 << 26, np.int64)  # 512 MiB that nobody touches
    few = codes[:1 << 16]
    assert native().distinct_codes(few).tolist() == [0]
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + (64 << 20), resource.getrlimit(resource.RLIMIT_AS)[1]))
    for _ in range(3):
        try:
            native().distinct_codes(codes)
        except MemoryError:
            print("short")
    print(native().distinct_codes(few).tolist())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="limits on address space are told by Linux")
@pytest.mark.skipif(native_module.native() is None, reason="no compiled kernels")
@pytest.mark.skipif("NERFVOL_EXPECT_KERNELS" in os.environ, reason="sanitizers reserve terabytes of addresses")
def test_what_fails_in_a_thread_is_an_exception_and_the_others_go_on():
    """A third of the codes is 171 MiB, which no thread gets of 64."""
    done = run(SHORT_OF_MEMORY)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["short"] * 3 + ["[0]"]


@pytest.mark.skipif(native_module.native() is None, reason="no compiled kernels")
def test_the_environment_chooses_the_build():
    code = "from nerfvol.kernels import ops; print(ops.isa())"
    assert run(code, NERFVOL_ISA="baseline").stdout.strip() == "baseline"
    assert "not available" in run(code, NERFVOL_ISA="sse9").stderr


@pytest.mark.skipif("NERFVOL_EXPECT_KERNELS" not in os.environ, reason="only on a build of its own")
def test_the_build_that_was_made_is_the_one_under_test():
    path = Path(native_module.native().__file__)
    assert path.parent == Path(os.environ["NERFVOL_EXPECT_KERNELS"])
    if path.parent.name == "sanitize":
        assert "asan" in Path("/proc/self/maps").read_text()
