"""What the physics costs on one thread: raw mosaic to Stokes to shape priors, beside its peers.

    pip install --no-deps -r tools/bench/peers.txt
    python tools/bench/polarimetry.py --json

Everything is timed in turns in one process on the same 2448x2048 colour mosaic, whose polarization image is
612x512. The figures, in milliseconds or as ratios to ours:

    priors_612x512_ms            four float32 angle images to the nine channels of the three prior normal maps
    mosaic_to_priors_612x512_ms  the same from the 8-bit mosaic
    polanalyser_ratio            polanalyser from the same angle images, though only to Stokes, DoLP and AoLP
    numpy_ratio                  the priors in plain numpy, float32, the same closed forms
    bandwidth_ratio              ours, Stokes to priors, over a copy of as many bytes from and to main memory
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable

import numba
import numpy as np
import polanalyser
import torch
from numpy.typing import NDArray
from timing import in_turns

from dataset.polarimetry import Stokes, encode
from s2p3 import physics
from s2p3.image_priors import angle_priors, mosaic_priors

HEIGHT, WIDTH, INDEX, SEED = 512, 612, 1.5, 0
K = np.array([[351.450, 0, 303.646], [0, 351.477, 251.423], [0, 0, 1]], np.float32)
PLANES = 3 + 9  # float32 images read and written, Stokes to priors
COPIED = 16  # times as many bytes are copied: too many for any cache

Image = NDArray[np.float32]


def numpy_priors(intensities: Image) -> Image:
    """(4, H, W) angle images to (9, H, W) prior normals, as one would write it with numpy."""
    i0, i45, i90, i135 = intensities
    s0, s1, s2 = 0.5 * (i0 + i45 + i90 + i135), i0 - i90, i45 - i135
    polarized = np.hypot(s1, s2)
    dolp = np.minimum(polarized / np.maximum(s0, 1e-9), 1)
    doubled = s1 / np.maximum(polarized, 1e-9)
    cosine, sine = np.sqrt((1 + doubled) / 2), np.copysign(np.sqrt((1 - doubled) / 2), s2)
    n2 = INDEX * INDEX
    k = np.sqrt((1 - dolp) / (1 + dolp))
    kd, m = np.maximum(k, 1 / INDEX), (1 - k) / (1 + k)
    inclinations = (
        n2 * (1 - kd * kd) / (1 + n2 - 2 * INDEX * kd),
        2 * m * n2 / (m * (1 + n2) + np.sqrt(m * m * (n2 - 1) ** 2 + 4 * n2)),
        2 * n2 / ((1 + n2) + np.sqrt((n2 - 1) ** 2 + 4 * n2 * m * m)),
    )
    u = (np.arange(WIDTH, dtype=np.float32) - K[0, 2]) / K[0, 0]
    v = (np.arange(HEIGHT, dtype=np.float32)[:, None] - K[1, 2]) / K[1, 1]
    c = 1 / np.sqrt(1 + u * u + v * v)
    a, b = u * c, v * c
    maps = []
    azimuths = ((cosine, -sine), (-sine, -cosine), (-sine, -cosine))
    for (x, y), sin2 in zip(azimuths, inclinations, strict=True):
        sin = np.sqrt(np.minimum(sin2, 1))
        x, y, z = x * sin, y * sin, -np.sqrt(np.maximum(1 - sin2, 0))
        across = a * x + b * y
        along = z - across / (1 + c)
        maps += [x + a * along, y + b * along, c * z - across]
    return np.stack(maps)


def measure(rounds: int) -> dict[str, float]:
    """The figures of the module's docstring."""
    torch.set_num_threads(1)
    numba.set_num_threads(1)
    generator = np.random.default_rng(SEED)
    s0, dolp, angle = generator.random((3, HEIGHT, WIDTH), dtype=np.float32)
    s1, s2 = s0 * dolp * np.cos(6.28 * angle), s0 * dolp * np.sin(6.28 * angle)
    stokes = Stokes(s0, s1, s2, np.ones(s0.shape, bool))
    raw = encode(stokes, "colour", 8)
    intensities = stokes.angles()
    stack, camera = torch.from_numpy(stokes.stack())[None], torch.from_numpy(K)[None]
    degrees = np.deg2rad([0, 45, 90, 135])

    def polanalyser_stokes() -> tuple[Image, Image]:
        measured = polanalyser.calcStokes(intensities, degrees)
        return polanalyser.cvtStokesToDoLP(measured), polanalyser.cvtStokesToAoLP(measured)

    normals = np.empty((9, HEIGHT, WIDTH), np.float32)
    same = torch.from_numpy(normals)[None]
    plain, ours = numpy_priors(intensities), angle_priors(intensities, INDEX, K, normals)
    assert np.median(np.abs(plain - ours)) < 1e-5, "the numpy peer computes something else"
    times = in_turns(
        {
            "priors": lambda: angle_priors(intensities, INDEX, K, normals),
            "mosaic": lambda: mosaic_priors(raw, "colour", 8, INDEX, K, normals),
            "kernel": lambda: physics.shape_priors(stack, INDEX, camera, same),
            "polanalyser": polanalyser_stokes,
            "numpy": lambda: numpy_priors(intensities),
            "copy": copying(COPIED * PLANES * HEIGHT * WIDTH // 2),
        },
        rounds,
    )
    return {
        "priors_612x512_ms": times["priors"],
        "mosaic_to_priors_612x512_ms": times["mosaic"],
        "polanalyser_ratio": times["polanalyser"] / times["priors"],
        "numpy_ratio": times["numpy"] / times["priors"],
        "bandwidth_ratio": times["kernel"] / (times["copy"] / COPIED),
    }


def copying(count: int) -> Callable[[], None]:
    """Copies so many float32 between two arrays that exist: half of the traffic reads, half writes."""
    source, target = np.ones(count, np.float32), np.zeros(count, np.float32)
    return lambda: np.copyto(target, source)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=40, help="how often everything runs, in turns")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    figures = {name: round(value, 3) for name, value in measure(options.rounds).items()}
    if options.json:
        print(json.dumps(figures))
    else:
        for name, value in figures.items():
            print(f"{name:30s} {value:8.3f}")


if __name__ == "__main__":
    main()
