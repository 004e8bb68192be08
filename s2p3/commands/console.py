"""`s2p3 console` and `s2p3 dataset view`: the rig, and a recorded session, in the browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from s2p3.commands.arguments import OptionalPath, at_least
from s2p3.console_output import counting, say

Token = Annotated[str | None, tyro.conf.arg(metavar="TOKEN", help_behavior_hint="(optional)")]
"""What a page's users must know."""


def console(
    *,
    rig: Path,
    out: Path = Path("recordings"),
    host: str = "127.0.0.1",
    port: int = 8080,
    token: Token = None,
) -> None:
    """Show the live camera, the arm and a recorder in the browser, until Ctrl-C; the arm is only read.

    Args:
        rig: rig.toml with the devices' addresses.
        out: folder for what is recorded.
        host: address to serve at; another than this computer's own needs a token.
        port: TCP port to serve at.
        token: 16 letters and digits or more, which a browser must present.
    """
    from acquisition.console import serve_console
    from acquisition.rig import Rig
    from acquisition.web import Address

    address = Address(host, port, token)
    serve_console(Rig.load(rig), out, address, lambda url: say(f"open {url} in a browser; Ctrl-C ends"))


def view(
    session: tyro.conf.Positional[Path],
    *,
    save: OptionalPath = None,
    every: int = 1,
    host: str = "127.0.0.1",
    port: int = 8080,
    token: Token = None,
) -> None:
    """Look through a session in the browser: pictures, priors, object, camera path, clocks; until Ctrl-C.

    Args:
        session: the session file; calibrated and annotated or not.
        save: folder for pictures and a film instead of a page.
        every: with --save, the film shows every so-manieth frame.
        host: address to serve at; another than this computer's own needs a token.
        port: TCP port to serve at.
        token: 16 letters and digits or more, which a browser must present.
    """
    from acquisition.web import Address
    from s2p3.viewer import save_pictures, serve_viewer

    at_least(1, every=every)
    address = Address(host, port, token)
    if save is None:
        serve_viewer(session, address, lambda url: say(f"open {url} in a browser; Ctrl-C ends"))
        return
    with counting("film") as report:
        written = save_pictures(session, save, every, report)
    for path in written:
        print(path)
