"""Functions that the tests' workers run: importable, as every task must be."""

import os
import time
from pathlib import Path


def double(settings: dict, files: dict, item: int) -> tuple[int, int]:
    """(2 item, the process that computed it), after settings["seconds"]."""
    time.sleep(settings.get("seconds", 0.0))
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
