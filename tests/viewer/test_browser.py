"""The page in a real browser, from a file: what it draws, how the camera moves, what it asks the network for."""

import base64
import json
import math

import numpy as np
import pytest

from nerfvol.cameras.paths import load_cameras
from nerfvol.export import export_model
from nerfvol.export.page import first_camera, write
from nerfvol.files.page import OPENING
from nerfvol.models import load_model
from tests.viewer.browser import DRAWN, launch, wait
from tests.viewer.scenes import ball, cloud_of_splats

WIDTH, HEIGHT = 480, 320


@pytest.fixture(scope="module")
def browser():
    playwright, browser = launch()
    yield browser
    browser.close()
    playwright.stop()


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pages")
    for name, model in (("octree", ball()), ("splats", cloud_of_splats(2))):
        write(model, folder / f"{name}.html")
    return folder


def opened(browser, path, width=WIDTH, height=HEIGHT, until=DRAWN):
    page = browser.new_page(viewport={"width": width, "height": height})
    page.asked, page.faults = [], []
    page.on("request", lambda request: page.asked.append(request.url))
    page.on(
        "console", lambda message: page.faults.append(message.text) if message.type in ("error", "warning") else None
    )
    page.on("pageerror", lambda error: page.faults.append(str(error)))
    page.goto(path.as_uri())
    wait(page, until)
    return page


@pytest.fixture(scope="module")
def page(browser, files):
    page = opened(browser, files / "octree.html")
    yield page
    page.close()


def camera(page) -> dict:
    return {k: np.array(v) for k, v in page.evaluate("nerfvol.camera").items()}


