"""The schedule of splats: what holds for every number of seconds and every size of photographs."""

import math

import numpy as np
import pytest

from nerfvol.training.splat_schedule import (
    COARSEST_SIDE,
    GROWTH_STARTS,
    PIXELS_PER_SPLAT,
    Schedule,
    make_schedule,
    saved_schedule,
)

SECONDS = [0.0, 1.0, 8.0, 9.5, 15.0, 20.0, 59.0, 60.0, 100.0, 269.0, 600.0, 1799.0, 1800.0, 7200.0]
SIDES = [1, 24, 99, 100, 199, 200, 399, 400, 800, 1600, 4000, 10_000]
STEPS = np.linspace(0, 1, 101)


def schedules():
    return [
        (seconds, side, photographs, make_schedule(seconds, [(side, max(1, side // 2))] * 40, photographs))
        for seconds in SECONDS
        for side in SIDES
        for photographs in (True, False)
    ]


def test_stages_halve_down_to_the_whole_photographs_and_end_in_order():
    for seconds, side, photographs, s in schedules():
        what = f"{seconds} s, {side} pixels, photographs {photographs}"
        assert s.factors == tuple(2**k for k in range(len(s.factors) - 1, -1, -1)), what
        assert len(s.ends) == len(s.factors) and s.ends[-1] == 1, what
        assert all(0 < a < b for a, b in zip(s.ends, s.ends[1:], strict=False)), what
        assert GROWTH_STARTS < s.grown < 1, what
        state = {"factors": s.factors, "ends": s.ends, "most": s.most, "grown": s.grown, "steps_of_stages": s.steps}
        assert saved_schedule(state) == s


def test_surfaces_begin_with_a_half():
    """What splats begin with as surfaces is finer than smaller pictures; else the schedule is the same."""
    for seconds, side, photographs, s in schedules():
        of = s.of_surfaces()
        assert of.factors == s.factors[-2:], f"{seconds} s, {side} pixels, photographs {photographs}"
        assert (of.ends, of.steps) == (s.ends[-2:], s.steps[-1:] if len(s.factors) > 1 else ())
        assert (of.most, of.grown) == (s.most, s.grown)
        state = {
            "factors": of.factors,
            "ends": of.ends,
            "most": of.most,
            "grown": of.grown,
            "steps_of_stages": of.steps,
        }
        assert saved_schedule(state) == of


@pytest.mark.parametrize(
    "side, factors",
    [(1, (1,)), (24, (1,)), (199, (1,)), (200, (2, 1)), (399, (2, 1)), (400, (4, 2, 1)), (800, (8, 4, 2, 1)),
     (1600, (16, 8, 4, 2, 1)), (4000, (32, 16, 8, 4, 2, 1)), (10**6, (64, 32, 16, 8, 4, 2, 1))],
)  # fmt: skip
def test_the_smallest_photographs_have_a_hundred_pixels_along_the_longer_side(side, factors):
    """64 is the largest factor that the pyramid makes."""
    for size in ((side, 1), (1, side)):
        s = make_schedule(60.0, [(1, 1), size], True)
        assert s.factors == factors
        assert s.factors[0] in (1, 64) or side / s.factors[0] >= COARSEST_SIDE


def test_small_photographs_take_a_smaller_share_of_a_longer_run():
    """A stage needs steps, not a share; and full size gets the most of a long run."""
    for side in SIDES:
        of = [make_schedule(seconds, [(side, side)] * 40, True) for seconds in SECONDS]
        for a, b in zip(of, of[1:], strict=False):
            assert all(x >= y for x, y in zip(a.ends, b.ends, strict=True)) and a.grown >= b.grown


def test_a_stage_ends_by_its_share_or_by_its_steps_and_the_last_one_never():
    for _, _, _, s in schedules():
        last = len(s.factors) - 1
        assert len(s.steps) == last and not s.is_over(last, 1.0, 10**9)
        for k, (end, steps) in enumerate(zip(s.ends, s.steps, strict=False)):
            assert s.is_over(k, end, 0) and not s.is_over(k, math.nextafter(end, 0), steps - 1)
            assert s.is_over(k, 0.0, steps) == (steps >= 0) and not s.is_over(k, 0.0, steps - 1)


def test_more_seconds_give_more_splats_but_no_more_than_pixels_can_teach():
    for side in SIDES:
        for photographs in (True, False):
            most = [make_schedule(seconds, [(side, side)] * 40, photographs).most for seconds in SECONDS]
            assert most == sorted(most) and most[0] >= 1000
            assert most[-1] <= max(1000, 40 * side * side // PIXELS_PER_SPLAT)
    many = [make_schedule(seconds, [(800, 800)] * 40, True).most for seconds in (8, 15, 30, 60, 120, 600, 1800)]
    assert all(b > 1.2 * a for a, b in zip(many, many[1:], strict=False))
    for sizes in ([(800, 600)] * 3 + [(80, 60)] * 9, [(80, 60)] * 9 + [(800, 600)] * 3):  # pixels count, not pictures
        pixels = sum(width * height for width, height in sizes)
        assert make_schedule(1800, sizes, True).most == pixels // PIXELS_PER_SPLAT


def test_an_asked_for_number_of_splats_is_that_number():
    for most in (1, 777, 10**7):
        assert make_schedule(60.0, [(24, 24)] * 3, True, most).most == most


def test_growth_is_exponential_from_its_start_to_its_end_and_never_beyond_the_most():
    for _, _, _, s in schedules():
        for start in (1, 17, s.most, s.most + 5):
            planned = [s.planned(start, p) for p in STEPS]
            assert planned == sorted(planned) and planned[0] in (start, start - 1)
            assert max(planned) <= max(s.most, start)
            if start < s.most:
                assert planned[-1] in (s.most, s.most - 1)  # a float's last bit
                half = s.planned(start, (GROWTH_STARTS + s.grown) / 2)
                assert half == pytest.approx(math.sqrt(start * s.most), abs=1 + 1e-9 * s.most)
            assert s.planned(start, GROWTH_STARTS) in (start, start - 1)


@pytest.mark.parametrize("change", [
    {"factors": (2, 2)}, {"factors": ()}, {"factors": (3, 1)}, {"factors": (4, 1)}, {"ends": (0.5,)}, {"ends": (0.5, 0.9)},
    {"ends": (1.5, 1.0)}, {"ends": (float("nan"), 1.0)}, {"most": 0}, {"grown": 0.0}, {"grown": float("nan")},
    {"factors": "ab"}, {"steps_of_stages": (1, 2)}, {"steps_of_stages": (-1,)}, {"most": "many"}, {"ends": None},
])  # fmt: skip
def test_a_checkpoint_without_a_schedule(change):
    state = {"factors": (2, 1), "ends": (0.5, 1.0), "most": 100, "grown": 0.5, "steps_of_stages": (7,)}
    assert saved_schedule(state) == Schedule((2, 1), (0.5, 1.0), 100, 0.5, (7,))
    with pytest.raises((LookupError, TypeError, ValueError)):
        saved_schedule(state | change)
    for name in state:
        with pytest.raises(LookupError):
            saved_schedule({k: v for k, v in state.items() if k != name})


def test_a_short_run_grows_in_more_rounds():
    """6 s of 400x400 have 650 steps before the last size, a minute 3,200; where no step is bounded the setting stands."""
    sizes = [(400, 400)] * 100
    short, minute = (make_schedule(seconds, sizes, photographs=False) for seconds in (6.0, 60.0))
    assert short.grow_every(60) == sum(short.steps) // 20 and 30 <= short.grow_every(60) <= 35
    assert minute.grow_every(60) == 60 and short.grow_every(7) == 7
    assert make_schedule(1.0, sizes, photographs=False).grow_every(60) == 30
    assert Schedule((1,), (1.0,), 10, 0.5).grow_every(60) == 60
