"""What synthetic scenes are drawn from: the ranges of views, light, surfaces and disturbances.

All ranges are our choice; the paper says only that backgrounds and lighting were varied and cameras drawn
from the upper hemisphere. Object surfaces are either prevailingly specular or prevailingly diffuse: where
the two balance, their polarizations cancel and a set teaches nothing about polarization.
"""

from __future__ import annotations

from dataclasses import dataclass

from s2p3.synthesis.views import Range, Views, ViewsLike

_ALL_AROUND = Views()


@dataclass(frozen=True)
class Domain:
    """Ranges that `draw_scene` draws from. Both backends read all of them, except where it says otherwise."""

    views: Views | ViewsLike = _ALL_AROUND
    specular_share: float = 0.75
    """Share of scenes in which materials without a given colour are prevailingly specular; metals always
    are."""
    index_scale: Range = (0.95, 1.07)
    """Refractive index, relative to the object's."""
    dolp_scale: Range = (0.9, 1.0)
    lamps: tuple[int, int] = (1, 4)
    lamp_glare: Range = (1.0, 10.0)
    lamp_sharpness: Range = (4.0, 50.0)
    ambient: Range = (0.1, 0.35)
    """Irradiance from everywhere; analytic only."""
    specular_sky: Range = (0.4, 1.3)
    """Radiance of the surroundings in specular scenes."""
    diffuse_sky: Range = (0.02, 0.08)
    """The same in diffuse scenes, where analytic lamps light without being mirrored as much."""
    matte_table_share: float = 0.3
    """Share of scenes on an unpolarized background: cloth, paper."""
    table_gloss: Range = (0.0, 0.5)
    haze_dolp: Range = (0.0, 0.25)
    """Largest additional degree of polarization of the background, where it is not matte."""
    clutter: tuple[int, int] = (0, 3)
    occluder_share: float = 0.2
    """Share of scenes with something between camera and object."""
    smallest_visible_fraction: float = 0.5
    blur_px: Range = (0.3, 0.8)
    level: Range = (0.16, 0.4)
    full_well: Range = (20000.0, 42000.0)
    """Electrons of four pixels together, as in a colour super-pixel."""
    read_noise: Range = (4.0, 16.0)


SYNTHETIC = Domain()
"""The domain that `synthesize` draws from unless told otherwise."""

PLAIN = Domain(
    index_scale=(1.0, 1.0),
    dolp_scale=(1.0, 1.0),
    haze_dolp=(0.0, 0.0),
    clutter=(0, 0),
    occluder_share=0.0,
    blur_px=(0.3, 0.4),
    level=(0.25, 0.4),
    full_well=(40000.0, 42000.0),
    read_noise=(4.0, 5.0),
)
"""What one renders first: the material as the model says, nothing beside the object, a good camera. Light,
table and views vary as in `SYNTHETIC`; whatever else a captured image holds is missing."""

CAPTURED = Domain(
    specular_share=0.9,
    index_scale=(1.05, 1.085),
    dolp_scale=(0.88, 0.96),
    lamps=(3, 6),
    lamp_glare=(3.0, 14.0),
    lamp_sharpness=(20.0, 120.0),
    ambient=(0.05, 0.3),
    specular_sky=(0.3, 1.0),
    diffuse_sky=(0.03, 0.12),
    matte_table_share=0.1,
    table_gloss=(0.3, 1.0),
    haze_dolp=(0.1, 0.4),
    clutter=(1, 4),
    occluder_share=0.125,
    blur_px=(0.6, 1.2),
    level=(0.1, 0.3),
    full_well=(8000.0, 16000.0),
    read_noise=(12.0, 30.0),
)
"""A stand-in for captured images, wider than the gap within `SYNTHETIC`: a denser material (1.6 where the
model says 1.5), harder and more lamps, glossier and more polarized backgrounds, leaking polarizers, blur,
noise, and the object covered in about every seventh frame."""

DOMAINS = {"plain": PLAIN, "synthetic": SYNTHETIC, "captured": CAPTURED}
"""By the names the command line knows."""
