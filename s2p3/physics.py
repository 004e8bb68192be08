"""The polarimetric model: Fresnel's equations, the shape priors they allow, and their inverse.

Conventions. Normals are unit, point out of the surface, and live in the OpenCV camera frame (y down), so a
visible one has negative z at the image centre. Angles of polarization are counter-clockwise as displayed
(y up). Every pixel is treated in its own ray's frame: the camera frame turned by the shortest rotation that
takes the viewing ray onto the optical axis. In it theta is the angle between normal and viewer, and
phi = atan2(-m_y, m_x) the azimuth of the normal m; light reflected specularly is polarized along
phi + 90 deg, light that comes out of the body (diffuse) along phi (the paper's equation of the angle of
polarization). The paper treats only theta per ray; the azimuth per ray is our choice. It makes the model
exact under rotations about the optical axis.

Functions of `cos_theta` use arithmetic only and take tensors, arrays or floats alike.
"""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from dataset import ToolkitError
from s2p3.physics_kernels import priors

Numeric = TypeVar("Numeric", Tensor, float)
"""A tensor, or anything that computes like a float: also a numpy array."""

DARK = 1e-9
"""S0 and polarized intensity below this (white = 1) carry no direction: avoids 0 / 0 only."""


def fresnel(cos_theta: Numeric, index: float, extinction: float = 0.0) -> tuple[Numeric, Numeric]:
    """Reflectances (R_s, R_p) of a smooth surface in air, across and along the plane of incidence.

    Args:
        cos_theta: cosine of the angle of incidence, 0 to 1, any shape.
        index, extinction: the complex refractive index n + ik.

    Born and Wolf, Principles of Optics, section 14.2, without complex numbers.
    """
    sin2 = 1 - cos_theta * cos_theta
    real = index * index - extinction * extinction - sin2
    modulus = (real * real + 4 * index * index * extinction * extinction) ** 0.5
    a = (0.5 * (modulus + real)) ** 0.5
    cross = 2 * a * cos_theta
    r_s = (modulus - cross + cos_theta * cos_theta) / (modulus + cross + cos_theta * cos_theta)
    along = modulus * cos_theta * cos_theta + sin2 * sin2
    r_p = r_s * (along - cross * sin2) / (along + cross * sin2)
    return r_s, r_p


def rho_diffuse(cos_theta: Numeric, index: float) -> Numeric:
    """DoLP of diffuse reflection, first line of the paper's equation of the DoP; largest at grazing."""
    sin2 = 1 - cos_theta * cos_theta
    squared = index * index
    bend = squared - 2 + 1 / squared
    total = 2 + 2 * squared - (squared + 2 + 1 / squared) * sin2
    ratio: Numeric = bend * sin2 / (total + 4 * cos_theta * (squared - sin2) ** 0.5)
    return ratio


def rho_specular(cos_theta: Numeric, index: float) -> Numeric:
    """DoLP of specular reflection, second line of the paper's equation of the DoP; 1 at Brewster's angle."""
    sin2 = 1 - cos_theta * cos_theta
    squared = index * index
    ratio: Numeric = (
        2 * sin2 * cos_theta * (squared - sin2) ** 0.5 / (squared - sin2 - squared * sin2 + 2 * sin2 * sin2)
    )
    return ratio


