"""The held-out views that a run with a time budget can still score."""

from __future__ import annotations

import time
from typing import Any

from nerfvol.datasets.dataset import Dataset, evenly
from nerfvol.kernels import ops
from nerfvol.measure.scores import evaluate, scored_views, summarised
from nerfvol.models import Model
from nerfvol.training.finishing import FEWEST_SCORED
from nerfvol.training.session import Run


def affordable_scores(run: Run, model: Model, held_out: Dataset) -> dict[str, Any]:
    """What measure.scores.evaluate returns of the held-out views that can be scored in what a time budget leaves.

    They are evenly chosen, FEWEST_SCORED at least, all where there is no budget.
    What a view takes is learnt from the first one, and from the last one where not all can be scored: the first also made what
    all share. Slow are the octrees and fields of photographs that had seconds only: they are fog.
    """
    budget = run.config.time_budget
    if budget is None:
        return evaluate(model, held_out, run.background)
    held_out = held_out.chosen(scored_views(held_out))
    total, rows, each = len(held_out), {}, 0.0

    def score(*views: int) -> None:
        scores = evaluate(model, held_out.chosen(views), run.background)
        rows.update(zip(views, scores["rows"], strict=True))

    def affordable(view: int) -> tuple[int, float]:
        """How many views of all, and the seconds that one takes, measured with ``view``."""
        started = time.perf_counter()
        score(view)
        drawing, both = rows[view]["seconds"], time.perf_counter() - started
        seconds = drawing + (both - drawing) / ops.get_threads()  # so many views are scored side by side
        return max(FEWEST_SCORED, len(rows) + int(max(0.0, budget - run.clock.elapsed()) / seconds)), seconds

    n, each = affordable(0)
    if n < total:
        n, each = affordable(total - 1)
    if n < total:
        run.say(f"a view takes {each:.1f} s to draw and score: {n} of the {total} held-out views are scored, evenly chosen, to "
                "keep near the time budget; nerfvol eval scores all")  # fmt: skip
    if rest := [i for i in evenly(total, min(n, total)) if i not in rows]:
        score(*rest)
    return summarised([rows[i] for i in sorted(rows)])
