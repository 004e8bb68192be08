"""Mitsuba 3, made ready: the right LLVM, a variant that works on this machine, one thread.

Some LLVM versions abort the process that compiles with them. Which variant works is therefore tried in a
process of its own, and the one that renders always is the fallback.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from dataclasses import dataclass
from functools import lru_cache
from glob import glob
from importlib import metadata
from pathlib import Path
from typing import Any

from dataset import ToolkitError

FAST, SURE = "llvm_ad_mono_polarized", "scalar_spectral_polarized"
"""Variants of Mitsuba: compiled for the scene, and interpreted, about five times slower."""

_LLVM = "DRJIT_LIBLLVM_PATH"
_ABORTING = {15, 16}
"""LLVM versions that cannot select the code of these kernels, and end the process."""
_BEST = 19
_PROBE_S = 180
_PROBE = """
import mitsuba as mi
mi.set_variant({variant!r})
scene = mi.load_dict({{
    "type": "scene",
    "integrator": {{"type": "stokes", "nested": {{"type": "path", "max_depth": 3}}}},
    "sensor": {{"type": "perspective", "film": {{"type": "hdrfilm", "width": 4, "height": 4}}}},
    "light": {{"type": "constant"}},
    "ball": {{"type": "sphere", "center": [0, 0, 3], "bsdf": {{"type": "pplastic"}}}},
}})
assert mi.TensorXf(mi.render(scene, spp=4)).array[0] >= 0
"""


@dataclass(frozen=True)
class Engine:
    """A variant of Mitsuba that works here.

    Attributes:
        variant: `FAST` or `SURE`.
        llvm: the library it compiles with; empty: Mitsuba's own choice.
        note: why it is not the fast one, for people; empty where it is.
    """

    variant: str
    llvm: str = ""
    note: str = ""

    def describe(self) -> dict[str, object]:
        """Versions that the last bit of a picture depends on, for JSON."""
        return {
            "variant": self.variant,
            "llvm": Path(self.llvm).name,
            "mitsuba": metadata.version("mitsuba"),
            "drjit": metadata.version("drjit"),
        }

    def start(self) -> Any:
        """The module `mitsuba`, set to this variant and to one thread: sums have one order then, and a set's
        frames are shared among processes.

        Raises:
            ToolkitError: Mitsuba is not installed.
        """
        if self.llvm:
            os.environ.setdefault(_LLVM, self.llvm)
        try:
            import drjit
            import mitsuba
        except ImportError as error:
            raise _missing(error) from error
        if mitsuba.variant() != self.variant:
            mitsuba.set_variant(self.variant)
        drjit.set_thread_count(1)
        return mitsuba


@lru_cache(maxsize=1)
def find_engine() -> Engine:
    """The fastest variant that works on this machine; tried once a process, in seconds.

    Raises:
        ToolkitError: Mitsuba is not installed, or renders with no variant.
    """
    try:
        metadata.version("mitsuba")
    except metadata.PackageNotFoundError as error:
        raise _missing(error) from error
    tried = []
    for llvm in _libraries():
        words = _probe(FAST, llvm)
        if words is None:
            return Engine(FAST, llvm)
        tried.append(f"{Path(llvm).name or 'the default LLVM'}: {words}")
    words = _probe(SURE, "")
    if words is not None:
        raise ToolkitError(
            f"Mitsuba renders with no variant ({words}); reinstall: pip install -U mitsuba drjit"
        )
    why = "; ".join(tried) or "no LLVM found"
    return Engine(
        SURE, note=f"path tracing without LLVM, about five times slower ({why}); apt-get install libllvm19"
    )


def _libraries() -> list[str]:
    """LLVM libraries worth a try, the best first; the user's own choice excludes others."""
    chosen = os.environ.get(_LLVM)
    if chosen:
        return [chosen]
    found: dict[int, str] = {}
    for pattern in ("/usr/lib/*/libLLVM*.so*", "/usr/lib/llvm-*/lib/libLLVM*.so*", "/usr/lib64/libLLVM*.so*"):
        for path in glob(pattern):
            version = re.search(r"libLLVM(?:\.so\.|-)(\d+)", path)
            if version:
                found.setdefault(int(version.group(1)), str(Path(path).resolve()))
    usable = sorted(found.keys() - _ABORTING, key=lambda version: (abs(version - _BEST), -version))
    return [found[version] for version in usable]


def _probe(variant: str, llvm: str) -> str | None:
    """Renders a few pixels in another process: None where that works, or its last words."""
    environment = dict(os.environ) | ({_LLVM: llvm} if llvm else {})
    command = [sys.executable, "-c", _PROBE.format(variant=variant)]
    try:
        done = subprocess.run(
            command,
            env=environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=_PROBE_S,
            text=True,
        )
    except subprocess.TimeoutExpired:
        return f"no answer in {_PROBE_S} s"
    if done.returncode == 0:
        return None
    lines = [line.strip() for line in done.stderr.splitlines() if line.strip()]
    return (lines[-1] if lines else f"ended with code {done.returncode}")[:120]


def _missing(error: Exception) -> ToolkitError:
    return ToolkitError(f"path tracing needs Mitsuba ({error}); pip install 's2p3[synthesis]'")
