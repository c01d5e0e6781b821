"""How quick a page is: python tools/page_bench.py scene.html [MODEL]. Chromium and playwright must be installed.

Prints the page's bytes next to the model's, seconds from opening to the first picture that is drawn, pictures a second and
milliseconds from an event to its picture while the scene is dragged, and seconds of a whole picture.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import time
from pathlib import Path
from typing import Any

DRAG = """async (seconds) => {
  const canvas = document.getElementById("canvas"), box = canvas.getBoundingClientRect();
  const send = (type, x, y) => canvas.dispatchEvent(new PointerEvent(type, {pointerId: 1, buttons: 1, bubbles: true,
    clientX: box.left + box.width / 2 + x, clientY: box.top + box.height / 2 + y}));
  const drawing = nerfvol.drawing, started = performance.now();
  send("pointerdown", 0, 0);
  await new Promise((done) => {
    const step = () => {
      const t = (performance.now() - started) / 1000;
      if (t > seconds) return done();
      send("pointermove", 200 * Math.sin(t), 60 * Math.sin(1.7 * t));
      requestAnimationFrame(step);
    };
    step();
  });
  send("pointerup", 0, 0);
  const from = started + 1000 * Math.min(1.5, seconds / 3);
  const kept = drawing.stats.times.map((t, i) => [t, drawing.stats.latency[i]])
    .filter(([t]) => t > from && t < started + 1000 * seconds);
  const middle = kept.map((k) => k[1]).sort((a, b) => a - b)[Math.floor(kept.length / 2)];
  return {rate: kept.length / (seconds - (from - started) / 1000), latency: middle, width: drawing.canvas.width,
    height: drawing.canvas.height, lod: drawing.lod};
}"""


def chromium() -> str | None:
    """A Chromium of this machine."""
    names = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
    return next((path for name in names if (path := shutil.which(name))), None)


def measure(page: Any, seconds: float) -> dict[str, Any]:
    """Figures of an opened page."""
    wait(page, "nerfvol.drawing && nerfvol.drawing.stats.first")
    out: dict[str, Any] = {"first": page.evaluate("nerfvol.drawing.stats.first") / 1000}
    wait(page, "nerfvol.drawing.stats.still")
    out |= page.evaluate(DRAG, seconds)
    wait(page, "nerfvol.drawing.stats.still && !nerfvol.drawing.frame")
    whole = """async () => { const start = performance.now();
      await nerfvol.drawing.picture(nerfvol.first, 800, 800, [1, 1, 1], 0); return (performance.now() - start) / 1000; }"""
    out["whole"] = min(page.evaluate(whole) for _ in range(2))
    return out


def wait(page: Any, condition: str, seconds: float = 60) -> None:
    """Until ``condition``, a JavaScript expression, holds; the page's policy forbids playwright's own way."""
    end = time.monotonic() + seconds
    while not page.evaluate(f"Boolean({condition})"):
        if time.monotonic() > end:
            raise SystemExit(f"the page did not come to {condition}: {page.inner_text('#status')}")
        time.sleep(0.03)


def main() -> int:
    """Prints the figures; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("page", type=Path)
    parser.add_argument("model", type=Path, nargs="?")
    parser.add_argument("--seconds", type=float, default=5, help="of dragging")
    parser.add_argument("--size", default="1200x800", help="of the window")
    given = parser.parse_args()
    from playwright.sync_api import sync_playwright

    width, height = map(int, given.size.split("x"))
    with sync_playwright() as p:
        browser = p.chromium.launch(executable_path=chromium(), args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": width, "height": height})
        page.goto(given.page.resolve().as_uri())
        r = measure(page, given.seconds)
        workers = page.evaluate("nerfvol.drawing.workers.length")
        browser.close()
    size = given.page.stat().st_size
    if given.model:
        model = given.model.stat().st_size
        print(
            f"page {size / 1e6:.2f} MB, model {model / 1e6:.2f} MB: 1.36 x model + {(size - 1.36 * model) / 1e6:.2f} MB"
        )
    print(f"first picture {r['first']:.2f} s; window {given.size}, {workers} workers")
    shown = f"{r['rate']:.1f} pictures/s of {r['width']}x{r['height']} at LOD {r['lod']:.2f}"
    print(f"dragging: {shown}, {r['latency']:.0f} ms from event to pixels")
    print(f"whole picture 800x800: {r['whole']:.2f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
