"""Pairs to match: all where cheap, else neighbours and what looks alike; and whether a camera only turned."""

import numpy as np
import pytest

from nerfvol.poses import pairs as pairs_module
from nerfvol.poses.pairs import alike, choose_pairs, in_order
from nerfvol.poses.turning import parallax


def places(n, seed=0, revisit=()):
    """Descriptors of pictures on a walk: each shows half of what the one before shows; of ``revisit`` (i, j), j shows i's."""
    rng = np.random.default_rng(seed)
    things = rng.integers(0, 255, (60 * (n + 1), 128), dtype=np.uint8)
    shown = [things[60 * i : 60 * i + 120] for i in range(n)]
    for i, j in revisit:
        shown[j] = shown[i]
    return [np.clip(s + rng.integers(-3, 4, s.shape), 0, 255).astype(np.uint8) for s in shown]


def test_all_pairs_where_that_is_cheap():
    chosen, how = choose_pairs(places(8))
    assert len(chosen) == 28 and how == "all pairs" and all(i < j for i, j in chosen)


def test_names_are_in_the_order_of_their_numbers():
    names = ["IMG_10.jpg", "IMG_9.jpg", "b2.png", "b10.png", "a.jpg"]
    assert sorted(names, key=in_order) == ["a.jpg", "b2.png", "b10.png", "IMG_9.jpg", "IMG_10.jpg"]


def test_a_walk_that_comes_back_is_closed(monkeypatch):
    monkeypatch.setattr(pairs_module, "ALL_PAIRS", 100)
    chosen, how = choose_pairs(places(40, revisit=[(3, 37)]))
    assert "alike" in how and (3, 37) in chosen and (10, 11) in chosen and len(chosen) < 40 * 39 / 2
    assert chosen == choose_pairs(places(40, revisit=[(3, 37)]))[0]


def test_pictures_without_features_look_like_nothing():
    shown = places(30)
    shown[4] = np.zeros((0, 128), np.uint8)
    assert all(np.isfinite(pair).all() for pair in alike(shown))


def seen_from(points, rotation, centre, focal):
    local = (points - centre) @ rotation.T
    return focal * local[:, :2] / local[:, 2:]


def turned(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])


@pytest.mark.parametrize("focal", [0.7, 1.13])
def test_parallax_of_a_turn_and_of_a_step(focal):
    """Noise of a pixel of 1000 is what a turn leaves; a step of a tenth at depth 2 to 5 leaves its spread of parallax."""
    rng = np.random.default_rng(1)
    points = np.stack([*rng.uniform(-1, 1, (2, 400)), rng.uniform(2, 5, 400)], 1)

    def pairs(step):
        made = []
        for k in range(1, 8):
            a = seen_from(points, np.eye(3), 0, focal)
            b = seen_from(points, turned(0.05 * k), np.array([step * k, 0, 0]), focal)
            made.append((a + rng.normal(0, 5e-4, a.shape), b + rng.normal(0, 5e-4, b.shape)))
        return made

    assert parallax(pairs(0)) < 0.003 < parallax(pairs(0.05))
    assert parallax([]) == -1
