"""Sentences on what structure from motion came to."""

import pytest

from nerfvol.poses.verdict import components, failure, remarks

NAMES = [f"{i:02d}.jpg" for i in range(12)]


def result(links, registered, features=1500, parallax=0.05, **more):
    return {
        "features": dict.fromkeys(NAMES, features), "links": links, "registered": registered,
        "motion": {"good_pairs": len(links), "parallax": parallax}, "error_pixels": 0.6, "cameras": [], **more,
    }  # fmt: skip


def chain(first, last):
    return [(NAMES[i], NAMES[i + 1], 50) for i in range(first, last)]


def test_groups_hang_together_by_verified_pairs():
    links = [*chain(0, 6), *chain(7, 11), (NAMES[6], NAMES[7], 9)]
    assert [len(group) for group in components(NAMES, links)] == [7, 5]


@pytest.mark.parametrize("got,sentence", [
    (result([*chain(0, 4), *chain(5, 8), *chain(9, 11)], NAMES[:5]), r"5 of 12 .*\(00.jpg, .*04.jpg\); "
     r"4 more form a group .*\(05.jpg, 06.jpg, 07.jpg, 08.jpg\); 3 are in smaller groups: take pictures between"),
    (result([], []), "no two of the 12 photographs share enough"),
    (result([], [], features=80), "80 features each where 1,000 are usual: blur or bare walls"),
    (result(chain(0, 11), NAMES, parallax=0.001), "turning on the spot"),
    (result(chain(0, 11), NAMES[:4]), "only 4 of 12 photographs could be placed.*04.jpg, .* and 3 more"),
])  # fmt: skip
def test_failures(got, sentence):
    import re

    assert re.search(sentence, failure(got, NAMES) or "")


def test_all_blurred_is_called_so():
    assert "they are blurred" in (failure(result([], [], features=80), NAMES, 0.05) or "")


def test_half_is_enough_and_the_rest_is_named():
    got = result(chain(0, 11), NAMES[:8])
    assert failure(got, NAMES) is None
    assert remarks(got, NAMES)[0].startswith("8 of 12 photographs were placed") and "08.jpg" in remarks(got, NAMES)[0]


def test_a_group_that_is_left_out_is_named():
    got = result([*chain(0, 6), *chain(7, 11)], NAMES[:7])
    assert failure(got, NAMES) is None
    said = remarks(got, NAMES)[0]
    assert "7 of 12 photographs hang together (00.jpg, 01.jpg" in said and "5 more form a group" in said
    assert "(07.jpg, 08.jpg, 09.jpg, 10.jpg, 11.jpg)" in said


@pytest.mark.parametrize("camera,sentence", [
    ({"lens": "SIMPLE_RADIAL", "width": 1000, "height": 800, "focal": 90.0, "parameters": [90.0, 0, 0, 0.0]}, "160 degrees"),
    ({"lens": "OPENCV", "width": 1000, "height": 800, "focal": 900.0, "parameters": [900] * 4 + [-0.7, 0, 0, 0]}, "fisheye"),
])  # fmt: skip
def test_cameras_that_cannot_be(camera, sentence):
    assert sentence in " ".join(remarks(result(chain(0, 11), NAMES, cameras=[camera]), NAMES))


def test_a_large_error_is_said():
    assert "2.4 pixels" in remarks(result(chain(0, 11), NAMES, error_pixels=2.4), NAMES)[0]
