"""The frames of a set under way: a folder beside the session to be, from which an interrupted set goes on."""

from __future__ import annotations

import fcntl
import json
import shutil
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dataset import ToolkitError
from dataset.whole_files import replacing


@dataclass(frozen=True)
class Parts:
    """Rendered frames in files of their own, for one process at a time."""

    folder: Path

    @staticmethod
    @contextmanager
    def of(out: Path, request: dict[str, Any]) -> Iterator[Parts]:
        """The parts of the set `out`, what was kept of it included; removed when all went well.

        Args:
            request: what the set is made of, for JSON; a set goes on only as it began.

        Raises:
            ToolkitError: another process is at it, or it was begun otherwise.
        """
        parts = Parts(out.with_name(out.name + ".parts"))
        parts.folder.mkdir(parents=True, exist_ok=True)
        with (parts.folder / "request.json").open("a+", encoding="utf-8") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise ToolkitError(
                    f"{out}: another process renders this set; wait for it, or choose another name"
                ) from error
            file.seek(0)
            parts._require_same(file.read(), request)
            file.truncate(0)
            file.write(json.dumps(request, indent=1))
            file.flush()
            yield parts
        shutil.rmtree(parts.folder)

    def path(self, index: int) -> Path:
        """Where frame `index` is, or will be."""
        return self.folder / f"{index:06d}.npz"

    def missing(self, count: int) -> list[int]:
        """Those of the first `count` frames that are not there, or not whole: a computer that goes down may
        leave files without their end."""
        return [index for index in range(count) if not zipfile.is_zipfile(self.path(index))]

    def store(self, index: int, part: bytes) -> None:
        """Keeps a frame; it is there whole or not at all."""
        with replacing(self.path(index)) as partial:
            partial.write_bytes(part)

    def _require_same(self, kept: str, request: dict[str, Any]) -> None:
        frames = len(list(self.folder.glob("*.npz")))
        try:
            was = json.loads(kept)
            changed = [key for key in request if was.get(key) != json.loads(json.dumps(request[key]))]
        except (ValueError, AttributeError):
            changed = list(request)
        if frames and changed:
            raise ToolkitError(
                f"{self.folder} holds {frames} frames of a set that was begun with another "
                f"{' and '.join(changed)}; go on as it began, remove the folder, or choose another name"
            )