def axes(camera) -> np.ndarray:
    """Rows: right, up, back."""
    w, x, y, z = camera["rotation"]
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
        [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
        [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


@pytest.fixture
def fresh(page):
    page.evaluate("(nerfvol.camera = nerfvol.first, 0)")
    return page


PICTURE = """async ([width, height, output]) => {
  const { buffer } = await nerfvol.drawing.picture(nerfvol.camera, width, height, nerfvol.state.background, output);
  const pixels = buffer.getImageData(0, 0, width, height).data;
  let text = "";
  for (let i = 0; i < pixels.length; i += 8192) text += String.fromCharCode(...pixels.subarray(i, i + 8192));
  return btoa(text);
}"""


def picture(page, width, height, output=0) -> np.ndarray:
    data = base64.b64decode(page.evaluate(PICTURE, [width, height, output]))
    return np.frombuffer(data, np.uint8).reshape(height, width, 4)[..., :3] / 255


@pytest.mark.parametrize("name", ["octree", "splats"])
def test_the_picture_is_that_of_the_native_kernels_and_nothing_is_asked_for(browser, files, name):
    path = files / f"{name}.html"
    page = opened(browser, path)
    width, height = 203, 134
    model = load_model(path)
    # lod in pixels of the picture: the page's and the library's default are the same
    native = model.render(first_camera(model.metadata["orbit"], width, height), outputs=("rgb", "opacity", "normal"))
    shown = picture(page, width, height)
    assert -10 * math.log10(((shown - np.clip(native["rgb"], 0, 1)) ** 2).mean()) > 50
    assert -10 * math.log10(((picture(page, width, height, 1)[..., 0] - native["opacity"]) ** 2).mean()) > 50
    assert page.faults == []
    strangers = [url for url in page.asked if not url.startswith((path.as_uri(), "blob:", "data:"))]
    assert strangers == []
    page.close()


def test_what_is_on_the_screen_is_the_picture(fresh):
    wait(fresh, DRAWN)
    fresh.evaluate("(nerfvol.drawing.stats.still = false, nerfvol.camera = nerfvol.first, 0)")
    wait(fresh, "nerfvol.drawing.stats.still && !nerfvol.drawing.frame")
    data = fresh.evaluate("document.getElementById('canvas').toDataURL().split(',')[1]")
    from io import BytesIO

    from PIL import Image

    seen = np.asarray(Image.open(BytesIO(base64.b64decode(data))).convert("RGB")) / 255
    assert seen.shape == (HEIGHT, WIDTH, 3)
    assert np.abs(seen - picture(fresh, WIDTH, HEIGHT)).max() <= 1 / 255


def drag(page, dx, dy, button="left"):
    page.mouse.move(200, 150)
    page.mouse.down(button=button)
    page.mouse.move(200 + dx, 150 + dy)
    page.mouse.up(button=button)


def test_a_drag_turns_about_the_pivot(fresh):
    before = camera(fresh)
    drag(fresh, 80, -40)
    after = camera(fresh)
    turn = math.pi / HEIGHT
    assert np.allclose(after["pivot"], before["pivot"], atol=1e-12)
    azimuth = [math.atan2(c["position"][1], c["position"][0]) for c in (before, after)]
    assert math.remainder(azimuth[1] - azimuth[0] + 80 * turn, 2 * math.pi) == pytest.approx(0, abs=1e-9)
    elevation = [math.asin(c["position"][2] / 3.0) for c in (before, after)]
    assert elevation[1] - elevation[0] == pytest.approx(-40 * turn, abs=1e-9)  # dragged up: seen from lower
    back = axes(after)[2]
    assert np.allclose(back * 3.0, after["position"], atol=1e-9)  # still looks at the pivot


def test_a_right_drag_moves_what_is_at_the_pivot_with_the_pointer(fresh):
    before = camera(fresh)
    drag(fresh, 30, 20, "right")
    after = camera(fresh)
    focal = 0.5 * HEIGHT / math.tan(before["fov"] / 2)
    right, up, _ = axes(before)
    expected = (-30 * right + 20 * up) * 3.0 / focal
    assert np.allclose(after["position"] - before["position"], expected, atol=1e-9)
    assert np.allclose(after["pivot"] - before["pivot"], expected, atol=1e-9)


def test_the_wheel_goes_to_the_pointer(fresh):
    before = camera(fresh)
    fresh.mouse.move(300, 100)
    fresh.mouse.wheel(0, -100)
    wait(fresh, f"nerfvol.camera.position[0] !== {float(before['position'][0])!r}")
    after = camera(fresh)
    factor = math.exp(-0.12)
    focal = 0.5 * HEIGHT / math.tan(before["fov"] / 2)
    right, up, back = axes(before)
    anchor = before["position"] + 3.0 * ((300 - WIDTH / 2) / focal * right - (100 - HEIGHT / 2) / focal * up - back)
    assert np.allclose(after["position"], anchor + factor * (before["position"] - anchor), atol=1e-9)


def test_a_drag_gives_keys_to_the_view_without_a_frame_around_it(fresh):
    fresh.evaluate("document.activeElement.blur()")
    drag(fresh, 50, 10)
    assert fresh.evaluate("document.activeElement.id") == "canvas"
    by_keys = "document.querySelector('#canvas').matches(':focus-visible')"
    assert not fresh.evaluate(by_keys)
    fresh.keyboard.press("ArrowRight")
    assert fresh.evaluate(by_keys)


def test_keys_fly_turn_and_choose(fresh):
    fresh.focus("#canvas")
    before = camera(fresh)
    fresh.keyboard.down("w")
    fresh.keyboard.up("w")
    moved = camera(fresh)["position"] - before["position"]
    assert np.allclose(np.cross(moved, axes(before)[2]), 0, atol=1e-9) and moved @ axes(before)[2] < 0
    fresh.keyboard.press("r")
    assert np.allclose(camera(fresh)["position"], before["position"])
    fresh.keyboard.press("ArrowRight")
    assert math.atan2(*camera(fresh)["position"][1::-1]) == pytest.approx(
        math.atan2(*before["position"][1::-1]) - math.pi / 36
    )
    fresh.keyboard.press("3")
    assert fresh.evaluate("nerfvol.drawing.output") == 1
    fresh.keyboard.press("1")


def test_a_double_click_sets_the_pivot_on_what_is_seen(fresh):
    wait(fresh, "!nerfvol.drawing.frame")
    before = camera(fresh)
    fresh.mouse.dblclick(250, 150)
    wait(fresh, "nerfvol.camera.pivot.some((x) => x !== 0)")
    pivot = camera(fresh)["pivot"]
    assert 0.4 < np.linalg.norm(pivot) < 1  # the ball's near side
    focal = 0.5 * HEIGHT / math.tan(before["fov"] / 2)
    right, up, back = axes(before)
    ray = (250 - WIDTH / 2) / focal * right - (150 - HEIGHT / 2) / focal * up - back
    assert np.allclose(np.cross(pivot - before["position"], ray), 0, atol=1e-6)


def test_the_address_brings_the_view_back(browser, files, fresh):
    drag(fresh, 50, 10)
    wait(fresh, "location.hash.length > 10")
    fresh.wait_for_timeout(300)
    address, there = fresh.url, camera(fresh)
    other = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
    other.goto(address)
    here = camera(other)
    other.close()
    for key in there:
        assert np.allclose(here[key], there[key], atol=1e-5), key


def test_a_path_is_read_by_render_and_comes_back(fresh, tmp_path):
    fresh.evaluate("(nerfvol.state.keys.length = 0)")
    fresh.focus("#canvas")
    seen = []
    for dx in (0, 60, 60):
        if dx:
            drag(fresh, dx, 10)
        fresh.keyboard.press("k")
        seen.append(camera(fresh))
    path = fresh.evaluate("nerfvol.path")
    (tmp_path / "path.json").write_text(json.dumps(path))
    cameras = load_cameras(tmp_path / "path.json")
    assert len(cameras) == 4 * 30  # two gaps of two seconds
    for index, wanted in ((0, seen[0]), (-1, seen[2])):
        assert np.allclose(cameras[index].position, wanted["position"], atol=1e-9)
        assert np.allclose(cameras[index].c2w[:3, :3], axes(wanted).T, atol=1e-9)
        lens = cameras[index].intrinsics
        assert 2 * math.atan(0.5 * min(lens.width, lens.height) / lens.fy) == pytest.approx(float(wanted["fov"]))
    middle = min(cameras, key=lambda c: np.linalg.norm(c.position - seen[1]["position"]))
    assert np.linalg.norm(middle.position - seen[1]["position"]) < 0.05
    steps = np.linalg.norm(np.diff([c.position for c in cameras], axis=0), axis=1)
    assert steps.max() < 3 * steps.mean()  # no jumps
    ways = np.diff([c.position for c in cameras], axis=0) / steps[:, None]
    bends = np.arccos(np.clip((ways[1:] * ways[:-1]).sum(1), -1, 1))
    assert bends.max() < 3 * bends.mean()  # and no corners
    fresh.evaluate("(path) => { nerfvol.state.keys.length = 0; nerfvol.readPath(path); }", path)
    assert fresh.evaluate("nerfvol.path") == path


def test_a_truncated_model_gets_one_sentence(browser, files, tmp_path):
    text = (files / "octree.html").read_text()
    start = text.rindex(OPENING) + len(OPENING)
    end = text.index("</script>", start)
    bad = tmp_path / "bad.html"
    bad.write_text(text[: start + (end - start) // 2 // 4 * 4] + text[end:])
    page = opened(browser, bad, until="document.getElementById('status').className === 'fault'")
    assert page.inner_text("#status") == "The model in this page cannot be used: it is cut off."
    assert page.faults == []
    cut = tmp_path / "cut.html"  # a download that was broken off
    cut.write_text(text[: start + (end - start) // 2])
    page.goto(cut.as_uri())
    wait(page, "document.getElementById('status').className === 'fault'")
    assert page.inner_text("#status").startswith("The model in this page c") and "cut off" in page.inner_text("#status")
    page.close()


def test_it_fits_a_narrow_screen(browser, files):
    page = opened(browser, files / "splats.html", 360, 640)
    page.click("#menu")
    for name in ("path", "outputs"):
        page.evaluate("document.querySelectorAll('details').forEach((d) => { d.open = true; })")
        assert page.is_visible(f"#{name}")
    beyond = "(e) => e.id !== 'poster' && e.getBoundingClientRect().right > 360.5"
    wide = page.evaluate(f"[...document.querySelectorAll('body *')].filter({beyond}).map((e) => e.outerHTML)")
    assert wide == [] and page.evaluate("document.documentElement.scrollWidth") <= 360
    assert page.evaluate("document.getElementById('canvas').clientWidth") == 360
    page.close()


OVERLAID = """([x, y]) => {
  const overlay = document.getElementById("overlay"), k = overlay.width / overlay.clientWidth;
  return !overlay.hidden && overlay.getContext("2d").getImageData(x * k - 4, y * k - 4, 8, 8).data.some((byte) => byte > 0);
}"""


@pytest.mark.parametrize("name", ["octree", "splats"])
def test_a_crop_box_shows_what_export_writes(browser, files, tmp_path, name):
    page = opened(browser, files / f"{name}.html")
    whole = picture(page, 203, 134)
    page.evaluate("document.querySelectorAll('details').forEach((d) => { d.open = true; })")
    page.click("#menu")
    for x in (-0.1, 0.1):  # a number below zero in a word of its own would be taken for an option
        page.evaluate(f"(e => {{ e.value = {x}; e.oninput(); }})(document.getElementById('x0'))")
        words = page.inner_text("#box")
        assert words.startswith(f"nerfvol export FILE --crop={x},")
    page.wait_for_timeout(100)  # the box follows the slider at a distance
    cropped = picture(page, 203, 134)
    crop = [float(x) for x in words.split("=")[-1].split(",")]
    export_model(load_model(files / f"{name}.html"), tmp_path / "part.html", crop=crop)
    model = load_model(tmp_path / "part.html")
    native = model.render(first_camera(load_model(files / f"{name}.html").metadata["orbit"], 203, 134))["rgb"]
    error = ((cropped - np.clip(native, 0, 1)) ** 2).mean()
    # leaves at the cut: a file forgets what they had in common with those that are gone; splats are the same
    assert error < (1e-5 if name == "splats" else 1e-4) < 0.1 * ((whole - cropped) ** 2).mean()
    page.click("#uncrop")
    page.wait_for_timeout(100)
    assert np.array_equal(picture(page, 203, 134), whole)
    page.close()


def test_a_served_page_jumps_to_photographs_and_follows_a_new_model(browser):
    from nerfvol.viewer.server import ViewServer
    from nerfvol.viewer.shown import Shown
    from tests.viewer.test_server import dataset_of

    model = ball(0, 4)
    shown = Shown("ball", dataset_of(model))
    shown.publish(model)
    server = ViewServer(shown, port=0)
    server.start()
    page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
    try:
        page.goto(server.address)
        wait(page, f"{DRAWN} && document.getElementById('photos')")
        assert page.evaluate("crossOriginIsolated")
        page.click("#menu")
        page.evaluate("document.querySelectorAll('details').forEach((d) => { d.open = true; })")
        page.select_option("#photos", "1")
        wait(page, "!document.getElementById('error').hidden")
        camera_there = shown.dataset.cameras[1]
        assert np.allclose(camera(page)["position"], camera_there.position, atol=1e-9)
        assert np.allclose(axes(camera(page)), camera_there.c2w[:3, :3].T, atol=1e-9)
        assert page.inner_text("#score").startswith("b: PSNR ")
        # a click on another camera's place in the picture chooses it
        width, height = page.evaluate("[canvas.clientWidth, canvas.clientHeight]")
        page.evaluate("(nerfvol.camera = {...nerfvol.first, fov: 2.5}, 0)")
        seen = camera(page)
        right, up, back = axes(seen) @ (shown.dataset.cameras[2].position - seen["position"])
        focal = 0.5 * min(width, height) / math.tan(seen["fov"] / 2)
        tip = [width / 2 - focal * right / back, height / 2 + focal * up / back]
        assert 0 < tip[0] < width and 0 < tip[1] < height
        assert page.evaluate(OVERLAID, tip)
        page.evaluate("(document.getElementById('panel').hidden = true, 0)")
        page.mouse.click(*tip)
        wait(page, "document.getElementById('photos').value === '2'")
        assert np.allclose(camera(page)["position"], shown.dataset.cameras[2].position, atol=1e-9)
        page.evaluate("(document.getElementById('panel').hidden = false, 0)")
        before = camera(page)
        shown.publish(cloud_of_splats(1), "step 7")  # of another kind even
        wait(page, "document.getElementById('live').textContent === 'step 7' && nerfvol.drawing.isSplats")
        wait(page, DRAWN)
        assert np.allclose(camera(page)["position"], before["position"])
        page.focus("#canvas")
        page.keyboard.press("k")
        page.keyboard.press("ArrowLeft")
        page.keyboard.press("k")
        page.evaluate("(nerfvol.state.keys[0].seconds = 0.2)")
        for name, value in (("width", "64"), ("height", "48")):
            page.fill(f"#{name}", value)
        page.click("#film")
        wait(page, "document.querySelector('#filmed a')")
        assert server.video.state()["done"] == 6 and server.video.crop is None
        page.evaluate("(document.querySelector('#filmed a').remove(), nerfvol.crop([[-1, -1, -1], [0.25, 1, 1]]), 0)")
        page.click("#film")
        wait(page, "document.querySelector('#filmed a')")
        assert server.video.crop == (-1, -1, -1, 0.25, 1, 1)
    finally:
        page.close()
        server.close()
