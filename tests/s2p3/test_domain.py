"""The domains that scenes are drawn from, and the gap between them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dataset import Intrinsics
from s2p3 import objects
from s2p3.synthesis import (
    CAPTURED,
    DOMAINS,
    PLAIN,
    SYNTHETIC,
    Analytic,
    Domain,
    Recipe,
    SceneParameters,
    render,
)

TINY = Intrinsics(np.array([[60.0, 0, 39.0], [0, 60.0, 31.5], [0, 0, 1]]), np.zeros(0), 64, 80)
CUP = objects.build("cup")


def _drawn(domain: Domain, count: int) -> tuple[list[SceneParameters], list[float]]:
    recipe = Recipe(CUP, TINY, domain, Analytic(), 0)
    scenes = [recipe.draw(index).scene for index in range(count)]
    return [scene.parameters for scene in scenes], [scene.visible_fraction for scene in scenes]


def test_the_captured_domain_lies_beside_the_synthetic_one() -> None:
    captured, visible = _drawn(CAPTURED, 150)
    synthetic, _ = _drawn(SYNTHETIC, 60)
    index = [scene.surface.refractive_index for scene in captured]
    assert np.mean(index) == pytest.approx(1.6, abs=0.01)
    for name in ("full_well", "dolp_scale", "blur_px", "read_noise"):
        ours, theirs = ([getattr(scene, name) for scene in scenes] for scenes in (captured, synthetic))
        sign = -1 if name in ("full_well", "dolp_scale") else 1
        assert sign * np.mean(ours) > sign * np.mean(theirs), name
    haze = [np.mean([scene.haze_dolp.max() for scene in scenes]) for scenes in (captured, synthetic)]
    assert haze[0] > 1.5 * haze[1]
    assert 0.08 < np.mean(np.array(visible) < 0.98) < 0.21  # 13 to 16 % in the long run


def test_the_plain_domain_shows_the_object_alone_and_as_the_model_says() -> None:
    plain, visible = _drawn(PLAIN, 40)
    assert min(visible) > 0.98
    assert {scene.surface.refractive_index for scene in plain} == {CUP.refractive_index}
    assert all(scene.dolp_scale == 1 and not scene.haze_dolp.any() for scene in plain)


def test_matte_tables_do_not_polarize() -> None:
    domain = replace(SYNTHETIC, matte_table_share=1.0, clutter=(0, 0), occluder_share=0.0)
    drawn = Recipe(CUP, TINY, domain, Analytic(), 1).draw(0)
    sharp = replace(drawn.scene.parameters, blur_px=0.0)
    stokes = render(replace(drawn.scene, parameters=sharp), Analytic()).stokes
    assert stokes.dolp[~drawn.scene.covered].max() < 1e-6
    assert stokes.dolp[drawn.scene.mask].max() > 0.1


def test_a_given_material_is_kept_near() -> None:
    red = replace(CUP, albedo=0.3, roughness=0.2)
    recipe = Recipe(red, TINY, SYNTHETIC, Analytic(), 2)
    surfaces = [recipe.draw(index).scene.parameters.surface for index in range(20)]
    assert all(0.25 < surface.albedo < 0.35 for surface in surfaces)
    assert all(0.15 < surface.roughness < 0.26 for surface in surfaces)
    steel = replace(objects.build("fork"), extinction=3.8)
    surface = Recipe(steel, TINY, SYNTHETIC, Analytic(), 3).draw(0).scene.parameters.surface
    assert (surface.kind, surface.extinction, surface.albedo) == ("metal", 3.8, 0.0)


def test_domains_have_names() -> None:
    assert DOMAINS == {"plain": PLAIN, "synthetic": SYNTHETIC, "captured": CAPTURED}
