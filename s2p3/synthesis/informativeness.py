"""How much a set of images says about shape through polarization: measured, because a set can say nothing.

Where diffuse and specular light balance, their polarizations cancel; where noise prevails, so does chance.
Two figures tell. The angle between the true normals and the best of the priors (n_d, n_s1, n_s2, each with
both azimuths), against the best of as many random normals. And what L_physics would see: the mean of min
|rho - rho_hat| at the true normals, against the same normals dealt to the wrong pixels: where the two are
equal, it cannot help.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from s2p3 import physics


@dataclass(frozen=True)
class Informativeness:
    """Figures of one image, or their means over a set.

    Attributes:
        prior_error_deg: median angle between the true normal and the best prior.
        chance_error_deg: the same for six random normals that face the camera.
        dolp_residual: mean over pixels of min(|rho - rho_d|, |rho - rho_s|) at the true normals.
        dolp_residual_shuffled: the same with the normals of other pixels.
        dolp: median degree of polarization on the object.
        images: how many were measured.
    """

    prior_error_deg: float
    chance_error_deg: float
    dolp_residual: float
    dolp_residual_shuffled: float
    dolp: float
    images: int = 1

    def __str__(self) -> str:
        return (
            f"best prior {self.prior_error_deg:.1f} deg from the true normal (chance "
            f"{self.chance_error_deg:.1f}); min |rho - rho_hat| {self.dolp_residual:.3f} at true, "
            f"{self.dolp_residual_shuffled:.3f} at shuffled normals; median DoLP {self.dolp:.2f}; "
            f"measured on {self.images} images"
        )

    def values(self) -> list[float]:
        """The five figures, in the order of the fields."""
        return [
            self.prior_error_deg,
            self.chance_error_deg,
            self.dolp_residual,
            self.dolp_residual_shuffled,
            self.dolp,
        ]

    @staticmethod
    def mean(parts: Sequence[Informativeness]) -> Informativeness:
        """The figures of a set from those of its images; NaN of none."""
        if not parts:
            return Informativeness(np.nan, np.nan, np.nan, np.nan, np.nan, images=0)
        prior, chance, residual, shuffled, dolp = np.mean([part.values() for part in parts], axis=0).tolist()
        return Informativeness(prior, chance, residual, shuffled, dolp, sum(part.images for part in parts))


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
    return Informativeness(
        _angle_deg(torch.cat([priors, _half_turned(priors, rays)]), true),
        _angle_deg(random, true),
        _residual(dolp, true, rays, index),
        _residual(dolp, shuffled, rays, index),
        float(dolp.median()),
    )


def _angle_deg(candidates: Tensor, true: Tensor) -> float:
    """Median over pixels of the angle between (3, n) and the nearest of (m, 3, n)."""
    cosine = (candidates * true).sum(1).amax(0).clamp(-1, 1)
    return float(torch.rad2deg(torch.acos(cosine)).median())


def _half_turned(normals: Tensor, rays: Tensor) -> Tensor:
    """Normals (m, 3, n) turned by 180 deg about their rays: the other azimuth."""
    along = (normals * rays).sum(1, keepdim=True)
    return 2 * along * rays - normals


def _residual(dolp: Tensor, normals: Tensor, rays: Tensor, index: float) -> float:
    diffuse, specular = physics.analytic_dolp(normals[None, :, None], rays[None, :, None], index)
    return float(torch.minimum((dolp - diffuse[0, 0]).abs(), (dolp - specular[0, 0]).abs()).mean())
