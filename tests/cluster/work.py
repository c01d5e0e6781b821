"""Functions that the tests' workers run: importable, as every task must be."""

import os
import signal
import threading
import time
from pathlib import Path


def double(settings: dict, files: dict, item: int) -> tuple[int, int]:
    """(2 item, the process that computed it), after settings["seconds"]."""
    time.sleep(settings.get("seconds", 0.0))
    return 2 * item, os.getpid()


def in_company(settings: dict, files: dict, item: int) -> int:
    """2 item, once as many processes as settings["n"] have left their number in the folder settings["folder"]."""
    folder = Path(settings["folder"])
    (folder / str(os.getpid())).touch()
    while len(list(folder.iterdir())) < settings["n"]:
        time.sleep(0.01)
    return 2 * item


def held(settings: dict, files: dict, item: int) -> tuple[int, int]:
    """As ``double``; the process settings["process"] makes the file settings["begun"] and never ends."""
    if os.getpid() == settings["process"]:
        Path(settings["begun"]).touch()
        time.sleep(3600)
    return 2 * item, os.getpid()


def content(settings: dict, files: dict, item: int) -> bytes:
    """The bytes of the file "model"."""
    return Path(files["model"]).read_bytes()


def no_space_on(settings: dict, files: dict, item: int) -> int:
    """Fails for want of space in the process whose number is in settings["file"], the first that wrote it."""
    try:
        with open(settings["file"], "x") as file:
            file.write(str(os.getpid()))
    except FileExistsError:
        pass
    if Path(settings["file"]).read_text() == str(os.getpid()):
        raise OSError(28, "No space left on device", "/somewhere/frame.png")
    return 2 * item


def broken(settings: dict, files: dict, item: int) -> None:
    """Raises."""
    raise RuntimeError("this never works")


def other_probe() -> bytes:
    """Something else in every process: no two machines agree."""
    return os.urandom(8)


def keep_files_in(folder: str) -> None:
    """This process keeps what it is sent there."""
    os.environ["NERFVOL_CACHE"] = folder


def noise(settings: dict, files: dict, item: int) -> bytes:
    """Some bytes that nothing packs."""
    return os.urandom(settings["bytes"])


class Sent:
    """What travels as a Done while the worker's name of that class is taken: pickled by its name it would be another class."""

    def __init__(self, *parts: object) -> None:
        self.parts = parts

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        return received, self.parts


def received(*parts: object) -> object:
    from nerfvol.cluster.tasks import Done

    return Done(*parts)  # pyright: ignore[reportArgumentType]


_AS_IT_WAS: list[tuple[object, str, object]] = []


def die_once_in(phase: str, marker: str) -> None:
    """The first process that comes to ``phase`` of drawing a frame (load, frame, encode, fetch) makes the file ``marker`` and
    is killed; others, or another phase: all is as it was."""
    from nerfvol import film
    from nerfvol.cluster import frames, tasks

    while _AS_IT_WAS:
        setattr(*_AS_IT_WAS.pop())
    frames._film.cache_clear()
    places = {
        "load": (frames, "load_model"),
        "frame": (film.Film, "drawn"),
        "encode": (film.pictures, "encode_png"),
        "fetch": (tasks, "Done"),
    }
    if phase not in places:
        return
    owner, name = places[phase]
    real = getattr(owner, name)

    def deadly(*arguments, **options):
        give = Sent if phase == "fetch" else real
        try:
            with open(marker, "x"):
                pass
        except FileExistsError:
            return give(*arguments, **options)
        if phase == "fetch":  # the result is there, and perhaps on its way
            threading.Timer(0.002, os.kill, (os.getpid(), signal.SIGKILL)).start()
            return give(*arguments, **options)
        os.kill(os.getpid(), signal.SIGKILL)

    _AS_IT_WAS.append((owner, name, real))
    setattr(owner, name, deadly)
