"""The viewer's server: whom it answers, what it serves, a video, a model that is replaced while it is looked at."""

import http.client
import json
import socket
import subprocess
import threading
import time

import numpy as np
import pytest

from nerfvol.cameras.camera import Camera, Intrinsics
from nerfvol.cameras.paths import cameras_document, orbit_cameras
from nerfvol.cli.view import announce
from nerfvol.datasets.bounds import SceneBounds
from nerfvol.datasets.dataset import Dataset
from nerfvol.errors import InputError
from nerfvol.export.part import part_of
from nerfvol.files.pictures import to_uint8
from nerfvol.viewer import server as server_module
from nerfvol.viewer.server import ViewServer
from nerfvol.viewer.shown import Shown
from tests.viewer.scenes import ball


def dataset_of(model) -> Dataset:
    cameras = orbit_cameras(3, model.metadata["orbit"], (45, 30))
    images = [to_uint8(model.render(camera)["rgb"]) for camera in cameras]
    images[1] = 255 - images[1]
    box = np.array([[-1.0, -1, -1], [1, 1, 1]])
    return Dataset(cameras, images, ["a", "b", "c"], SceneBounds(box, None, False), "nowhere")


@pytest.fixture(scope="module")
def shown():
    model = ball(0, 4)
    shown = Shown("ball", dataset_of(model))
    shown.publish(model)
    return shown


@pytest.fixture
def server(shown):
    server = ViewServer(shown, port=0)
    server.start()
    yield server
    server.close()


def test_a_browser_that_is_not_there_is_said(server, monkeypatch, capsys):
    monkeypatch.setenv("DISPLAY", ":0")
    for there, said in ((True, ""), (False, "no browser could be started")):
        monkeypatch.setattr("webbrowser.open", lambda address, there=there: there)
        announce(server, True)
        for thread in threading.enumerate():
            if thread.name.endswith("(_open)"):
                thread.join()
        printed = capsys.readouterr().out.splitlines()
        assert server.address in printed[0] and (printed[1:] == []) == there and said in printed[-1]


def ask(server, path, method="GET", body=None, token=True, **headers):
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=300)
    if token:
        headers["X-Token"] = server.token
    connection.request(method, path, body, {k.replace("_", "-"): v for k, v in headers.items()})
    answer = connection.getresponse()
    data = answer.read()
    connection.close()
    return answer, data


def test_it_listens_on_this_machine_alone(server):
    assert server.socket.getsockname()[0] == "127.0.0.1"
    assert server.address.startswith(f"http://127.0.0.1:{server.port}/?token=") and len(server.token) >= 20


@pytest.mark.parametrize("path", ["/", "/model", "/state?version=0", "/cameras", "/photograph?index=0"])
def test_foreign_hosts_and_strangers_are_refused(server, path):
    for headers in (
        {"Host": "evil.example"},
        {"Host": f"evil.example:{server.port}"},
        {"Host": "127.0.0.1:1"},
        {"Origin": "http://evil.example"},
    ):
        assert ask(server, path, **headers)[0].status == 403, headers
    assert ask(server, path, token=False)[0].status == 403
    assert ask(server, path, token=False, X_Token="x" * 22)[0].status == 403
    for host in (f"localhost:{server.port}", f"127.0.0.1:{server.port}"):
        answer, _ = ask(server, path, Host=host)
        assert answer.status == 200
        assert answer.getheader("Cross-Origin-Opener-Policy") == "same-origin"
        assert answer.getheader("Cross-Origin-Embedder-Policy") == "require-corp"
        assert answer.getheader("Access-Control-Allow-Origin") is None


def test_work_is_started_by_who_sends_the_token_in_a_header(server):
    """A form of another site can send a query, but no header of its own."""
    path = json.dumps({"frames": []})
    assert ask(server, f"/render?fps=10&token={server.token}", "POST", path, token=False)[0].status == 403
    assert ask(server, "/render?fps=10", "POST", path, token=False)[0].status == 403
    assert ask(server, "/render?fps=10", "POST", path, Origin="http://evil.example")[0].status == 403
    assert server.video is None