def invert_dolp(dolp: Tensor, index: float) -> tuple[Tensor, Tensor, Tensor]:
    """sin^2 of the three angles that show a DoLP: theta_d (diffuse), theta_s1 <= Brewster <= theta_s2.

    Args:
        dolp: any shape, 0 to 1. Above the diffuse maximum theta_d is 90 deg.
        index: refractive index.

    Closed forms of our own: with k^2 = (1 - rho) / (1 + rho), the ratio of the two transmittances or
    reflectances, both equations of the DoP become quadratic in sin^2(theta).
    """
    squared = index * index
    k = ((1 - dolp) / (1 + dolp)).clamp_min(0).sqrt()
    k_diffuse = k.clamp_min(1 / index)
    diffuse = squared * (1 - k_diffuse * k_diffuse) / (1 + squared - 2 * index * k_diffuse)
    m = (1 - k) / (1 + k)
    root = (m * m * (squared - 1) ** 2 + 4 * squared).sqrt()
    below = 2 * m * squared / (m * (1 + squared) + root)
    root = ((squared - 1) ** 2 + 4 * squared * m * m).sqrt()
    above = 2 * squared / ((1 + squared) + root)
    return diffuse.clamp(0, 1), below.clamp(0, 1), above.clamp(0, 1)


def pixel_rays(K: Tensor, height: int, width: int) -> Tensor:
    """Unit viewing rays (B, 3, height, width) of B pinhole cameras (B, 3, 3); pixel centres at integers."""
    x = torch.arange(width, dtype=K.dtype, device=K.device)
    y = torch.arange(height, dtype=K.dtype, device=K.device)
    across = ((x - K[:, 0, 2, None]) / K[:, 0, 0, None])[:, None, :].expand(-1, height, -1)
    down = ((y - K[:, 1, 2, None]) / K[:, 1, 1, None])[:, :, None].expand(-1, -1, width)
    rays = torch.stack([across, down, torch.ones_like(across)], dim=1)
    return rays * rays.square().sum(1, keepdim=True).rsqrt()  # Tensor.norm over a dimension: 12 times slower


def to_ray_frame(normals: Tensor, rays: Tensor) -> Tensor:
    """Directions (B, 3, H, W) of the camera frame, in the frame of each pixel's ray (B, 3, H, W)."""
    x, y, z = normals.unbind(1)
    a, b, c = rays.unbind(1)
    along = z + (a * x + b * y) / (1 + c)
    return torch.stack([x - a * along, y - b * along, a * x + b * y + c * z], dim=1)


def from_ray_frame(directions: Tensor, rays: Tensor) -> Tensor:
    """Inverse of `to_ray_frame`."""
    x, y, z = directions.unbind(1)
    a, b, c = rays.unbind(1)
    along = z - (a * x + b * y) / (1 + c)
    return torch.stack([x + a * along, y + b * along, c * z - a * x - b * y], dim=1)


def check_index(index: float) -> None:
    """Raises a ToolkitError unless a body in air can have this refractive index."""
    if not 1 < index < math.inf:
        raise ToolkitError(f"{index:g} is not the refractive index of something in air; give one above 1")


def shape_priors(stokes: Tensor, index: float, K: Tensor, out: Tensor | None = None) -> Tensor:
    """The three normal maps that explain a measured polarization: n_d, n_s1, n_s2.

    Args:
        stokes: (B, 3, H, W) S0, S1, S2, in any unit.
        index: refractive index of the object.
        K: (B, 3, 3) intrinsics of these pixels.
        out: where to put the result, (B, 9, H, W) float32, contiguous, on the CPU: at a camera's rate a fresh
            array costs more than what is computed into it.

    Returns:
        (B, 9, H, W) unit normals, OpenCV camera frame. Of the two azimuths that differ by 180 deg the one
        equal to the angle of polarization in (-90, 90] deg is taken for n_d, and 90 deg more for n_s1 and
        n_s2. Finite everywhere, also without light. A measurement has no gradient: none flows to `stokes`.

    On the CPU in float32 by one compiled pass, elsewhere by `shape_priors_reference`; the compiled one is the
    more accurate of the two in float32, within 2e-6 of the exact normal but for one pixel in a thousand.

    Raises:
        ToolkitError: other shapes, or an index of nothing in air.
    """
    check_index(index)
    if stokes.ndim != 4 or stokes.shape[1] != 3 or K.shape != (len(stokes), 3, 3):
        raise ToolkitError(
            f"shape priors need Stokes images (B, 3, H, W) and cameras (B, 3, 3), "
            f"got {tuple(stokes.shape)} and {tuple(K.shape)}"
        )
    stokes, K = stokes.detach(), K.detach()
    if stokes.device.type != "cpu" or stokes.dtype != torch.float32:
        exact = shape_priors_reference(stokes, index, K)
        return exact if out is None else out.copy_(exact)
    pinholes = torch.stack([K[:, 0, 0], K[:, 1, 1], K[:, 0, 2], K[:, 1, 2]], dim=1).cpu().float().numpy()
    if out is None:
        out = torch.empty(len(stokes), 9, *stokes.shape[2:])
    images = zip(stokes.contiguous().numpy(), pinholes, out.numpy(), strict=True)
    for (s0, s1, s2), pinhole, maps in images:
        priors(s0, s1, s2, pinhole, np.float32(index), np.float32(DARK), 0, maps)
    return out


