"""``nerfvol view``: a model in the browser, drawn there by the CPU, with its photographs and videos of camera paths."""

from __future__ import annotations

import argparse
import os
import sys
import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from nerfvol.cli.command import Command, add_target, need, set_threads
from nerfvol.cli.target import open_target
from nerfvol.config.assemble import run_settings
from nerfvol.config.values import within

if TYPE_CHECKING:
    from nerfvol.datasets.dataset import Dataset
    from nerfvol.viewer.server import ViewServer


@dataclass
class ViewOptions:
    """``nerfvol view``."""

    target: str = ""
    port: Annotated[int, within(0, 65535)] = 8080
    host: str = "127.0.0.1"
    data: str | None = None
    no_open: bool = False
    threads: int = 0


def arguments(p: argparse.ArgumentParser) -> None:
    """Adds the command's options to the parser ``p``."""
    add_target(p)
    p.add_argument("--port", metavar="N", help="port; one that is taken moves on to the next (default: 8080; 0: any)")
    p.add_argument("--host", metavar="ADDRESS", help="address to listen at; others than this machine's own let everybody on "
                   "the network look who knows the printed address (default: 127.0.0.1)")  # fmt: skip
    p.add_argument("--data", metavar="DIR", help="data set whose cameras to jump to (default: that of the run)")
    p.add_argument("--no-open", action="store_true", help="print the address only, open no browser")


def run(options: ViewOptions) -> int:
    """Serves until Ctrl-C; the exit code.

    Raises:
        InputError: no such model or data, or no port is free.
    """
    need("view", target=options.target)
    set_threads(options.threads)
    target = open_target(options.target)
    from nerfvol.viewer.server import ViewServer
    from nerfvol.viewer.shown import Shown

    shown = Shown(target.path.parent.name or target.path.stem, _photographs(target.name, options.data))
    target.model.metadata.update(background=list(target.background), orbit=dict(target.orbit()))
    shown.publish(target.model)
    server = ViewServer(shown, options.host, options.port)
    try:
        announce(server, not options.no_open)
        server.start()
        threading.Event().wait()
    except KeyboardInterrupt:
        print()
    finally:
        server.close()
    return 0


def announce(server: ViewServer, opens: bool) -> None:
    """Says where to look, and opens a browser there."""
    from nerfvol.viewer.server import LOOPBACK

    print(f"view it at {server.address} (Ctrl-C ends)", flush=True)
    if server.host not in LOOPBACK:
        print("anybody on this network who knows the address can look, and nothing is encrypted; safer from another machine: "
              f"ssh -L {server.port}:127.0.0.1:{server.port} THIS_MACHINE", flush=True)  # fmt: skip
    has_screen = sys.platform in ("darwin", "win32") or any(os.environ.get(k) for k in ("DISPLAY", "WAYLAND_DISPLAY"))
    if opens and has_screen:  # else a browser for terminals might come
        threading.Thread(target=_open, args=(server.address,), daemon=True).start()


def _open(address: str) -> None:
    """Opens a browser there, or says that there is none."""
    import webbrowser

    if not webbrowser.open(address):
        print("no browser could be started: open the address in one", flush=True)


def _photographs(name: str, data: str | None) -> Dataset | None:
    """The training views: of ``data``, else of the run's data where they are still there."""
    from pathlib import Path

    from nerfvol.datasets.load import load_dataset

    if data is not None:
        return load_dataset(data, "train")
    settings = run_settings(name)
    folder = settings.get("data")
    return load_dataset(folder, "train") if folder and Path(folder).exists() else None


COMMAND = Command(
    summary="Look at a model in the browser, without a GPU.",
    example="nerfvol view run\nnerfvol view scene.html --no-open",
    options=ViewOptions,
    arguments=arguments,
    run=run,
    place=25,
)
