"""`s2p3 dataset subset, merge, convert, export-bop, import`: sessions from and to other files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

from s2p3.commands.arguments import OptionalPath, Sessions
from s2p3.console_output import counting, say

OptionalText = Annotated[str | None, tyro.conf.arg(metavar="TEXT", help_behavior_hint="(optional)")]
OptionalCount = Annotated[int | None, tyro.conf.arg(metavar="INT", help_behavior_hint="(optional)")]
OptionalUnit = Annotated[
    Literal["m", "mm"] | None, tyro.conf.arg(metavar="{m,mm}", help_behavior_hint="(optional)")
]


def subset(
    session: tyro.conf.Positional[Path], *, out: Path, frames: OptionalText = None, split: OptionalText = None
) -> None:
    """Write a session with some of another's frames, their poses, masks and splits.

    Args:
        session: the session file.
        out: the new session.
        frames: a slice such as 0:100:2, or a list such as 3,5,8.
        split: instead of --frames, a split stored in the session.
    """
    from dataset.session import Session
    from dataset.subset import chosen_frames
    from dataset.subset import subset as write

    with Session.open(session) as opened:
        chosen = chosen_frames(opened, frames, split)
    say(f"{out}: {write(session, out, chosen)} frames")


def merge(sessions: Sessions, *, out: Path, forget_clocks: bool = False) -> None:
    """Write one session that holds the frames of several of one camera and calibration.

    Args:
        sessions: the parts.
        out: the new session.
        forget_clocks: for parts whose clocks cannot be compared, such as recordings of different days: store
            all times as unknown and leave the arm's traces out.
    """
    from dataset.merge import merge as write

    say(f"{out}: {write(sessions, out, forget_clocks=forget_clocks)} frames")


def convert(session: tyro.conf.Positional[Path], *, out: Path) -> None:
    """Write a session of an older major version of the format as one of the present.

    Args:
        session: the old session, which stays as it is.
        out: the new session.
    """
    from dataset.convert import convert as write
    from dataset.schema import VERSION

    say(f"{out}: converted from schema {write(session, out)} to {VERSION}")


def export_bop(sessions: Sessions, *, out: Path, split: str = "test", frames: OptionalText = None) -> None:
    """Write annotated sessions as the scenes of a BOP data set, for the BOP toolkit.

    Args:
        sessions: one session a scene.
        out: the new folder, or one exported before, which gets one more split.
        split: name of the BOP split: train, val or test, perhaps with a type, such as train_real.
        frames: a split stored in the sessions to which the export is limited, such as test.
    """
    from dataset.bop import export_bop as write
    from s2p3.silhouettes import Silhouettes

    with counting("export") as report:
        write(sessions, out, Silhouettes(), split, frames, report)
    say(f"{out}: a BOP data set with {len(sessions)} scene{'s' if len(sessions) > 1 else ''} in {split}")


def import_(
    layout: tyro.conf.Positional[Literal["bop", "ppp-net", "housecat6d", "raw-folder"]],
    folder: tyro.conf.Positional[Path],
    *,
    out: Path,
    mesh: OptionalPath = None,
    mesh_units: OptionalUnit = None,
    pose_units: OptionalUnit = None,
    mosaic: Annotated[
        Literal["mono", "colour"] | None, tyro.conf.arg(help_behavior_hint="(raw-folder)")
    ] = None,
    bits: OptionalCount = None,
    stamps: OptionalPath = None,
) -> None:
    """Write a session from another data set. Lengths are never guessed: name their units.

    Args:
        layout: bop: a scene folder of an export; ppp-net: the folder of an object; housecat6d: the folder of
            a scene; raw-folder: a folder of PNG, TIFF or npy mosaics.
        folder: the data.
        out: the new session.
        mesh: ppp-net: PLY, OBJ or STL of the object.
        mesh_units: ppp-net, housecat6d: unit of the meshes.
        pose_units: ppp-net, housecat6d: unit of the poses' translations.
        mosaic: raw-folder: mono has cells of 2x2 pixels, colour super-pixels of 4x4.
        bits: raw-folder: significant bits of 16-bit files.
        stamps: raw-folder: CSV with a column file and any of camera_time_ns, host_time_ns, exposure_us,
            gain_db.
    """
    from dataset.errors import ToolkitError
    from dataset.importers import import_bop, import_housecat6d, import_ppp_net, import_raw_folder

    def need(**options: object) -> None:
        for name, value in options.items():
            if value is None:
                raise ToolkitError(f"importing {layout} needs --{name.replace('_', '-')}; see --help")

    def refuse(**options: object) -> None:
        for name, value in options.items():
            if value is not None:
                raise ToolkitError(f"importing {layout} takes no --{name.replace('_', '-')}; leave it out")

    of_folders = {"mosaic": mosaic, "bits": bits, "stamps": stamps}
    of_scenes = {"mesh_units": mesh_units, "pose_units": pose_units}
    if layout != "raw-folder":
        refuse(**of_folders)
    if layout in ("bop", "raw-folder"):
        refuse(**of_scenes)
    if layout != "ppp-net":
        refuse(mesh=mesh)
    if layout == "bop":
        count = import_bop(folder, out)
    elif layout == "raw-folder":
        need(mosaic=mosaic)
        assert mosaic is not None
        count = import_raw_folder(folder, out, mosaic, bits, stamps)
    else:
        need(mesh_units=mesh_units, pose_units=pose_units)
        assert mesh_units is not None
        assert pose_units is not None
        if layout == "housecat6d":
            count = import_housecat6d(folder, out, mesh_units=mesh_units, pose_units=pose_units)
        else:
            need(mesh=mesh)
            assert mesh is not None
            count = import_ppp_net(folder, out, mesh=mesh, mesh_units=mesh_units, pose_units=pose_units)
    say(f"{out}: {count} frames")
