"""Few photographs: what may be expected of them is said before a run, and only then."""

import pytest

from nerfvol.training.few_views import OBJECTS, PHOTOGRAPHS, few_views


@pytest.mark.parametrize("n,photographs,said", [
    (3, True, "22.6 dB from 3"), (11, True, "28.0 dB from 12"), (12, True, None), (4, False, "25.6 dB from 8"),
    (16, False, "28.1 dB from 16"), (17, False, None), (100, True, None),
])  # fmt: skip
def test_what_few_views_let_expect(n, photographs, said):
    sentence = few_views(n, photographs)
    assert sentence is None if said is None else sentence.startswith(f"{n} training views are few") and said in sentence
    known = list((PHOTOGRAPHS if photographs else OBJECTS).values())
    assert known == sorted(known)
