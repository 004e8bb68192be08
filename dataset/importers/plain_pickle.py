"""Reading the pickles of other data sets without running what is in them.

A pickle is a program. Only those that build lists, dictionaries, numbers, texts and numpy arrays are run
here; any other name in one is refused before it is looked up. The toolkit itself writes no pickle.
"""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np

from dataset.errors import ToolkitError

_ALLOWED = {
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("_codecs", "encode"),
    *(
        (f"numpy.{core}.{module}", name)
        for core in ("core", "_core")
        for module, name in (
            ("multiarray", "_reconstruct"),
            ("multiarray", "scalar"),
            ("numeric", "_frombuffer"),
        )
    ),
}


class _PlainUnpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ALLOWED:
            raise pickle.UnpicklingError(f"it wants to run {module}.{name}")
        if module.startswith("numpy.") and not hasattr(np, "_core"):
            module = module.replace("_core", "core")
        return super().find_class(module, name)


def read_plain_pickle(path: Path) -> Any:
    """The content of a pickle of plain values and numpy arrays.

    Raises:
        ToolkitError: missing, damaged, or a pickle that would do anything else.
    """
    if not path.is_file():
        raise ToolkitError(f"{path} is missing; check that the folder is complete")
    try:
        with path.open("rb") as stream:
            return _PlainUnpickler(stream).load()
    except (
        pickle.UnpicklingError,
        EOFError,
        ValueError,
        TypeError,
        AttributeError,
        IndexError,
        KeyError,
    ) as error:
        raise ToolkitError(f"{path} is no pickle of plain arrays ({error}); it is not read") from error