def test_paths_and_numbers_that_are_none_get_a_sentence(server):
    assert ask(server, "/../../etc/passwd")[0].status == 404
    assert ask(server, "/viewer/server.py")[0].status == 404
    for path, sentence in (
        ("/photograph?index=7", b"there is no photograph 7"), ("/photograph?index=-1", b"index must be a whole number"),
        ("/photograph", b"index must be"), ("/progress", b"no video was asked for"), ("/video", b"there is no video yet"),
    ):  # fmt: skip
        answer, data = ask(server, path)
        assert answer.status == 400 and sentence in data
    answer, data = ask(server, "/render?fps=10", "POST", b"{}")
    assert answer.status == 400 and b"the path: expected a camera path" in data
    assert ask(server, "/render?fps=0", "POST", b"{}")[0].status == 400
    assert ask(server, "/model", "DELETE")[0].status == 501


def test_the_page_has_no_model_and_the_model_an_etag(server, shown):
    answer, page = ask(server, "/")
    assert answer.status == 200 and b'id="model"' not in page and b"remote = {" in page
    answer, data = ask(server, "/model")
    assert data == shown.edition.data and answer.getheader("X-Version") == str(shown.edition.version)
    answer, data = ask(server, "/model", If_None_Match=answer.getheader("ETag"))
    assert answer.status == 304 and data == b""


def test_photographs_are_compared(server):
    _, data = ask(server, "/cameras")
    rows = json.loads(data)
    assert [row["name"] for row in rows] == ["a", "b", "c"] and np.shape(rows[0]["c2w"]) == (4, 4)
    assert rows[0]["fov"] == pytest.approx(2 * np.arctan(30 / 45 * np.tan(0.4)))
    good, bad = (json.loads(ask(server, f"/compare?index={i}")[1])["psnr"] for i in (0, 1))
    assert good > 45 and bad < 15
    answer, picture = ask(server, "/error?index=1")
    assert picture.startswith(b"\xff\xd8") and float(answer.getheader("X-PSNR")) == pytest.approx(bad, abs=0.01)
    assert ask(server, "/photograph?index=2")[1].startswith(b"\xff\xd8")


def video_of(server, query: str, path: str, file) -> list[np.ndarray]:
    """The frames of the video of 32 x 32 pixels that the server makes of a path."""
    answer, data = ask(server, f"/render?{query}", "POST", path)
    assert answer.status == 200, data
    state = json.loads(data)
    end = time.monotonic() + 300
    while not state["finished"] and time.monotonic() < end:
        time.sleep(0.05)
        state = json.loads(ask(server, "/progress")[1])
    assert state == {"done": 4, "of": 4, "finished": True, "fault": ""}
    answer, video = ask(server, "/video")
    assert video[4:8] == b"ftyp" and "attachment" in answer.getheader("Content-Disposition")
    file.write_bytes(video)
    import imageio_ffmpeg

    decode = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(file), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    raw = subprocess.run(decode, check=True, capture_output=True).stdout
    return list(np.frombuffer(raw, np.uint8).reshape(-1, 32, 32, 3))


def test_a_path_becomes_a_video(server, tmp_path):
    cameras = orbit_cameras(4, server.shown.edition.model.metadata["orbit"], (32, 32))
    path = json.dumps(cameras_document(cameras, list("abcd")))
    assert len(video_of(server, "fps=10", path, tmp_path / "v.mp4")) == 4


