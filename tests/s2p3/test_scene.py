"""Synthetic scenes and whole sets: physical, informative, reproducible, resumable."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibration import Calibration, IntrinsicsRecord
from dataset import SE3, Intrinsics, ToolkitError
from dataset.frames import Mosaic
from dataset.polarimetry import Stokes, decode
from dataset.session import Session
from s2p3 import objects
from s2p3.objects import ObjectModel
from s2p3.rendering import rasterize
from s2p3.synthesis import (
    SYNTHETIC,
    Analytic,
    Domain,
    Recipe,
    Scene,
    SceneImage,
    Views,
    draw_scene,
    render,
    session_camera,
    synthesize,
)
from s2p3.synthesis.frames import Drawn
from s2p3.synthesis.informativeness import Informativeness, measure
from s2p3.synthesis.sensor import expose

SMALL = Intrinsics(np.array([[120.0, 0, 79.0], [0, 121.0, 63.5], [0, 0, 1]]), np.zeros(0), 128, 160)
CUP = objects.build("cup")


def _frame(model: ObjectModel, domain: Domain, seed: int, index: int) -> tuple[Drawn, SceneImage]:
    drawn = Recipe(model, SMALL, domain, Analytic(), seed).draw(index)
    return drawn, render(drawn.scene, Analytic())


def _scene(seed: int) -> tuple[Scene, np.random.Generator]:
    rng = np.random.default_rng(seed)
    T_cam_obj = SYNTHETIC.views.draw(CUP, SMALL, rng)
    return Scene(CUP, T_cam_obj, SMALL, draw_scene(SYNTHETIC, CUP, T_cam_obj, rng)), rng


def test_views_lie_on_the_upper_hemisphere_within_their_ranges() -> None:
    views = Views(distance_m=(0.4, 0.5), elevation_deg=(15.0, 70.0), roll_deg=(0.0, 0.0), offset=0.3)
    rng = np.random.default_rng(0)
    azimuths = []
    for _ in range(200):
        T_obj_cam = views.draw(CUP, SMALL, rng).inverse()
        eye = T_obj_cam.translation
        distance = np.linalg.norm(eye)
        assert 0.4 <= distance <= 0.5
        assert 15 - 1e-6 <= np.degrees(np.arcsin(eye[2] / distance)) <= 70 + 1e-6
        azimuths.append(np.arctan2(eye[1], eye[0]))
        x, y = SMALL.project(T_obj_cam.inverse().translation)
        assert abs(x - 79.5) <= 0.3 * 80 + 1e-6
        assert abs(y - 63.5) <= 0.3 * 64 + 1e-6
        assert T_obj_cam.rotation[2, 1] < 0  # without roll the image's down is the world's down
    assert np.ptp(azimuths) > 6


@pytest.mark.parametrize("name", objects.NAMES)
def test_a_frame_shows_the_object_where_its_truth_says(name: str) -> None:
    model = objects.build(name)
    drawn, image = _frame(model, SYNTHETIC, seed=1, index=0)
    full = rasterize(model.mesh, drawn.scene.T_cam_obj, SMALL).mask
    assert not (image.mask & ~full).any()
    assert image.visible_fraction == pytest.approx(image.mask.sum() / full.sum())
    assert image.visible_fraction >= SYNTHETIC.smallest_visible_fraction
    stokes = image.stokes
    assert (stokes.s0 > 0).all()
    assert (np.hypot(stokes.s1, stokes.s2) <= stokes.s0 * (1 + 1e-4)).all()


def test_clutter_occludes_and_the_background_is_sometimes_polarized() -> None:
    hidden, polarized = 0, 0
    for index in range(12):
        _, image = _frame(CUP, SYNTHETIC, seed=2, index=index)
        hidden += image.visible_fraction < 0.999
        polarized += np.quantile(image.stokes.dolp[~image.mask], 0.9) > 0.1
    assert 0 < hidden < 12
    assert polarized > 0


def test_the_sensor_adds_the_noise_it_is_given() -> None:
    scene, rng = _scene(3)
    parameters = replace(scene.parameters, full_well=1000.0, read_noise=5.0, level=0.15)
    stokes = render(replace(scene, parameters=parameters), Analytic()).stokes
    assert float(stokes.s0.mean()) == pytest.approx(0.3, rel=1e-4)
    frames = np.stack([expose(stokes, parameters, 12, rng) for _ in range(60)]).astype(np.float64)
    mean, variance = frames.mean(axis=0) / 4095, frames.var(axis=0) / 4095**2
    dim = (mean > 0.02) & (mean < 0.5)
    expected = mean / 1000 + (5 / 1000) ** 2
    assert float((variance / expected)[dim].mean()) == pytest.approx(1.0, abs=0.05)
    noiseless = decode(
        expose(stokes, replace(parameters, full_well=1e9, read_noise=0.0), 12, rng), "mono", 12
    )
    valid = noiseless.valid
    np.testing.assert_allclose(noiseless.s1[valid], stokes.s1[valid], atol=1e-3)


def test_the_captured_domain_is_within_reach_of_the_parameters() -> None:
    scene, _ = _scene(4)
    black = replace(scene.parameters.surface, albedo=0.0)
    parameters = replace(scene.parameters, surface=black, clutter=(), blur_px=0.0, dolp_scale=1.0)
    plain = render(replace(scene, parameters=parameters), Analytic())
    leaking = render(replace(scene, parameters=replace(parameters, dolp_scale=0.95)), Analytic())
    np.testing.assert_allclose(leaking.stokes.s1, 0.95 * plain.stokes.s1, atol=1e-6)
    index = parameters.surface.refractive_index + 0.1
    denser = replace(parameters, surface=replace(black, refractive_index=index))
    other = render(replace(scene, parameters=denser), Analytic()).stokes
    assert np.abs(other.dolp - plain.stokes.dolp)[plain.mask].max() > 0.01


def test_informativeness_tells_polarization_from_its_absence() -> None:
    drawn, image = _frame(CUP, replace(SYNTHETIC, specular_share=1.0), seed=7, index=0)
    normals = rasterize(CUP.mesh, drawn.scene.T_cam_obj, SMALL).normals
    stokes = image.stokes.stack()
    good = measure(stokes, normals, image.mask, SMALL.K, 1.5)
    assert good is not None
    assert good.prior_error_deg < 0.6 * good.chance_error_deg
    assert good.dolp_residual < 0.8 * good.dolp_residual_shuffled
    assert np.argmax(np.array(good.prior_within) > 0.5) + 1 == pytest.approx(good.prior_error_deg, abs=1.0)
    assert (np.diff(good.prior_within) >= 0).all()
    assert Informativeness.from_json(good.to_json()) == good
    stokes[1:] = 0
    nothing = measure(stokes, normals, image.mask, SMALL.K, 1.5)
    assert nothing is not None
    assert nothing.prior_error_deg > 0.8 * nothing.chance_error_deg
    assert nothing.dolp_residual == pytest.approx(nothing.dolp_residual_shuffled, rel=0.05)
    assert measure(stokes, normals, np.zeros_like(image.mask), SMALL.K, 1.5) is None


def test_a_set_is_a_session_with_its_truth(tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    path = tmp_path / "set.h5"
    figures = synthesize(CUP, 3, SMALL, 7, path, on_progress=lambda done, count: seen.append((done, count)))
    assert seen == [(1, 3), (2, 3), (3, 3)]
    assert figures.images == 3
    assert "prior" in str(figures)
    beside = ["set.h5", "set.informativeness.png", "set.manifest.json"]
    assert sorted(p.name for p in tmp_path.iterdir()) == beside
    stored = json.loads((tmp_path / "set.manifest.json").read_text())
    assert Informativeness.from_json(json.dumps(stored["informativeness"])) == figures
    assert cv2.imread(str(tmp_path / "set.informativeness.png")).std() > 10
    with Session.open(path) as session:
        assert len(session) == 3
        np.testing.assert_allclose(session.working_intrinsics.K, SMALL.K, atol=1e-9)
        truth = session.object_poses("cup")
        assert session.object("cup").refractive_index == 1.5
        for i in range(3):
            drawn, image = _frame(CUP, SYNTHETIC, 7, i)
            raw = expose(image.stokes, drawn.scene.parameters, 12, drawn.noise)
            np.testing.assert_array_equal(session.raw(i), raw)
            np.testing.assert_allclose(truth.T_cam_obj[i].as_matrix(), drawn.scene.T_cam_obj.as_matrix())
            np.testing.assert_array_equal(truth.mask(i), image.mask)
            x, y, w, h = truth.bbox_xywh[i].astype(int)
            assert image.mask[y : y + h, x : x + w].sum() == image.mask.sum()
            assert image.mask[y].any()
            assert image.mask[:, x + w - 1].any()
    with pytest.raises(ToolkitError, match="exists"):
        synthesize(CUP, 3, SMALL, 7, path)


def test_an_interrupted_set_goes_on_and_equals_one_made_by_two_processes(tmp_path: Path) -> None:
    class Interrupted(Exception):
        pass

    def stop(done: int, count: int) -> None:
        if done == 2:
            raise Interrupted

    with pytest.raises(Interrupted):
        synthesize(CUP, 4, SMALL, 8, tmp_path / "one.h5", on_progress=stop)
    assert not (tmp_path / "one.h5").exists()
    seen: list[int] = []
    synthesize(CUP, 4, SMALL, 8, tmp_path / "one.h5", on_progress=lambda done, _: seen.append(done))
    assert seen == [3, 4]
    synthesize(CUP, 4, SMALL, 8, tmp_path / "two.h5", workers=2)
    with Session.open(tmp_path / "one.h5") as one, Session.open(tmp_path / "two.h5") as two:
        for i in range(4):
            np.testing.assert_array_equal(one.raw(i), two.raw(i))


def test_an_object_out_of_sight_is_an_error_that_says_so(tmp_path: Path) -> None:
    far = replace(SYNTHETIC, views=Views(distance_m=(40.0, 50.0)))
    with pytest.raises(ToolkitError, match="hardly visible"):
        synthesize(CUP, 1, SMALL, 0, tmp_path / "far.h5", domain=far)


@pytest.mark.parametrize(("mosaic", "side"), [("mono", 2), ("colour", 4), (None, 4)])
def test_a_calibrated_cameras_working_image_has_a_pixel_per_superpixel(
    mosaic: Mosaic | None, side: int, tmp_path: Path
) -> None:
    K = np.array([[1400.0, 0, 1223.5], [0, 1400.0, 1023.5], [0, 0, 1]])
    lens = Intrinsics(K, np.zeros(5), 2048, 2448)
    record = IntrinsicsRecord(lens, np.eye(9), 0.04, 0.05, 20, (), (), mosaic)
    Calibration(intrinsics=record).save(tmp_path / "calibration.json")
    camera = session_camera(tmp_path / "calibration.json")
    assert (camera.height, camera.width) == (2048 // side, 2448 // side)
    np.testing.assert_allclose(camera.K, lens.at(side).K)


def test_the_default_camera_is_the_published_one() -> None:
    camera = session_camera()
    assert (camera.height, camera.width) == (512, 612)
    assert camera.K[0, 0] == 351.450


def test_what_the_images_edge_cuts_off_is_not_visible() -> None:
    camera = Intrinsics(SMALL.K, np.zeros(0), SMALL.height, SMALL.width)
    rng = np.random.default_rng(0)
    T_cam_obj = SYNTHETIC.views.draw(CUP, camera, rng)
    bare = replace(draw_scene(SYNTHETIC, CUP, T_cam_obj, rng), clutter=())
    middle, cut = (
        Scene(CUP, SE3(T_cam_obj.rotation, np.array([x, 0.0, 0.5])), camera, bare) for x in (0.0, -0.33)
    )
    assert middle.visible_fraction == 1
    whole = rasterize(CUP.mesh, cut.T_cam_obj, camera.surrounded).mask
    assert cut.mask.sum() == whole[camera.middle].sum()
    assert 0.1 < cut.visible_fraction == cut.mask.sum() / whole.sum() < 0.9


def test_a_monochrome_sensor_of_five_megapixels_is_read_out() -> None:
    size = (1024, 1224)
    light = Stokes(np.full(size, 0.5, np.float32), *np.zeros((2, *size), np.float32), np.ones(size, bool))
    raw = expose(light, _scene(0)[0].parameters, 12, np.random.default_rng(0))
    assert raw.shape == (2048, 2448)
    assert raw.std() > 0