def shape_priors_reference(stokes: Tensor, index: float, K: Tensor) -> Tensor:
    """`shape_priors` in plain torch, for any device and precision: the paper's equations of AoP, DoP and
    normal as they stand, with the azimuth without trigonometry."""
    s0, s1, s2 = stokes.unbind(1)
    polarized = torch.hypot(s1, s2)
    dolp = (polarized / s0.clamp_min(DARK)).clamp(0, 1)
    doubled = torch.where(polarized > DARK, s1 / polarized.clamp_min(DARK), torch.ones_like(s1)).clamp(-1, 1)
    cosine = ((1 + doubled) / 2).sqrt()
    sine = ((1 - doubled) / 2).sqrt()
    sine = torch.where(s2 < 0, -sine, sine)
    rays = pixel_rays(K, stokes.shape[2], stokes.shape[3])
    diffuse, below, above = invert_dolp(dolp, index)
    normals = [
        from_ray_frame(_normal(cosine, sine, diffuse), rays),
        from_ray_frame(_normal(-sine, cosine, below), rays),
        from_ray_frame(_normal(-sine, cosine, above), rays),
    ]
    return torch.cat(normals, dim=1)


def _normal(cos_phi: Tensor, sin_phi: Tensor, sin2_theta: Tensor) -> Tensor:
    """The normal (B, 3, H, W) of azimuth phi and inclination theta in the ray frame (y down, z away)."""
    sin_theta = sin2_theta.sqrt()
    return torch.stack([cos_phi * sin_theta, -sin_phi * sin_theta, -(1 - sin2_theta).sqrt()], dim=1)


def cos_incidence(normals: Tensor, rays: Tensor) -> Tensor:
    """cos(theta_v) = n . v (B, H, W), clipped to [0, 1], with v = -ray (the paper's viewing vector)."""
    return (-(normals * rays).sum(1)).clamp(0, 1)


def analytic_dolp(normals: Tensor, rays: Tensor, index: float) -> tuple[Tensor, Tensor]:
    """The inverted physical model: the DoLP that normals would show, (rho_d, rho_s), each (B, H, W).

    Args:
        normals, rays: (B, 3, H, W).
        index: refractive index.

    Differentiable, and finite with finite gradients at 0 and 90 deg (the paper's equation of the analytical
    DoP).
    """
    cosine = cos_incidence(normals, rays)
    return rho_diffuse(cosine, index), rho_specular(cosine, index)


def doubled_azimuth(normals: Tensor, rays: Tensor) -> Tensor:
    """(cos 2 phi, sin 2 phi) of normals, (B, 2, H, W): the direction of (S1, S2) in diffuse light.

    In specular light (S1, S2) points the opposite way. Tends to zero, with finite gradients, where the normal
    faces the viewer and phi is undefined.
    """
    x, y, _ = to_ray_frame(normals, rays).unbind(1)
    inclined = x * x + y * y + 1e-8
    return torch.stack([(x * x - y * y) / inclined, -2 * x * y / inclined], dim=1)
