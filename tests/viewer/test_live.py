"""A training run that is looked at: its bits are those of one that is not, and there are editions of it."""

import threading
import time

import pytest

from nerfvol.training import train
from nerfvol.viewer.live import Live
from nerfvol.viewer.shown import Shown
from tests.fixtures import runs


class Slow(Live):
    """Waits for each edition, so that none is skipped."""

    def __call__(self, *step):
        self.join()
        super().__call__(*step)


@pytest.mark.parametrize("representation", ["octree", "splats"])
def test_editions_come_out_and_change_nothing(tiny_scene, tmp_path, representation):
    more = {"representation": representation}
    if representation == "splats":
        more["splats"] = {"steps": 40}
    config = runs.settings(tiny_scene, tmp_path / "seen", **more)
    shown = Shown("seen")
    live = Slow(shown, every=1e9)
    train.train(config, watch=live, say=lambda sentence: None)
    live.join()
    assert shown.edition.version >= (3 if representation == "octree" else 1)  # at first, and after each of two stages
    assert shown.edition.model.kind == representation and "running PSNR" in shown.edition.sentence
    plain = runs.settings(tiny_scene, tmp_path / "unseen", **more)
    train.train(plain, say=lambda sentence: None)
    name = f"{representation}.safetensors"
    assert (tmp_path / "seen" / name).read_bytes() == (tmp_path / "unseen" / name).read_bytes()


def test_pausing_is_no_training_time(tiny_scene, tmp_path, monkeypatch):
    """Whoever waits does so within what passes, and the clock leaves out all of it."""
    shown, stood, waited = Shown("paused"), [], []
    wait = shown.wait_while_paused

    def wait_while_paused(stopped):
        started = time.perf_counter()
        threading.Timer(0.3, shown.pause, (False,)).start()
        wait(stopped)
        waited.append(time.perf_counter() - started)

    monkeypatch.setattr(shown, "wait_while_paused", wait_while_paused)

    class Pausing(Live):
        def __call__(self, run, phase, began_stage):
            if phase.steps_done == 5:
                shown.training = True
                shown.pause(True)
                started, before = time.perf_counter(), run.clock.elapsed()
                super().__call__(run, phase, began_stage)
                counted = run.clock.elapsed() - before
                stood.append((counted, time.perf_counter() - started))
            else:
                super().__call__(run, phase, began_stage)

    live = Pausing(shown, every=1e9)
    train.train(runs.settings(tiny_scene, tmp_path / "run"), watch=live, say=lambda sentence: None)
    ((counted, passed),) = stood
    assert waited[0] >= 0.3 and passed - counted >= waited[0] - 1e-6  # an edition counts, standing still does not
    monkeypatch.undo()
    shown.pause(True)
    shown.wait_while_paused(lambda: True)  # Ctrl-C ends a pause


def test_an_edition_that_is_due_waits_for_the_one_before(monkeypatch):
    asked = []
    shown = Shown("x")
    monkeypatch.setattr(shown, "publish", lambda model, sentence: (asked.append(sentence), time.sleep(0.2)))
    monkeypatch.setattr("nerfvol.viewer.live.snapshot", lambda phase, metadata: object())

    class Phase:
        steps_done = 1
        size = staticmethod(lambda: "small")

    class Run:
        running = 0.1
        metadata = staticmethod(dict)

    live = Live(shown, every=1e9)
    live(Run, Phase, False)  # the first is due at once
    live(Run, Phase, True)  # a stage while that is on its way
    live.join()
    assert len(asked) == 1
    live(Run, Phase, False)  # comes out with the next step
    live.join()
    assert len(asked) == 2
    live(Run, Phase, False)
    live.join()
    assert len(asked) == 2