def test_a_video_shows_what_the_crop_box_leaves(server, tmp_path):
    model = server.shown.edition.model
    cameras = orbit_cameras(4, model.metadata["orbit"], (32, 32))
    path, crop = json.dumps(cameras_document(cameras, list("abcd"))), (-2.0, -2.0, -2.0, 0.1, 2.0, 2.0)
    frames = video_of(server, f"fps=10&crop={','.join(map(str, crop))}", path, tmp_path / "v.mp4")
    for camera, frame in zip(cameras, frames, strict=True):
        part, whole = (to_uint8(m.render(camera)["rgb"]).astype(float) for m in (part_of(model, crop=crop), model))
        assert abs(frame - part).mean() < abs(frame - whole).mean()
    before = server.video
    for crop, said in (("5,5,5,6,6,6", b"nothing of the model lies in this box"), ("1,2", b"expected x0,y0,z0")):
        answer, data = ask(server, f"/render?fps=10&crop={crop}", "POST", path)
        assert answer.status == 400 and said in data and server.video is before


def test_who_waits_hears_of_a_new_model(server, shown, monkeypatch):
    version = shown.edition.version
    monkeypatch.setattr(server_module, "POLL_SECONDS", 300.0)
    heard = []
    waiting = threading.Thread(target=lambda: heard.append(json.loads(ask(server, f"/state?version={version}")[1])))
    waiting.start()
    reader = http.client.HTTPConnection("127.0.0.1", server.port, timeout=300)  # a model is read while it is replaced
    reader.request("GET", "/model", headers={"X-Token": server.token})
    old = shown.edition.data
    shown.publish(ball(0, 3), "coarser")
    assert reader.getresponse().read() in (old, shown.edition.data)
    waiting.join(600)
    assert heard == [{"version": version + 1, "sentence": "coarser", "training": False, "paused": False}]
    reader.close()


def test_a_training_is_paused_by_who_has_the_token(server, shown):
    assert json.loads(ask(server, "/pause?on=1", "POST")[1])["paused"] is False  # there is none
    shown.training = True
    assert ask(server, "/pause?on=1", "POST", token=False)[0].status == 403 and not shown.paused
    assert ask(server, "/pause?on=yes", "POST")[0].status == 400 and not shown.paused
    assert json.loads(ask(server, "/pause?on=1", "POST")[1])["paused"] is True
    assert json.loads(ask(server, "/pause?on=0", "POST")[1])["paused"] is False
    shown.training = False


def test_a_reader_that_goes_disturbs_nobody(server, capsys):
    for _ in range(3):
        gone = socket.create_connection(("127.0.0.1", server.port))
        gone.sendall(
            f"GET /model HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\nX-Token: {server.token}\r\n\r\n".encode()
        )
        gone.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
        gone.close()
    assert ask(server, "/cameras")[0].status == 200
    assert capsys.readouterr().err == ""


def test_a_taken_port_moves_on(server, shown):
    other = ViewServer(shown, port=server.port)
    assert server.port < other.port < server.port + server_module.MOST_PORTS
    other.close()


def test_a_host_that_is_not_ours_is_refused(shown):
    with pytest.raises(InputError, match="cannot serve at 192.0.2.1:0"):
        ViewServer(shown, host="192.0.2.1", port=0)


def test_before_there_is_a_model_the_page_says_so():
    empty = ViewServer(Shown("nothing"), port=0)
    empty.start()
    answer, page = ask(empty, "/")
    assert answer.status == 200 and b"There is nothing to see yet" in page and b"refresh" in page
    assert ask(empty, "/model")[0].status == 400
    empty.close()


def test_large_photographs_are_compared_at_a_size_that_is_quick(monkeypatch):
    model = ball(0, 3)
    lens = Intrinsics(101, 67, 120, 120, 50.5, 33.5)
    camera = Camera(lens, orbit_cameras(1, model.metadata["orbit"], None)[0].c2w)
    image = to_uint8(model.render(camera)["rgb"])
    box = np.array([[-1.0, -1, -1], [1, 1, 1]])
    shown = Shown("ball", Dataset([camera], [image], ["a"], SceneBounds(box, None, False), "nowhere"))
    shown.publish(model)
    monkeypatch.setattr("nerfvol.viewer.shown.LARGEST_COMPARED", 60)
    assert shown.compare(0)[0] > 30
