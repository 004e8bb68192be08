"""GenTL producers for the harvesters driver: that of the genicam wheel, and one for GigE Vision cameras."""

import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

from acquisition.camera import CameraConfig


@pytest.fixture(scope="session")
def viky() -> CameraConfig:
    """A camera without exposure, triggers and clock, of a producer by the authors of genicam."""
    genicam = pytest.importorskip("genicam")
    producer = Path(genicam.__file__).with_name("viky.cti")
    return CameraConfig("1", pixel_format="Mono8", frame_rate=100, producer=str(producer))


@pytest.fixture(scope="session")
def gige_producer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`gige_producer.c`, compiled: through it harvesters reaches the simulated camera over the real wire."""
    if shutil.which("gcc") is None or shutil.which("pkg-config") is None:
        pytest.skip("needs gcc and pkg-config")
    source = Path(__file__).with_name("gige_producer.c")
    producer = tmp_path_factory.mktemp("producer") / "gige.cti"
    flags = subprocess.check_output(["pkg-config", "--cflags", "--libs", "gobject-2.0"], text=True)
    command = ["gcc", "-shared", "-fPIC", "-o", str(producer), str(source), "-l:libaravis-0.8.so.0"]
    # Unloading it would unload Aravis, whose types are registered for the life of the process.
    subprocess.run([*command, *shlex.split(flags), "-Wl,-z,nodelete,-z,defs"], check=True)
    return producer
