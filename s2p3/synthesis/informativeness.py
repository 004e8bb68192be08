"""How much a set of images says about shape through polarization: measured, because a set can say nothing.

Where diffuse and specular light balance, their polarizations cancel; where noise prevails, so does chance.
Two figures tell. The angle between the true normals and the best of the priors (n_d, n_s1, n_s2, each with
both azimuths), against the best of as many random normals. And what L_physics would see: the mean of min
|rho - rho_hat| at the true normals, against the same normals dealt to the wrong pixels: where the two are
equal, it cannot help.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from s2p3 import physics

_DEGREES = 90
_INK, _FAINT, _STRONG, _WEAK = (70, 70, 70), (225, 225, 225), (213, 87, 52), (42, 118, 224)  # BGR


@dataclass(frozen=True)
class Informativeness:
    """Figures of one image, or their means over a set.

    Attributes:
        prior_error_deg: median angle between the true normal and the best prior.
        chance_error_deg: the same for six random normals that face the camera.
        dolp_residual: mean over pixels of min(|rho - rho_d|, |rho - rho_s|) at the true normals.
        dolp_residual_shuffled: the same with the normals of other pixels.
        dolp: median degree of polarization on the object.
        prior_within, chance_within: share of pixels whose error is below 1, 2, ... 90 degrees.
        images: how many were measured.
    """

    prior_error_deg: float
    chance_error_deg: float
    dolp_residual: float
    dolp_residual_shuffled: float
    dolp: float
    prior_within: tuple[float, ...]
    chance_within: tuple[float, ...]
    images: int = 1

    def __str__(self) -> str:
        return (
            f"best prior {self.prior_error_deg:.1f} deg from the true normal (chance "
            f"{self.chance_error_deg:.1f}); min |rho - rho_hat| {self.dolp_residual:.3f} at true, "
            f"{self.dolp_residual_shuffled:.3f} at shuffled normals; median DoLP {self.dolp:.2f}; "
            f"measured on {self.images} images"
        )

    def to_json(self) -> str:
        """All figures, by name."""
        return json.dumps(asdict(self))

    @staticmethod
    def from_json(text: str) -> Informativeness:
        """Inverse of `to_json`."""
        values = json.loads(text)
        for curve in ("prior_within", "chance_within"):
            values[curve] = tuple(values[curve])
        return Informativeness(**values)

    @staticmethod
    def mean(parts: Sequence[Informativeness]) -> Informativeness:
        """The figures of a set from those of its images; NaN of none."""
        if not parts:
            nothing = (np.nan,) * _DEGREES
            return Informativeness(np.nan, np.nan, np.nan, np.nan, np.nan, nothing, nothing, images=0)
        means = {
            field.name: np.mean([getattr(part, field.name) for part in parts], axis=0).tolist()
            for field in fields(Informativeness)
            if field.name != "images"
        }
        for curve in ("prior_within", "chance_within"):
            means[curve] = tuple(means[curve])
        return Informativeness(**means, images=sum(part.images for part in parts))

    def draw(self, path: str | Path, title: str) -> None:
        """A picture (PNG) of the share of pixels within an angle: best prior against chance."""
        picture = np.full((360, 560, 3), 255, np.uint8)
        left, top, right, bottom = 60, 46, 540, 310

        def at(degrees: float, share: float) -> tuple[int, int]:
            across = left + (right - left) * degrees / _DEGREES
            return round(across), round(bottom - (bottom - top) * (share if share == share else 0.0))

        for degrees in range(0, _DEGREES + 1, 15):
            cv2.line(picture, at(degrees, 0), at(degrees, 1), _FAINT, 1)
            _write(picture, f"{degrees}", (at(degrees, 0)[0] - 8, bottom + 18), _INK)
        for share in (0.0, 0.5, 1.0):
            cv2.line(picture, at(0, share), at(_DEGREES, share), _FAINT, 1)
            _write(picture, f"{100 * share:.0f} %", (8, at(0, share)[1] + 4), _INK)
        curves = (
            (f"best prior, median {self.prior_error_deg:.1f} deg", self.prior_within, _STRONG),
            (f"chance, median {self.chance_error_deg:.1f} deg", self.chance_within, _WEAK),
        )
        for row, (name, within, colour) in enumerate(curves):
            points = [at(0, 0.0), *(at(degrees, share) for degrees, share in enumerate(within, start=1))]
            cv2.polylines(picture, [np.array(points)], False, colour, 2, cv2.LINE_AA)
            _write(picture, name, (right - 220, bottom - 32 + 18 * row), colour)
        _write(picture, f"{title}: pixels within an angle of the true normal", (12, 24), _INK)
        _write(picture, f"degrees; {self.images} images", (left, bottom + 40), _INK)
        cv2.imwrite(str(path), picture)


def _write(picture: NDArray[np.uint8], text: str, at: tuple[int, int], colour: tuple[int, int, int]) -> None:
    cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.42, colour, 1, cv2.LINE_AA)


def measure(
    stokes: NDArray[np.float32],
    normals: NDArray[np.float32],
    mask: NDArray[np.bool_],
    K: NDArray[np.float64],
    index: float,
    seed: int = 0,
) -> Informativeness | None:
    """Figures of one image.

    Args:
        stokes: (3, h, w) measured S0, S1, S2.
        normals: (h, w, 3) true unit normals, camera frame.
        mask: (h, w), the object's visible pixels.
        K: (3, 3) of these pixels.
        index: the refractive index the priors assume.
        seed: of chance.

    Returns:
        None where fewer than 20 pixels are lit.
    """
    lit = mask & (stokes[0] > 1e-3)
    if lit.sum() < 20:
        return None
    camera = torch.tensor(K)[None]
    image = torch.from_numpy(stokes.astype(np.float64))[None]
    priors = physics.shape_priors(image, index, camera)[0].reshape(3, 3, *lit.shape)[
        :, :, lit
    ]  # (prior, xyz, n)
    rays = physics.pixel_rays(camera, *lit.shape)[0][:, lit]
    true = torch.from_numpy(normals.astype(np.float64))[lit].T  # (3, n)
    generator = torch.Generator().manual_seed(seed)
    random = torch.randn(6, *true.shape, generator=generator, dtype=true.dtype)
    random = random / random.norm(dim=1, keepdim=True)
    random = torch.where((random * rays).sum(1, keepdim=True) > 0, -random, random)
    s0, s1, s2 = image[0][:, lit]
    dolp = (torch.hypot(s1, s2) / s0).clamp(max=1)
    shuffled = true[:, torch.randperm(true.shape[1], generator=generator)]
    prior_deg = _angles_deg(torch.cat([priors, _half_turned(priors, rays)]), true)
    chance_deg = _angles_deg(random, true)
    return Informativeness(
        float(prior_deg.median()),
        float(chance_deg.median()),
        _residual(dolp, true, rays, index),
        _residual(dolp, shuffled, rays, index),
        float(dolp.median()),
        _within(prior_deg),
        _within(chance_deg),
    )


def _angles_deg(candidates: Tensor, true: Tensor) -> Tensor:
    """(n,) angle of each pixel between (3, n) and the nearest of (m, 3, n)."""
    cosine = (candidates * true).sum(1).amax(0).clamp(-1, 1)
    return torch.rad2deg(torch.acos(cosine))


def _within(angles_deg: Tensor) -> tuple[float, ...]:
    """Share of the angles below 1, 2, ... degrees."""
    limits = torch.arange(1, _DEGREES + 1, dtype=angles_deg.dtype)
    return tuple((angles_deg[None] < limits[:, None]).double().mean(1).tolist())


def _half_turned(normals: Tensor, rays: Tensor) -> Tensor:
    """Normals (m, 3, n) turned by 180 deg about their rays: the other azimuth."""
    along = (normals * rays).sum(1, keepdim=True)
    return 2 * along * rays - normals


def _residual(dolp: Tensor, normals: Tensor, rays: Tensor, index: float) -> float:
    diffuse, specular = physics.analytic_dolp(normals[None, :, None], rays[None, :, None], index)
    return float(torch.minimum((dolp - diffuse[0, 0]).abs(), (dolp - specular[0, 0]).abs()).mean())
