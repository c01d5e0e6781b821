"""What few photographs come to, said before a run begins: held-out views of scenes that were measured."""

from __future__ import annotations

PHOTOGRAPHS = {3: 22.6, 6: 26.4, 9: 27.5, 12: 28.0}
"""Number of photographs -> dB of held-out ones: fern, evenly chosen of 17, 252x189, splats of 800 steps from a sweep."""
OBJECTS = {8: 25.6, 16: 28.1, 100: 32.3}
"""Number of views -> dB of held-out ones: lego, 400x400; a minute from a field, 16 views before one background
alone, and half a minute from fog."""


def few_views(n: int, photographs: bool) -> str | None:
    """A sentence for a person on what ``n`` training views of photographs or of an object let expect; None: they are enough to
    expect no less from them."""
    known = PHOTOGRAPHS if photographs else OBJECTS
    enough = max(known) if photographs else sorted(known)[-2] + 1
    if n >= enough:
        return None
    what = "photographs of a shelf of leaves, all from one side," if photographs else "a toy, seen from all around,"
    figures = ", ".join(f"{db:.1f} dB from {count}" for count, db in known.items())
    return (
        f"{n} training views are few: {what} had {figures}; what none or one of them sees is guessed, and more views "
        "between them gain more than more time"
    )
