"""The differentiable renderer: the rasterizer's values, exact interior gradients, silhouettes that move."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from dataset import SE3, Intrinsics, ToolkitError
from s2p3 import object_meshes, objects
from s2p3.rendering import Mesh, rasterize
from s2p3.rendering.differentiable import RenderMesh, render, render_each, render_reference

SIZE = 128


@pytest.fixture(scope="module", params=objects.NAMES)
def model(request: pytest.FixtureRequest) -> objects.ObjectModel:
    return objects.build(request.param)


def _views(
    model: objects.ObjectModel, count: int, seed: int, zoom: float = 0.75
) -> tuple[Tensor, Tensor, Tensor]:
    R = torch.from_numpy(Rotation.random(count, random_state=seed).as_matrix()).float()
    t = torch.tensor([[0.01, -0.02, 0.6]]).repeat(count, 1)
    f = SIZE * 0.6 * zoom / model.diameter
    K = torch.tensor([[f, 0, SIZE / 2], [0, f, SIZE / 2 - 1], [0, 0, 1]]).repeat(count, 1, 1)
    return R, t, K


def _rotate(w: Tensor) -> Tensor:
    x, y, z = w.unbind(-1)
    o = torch.zeros_like(x)
    return torch.linalg.matrix_exp(torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=-1).view(-1, 3, 3))


def test_values_are_the_rasterizers(model: objects.ObjectModel) -> None:
    R, t, K = _views(model, 2, seed=1)
    output = render(RenderMesh.from_mesh(model.mesh), R, t, K, SIZE, SIZE)
    for b in range(2):
        camera = Intrinsics(K[b].numpy(), np.zeros(0), SIZE, SIZE)
        raster = rasterize(model.mesh, SE3(R[b].double().numpy(), t[b].double().numpy()), camera)
        same = output.mask[b, 0].numpy() == raster.mask
        assert same.mean() > 0.9995
        both = raster.mask & same
        facing = -(raster.normals * camera.rays()).sum(axis=-1) > 0.1
        for image, expected, tolerance in (
            (output.normals, raster.normals, 2e-3),
            (output.nocs, raster.nocs, 1e-3),
            (output.depth, raster.depth[..., None], 1e-4),
        ):
            error = np.abs(image[b].permute(1, 2, 0).numpy() - expected)[both & facing]
            assert np.quantile(error, 0.995) < tolerance


def test_the_fast_path_equals_the_reference_with_gradients(model: objects.ObjectModel) -> None:
    mesh = RenderMesh.from_mesh(model.mesh)
    R, t, K = (x.double() for x in _views(model, 3, seed=2, zoom=1.3))  # zoomed in: cut by the image's border
    weights = torch.randn(3, 11, SIZE, SIZE, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    results = []
    for function in (render, render_reference):
        pose = R.clone().requires_grad_(), t.clone().requires_grad_()
        o = function(mesh, *pose, K, SIZE, SIZE)
        images = torch.cat([o.mask, o.normals, o.normals_interior, o.depth, o.nocs], dim=1)
        (images * weights).sum().backward()
        results.append((images.detach(), pose[0].grad, pose[1].grad))
    for fast, reference in zip(*results, strict=True):
        assert fast is not None
        assert reference is not None
        torch.testing.assert_close(fast, reference, rtol=1e-4, atol=2e-5)


def test_interior_gradients_pass_gradcheck() -> None:
    corners = [[-9.0, -8, 0.1], [11, -9, -0.2], [0, 12, 0]]
    mesh = Mesh.from_arrays(
        [*corners, [0, 0, 5.0]], [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], crease_deg=180
    )
    triangle = RenderMesh.from_mesh(mesh)
    K = torch.tensor([[[8.0, 0, 3], [0, 8, 2], [0, 0, 1]]], dtype=torch.float64)

    def images(w: Tensor, t: Tensor) -> tuple[Tensor, ...]:
        output = render(triangle, _rotate(w[None]), t[None], K, 6, 7)
        return output.normals, output.normals_interior, output.depth, output.nocs

    w = torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64, requires_grad=True)
    t = torch.tensor([0.2, 0.1, 4.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(images, (w, t), eps=1e-5, atol=1e-4)


def _weighted(
    mesh: RenderMesh, pose: tuple[Tensor, Tensor, Tensor], step: Tensor, weight: Tensor, finer: int, name: str
) -> Tensor:
    """A weighted sum of one map, (B,), at poses moved by `step` (B, 6), rendered `finer` times as fine."""
    R, t, K = pose
    K = K.clone()
    K[:, :2] *= finer
    K[:, :2, 2] += (finer - 1) / 2
    side = SIZE * finer
    output = render(mesh, _rotate(step[:, :3]) @ R, t + step[:, 3:], K, side, side)
    return (torch.nn.functional.avg_pool2d(getattr(output, name), finer) * weight).sum((1, 2, 3))


def _gradients(
    model: objects.ObjectModel, views: int, finer: int, name: str, sizes: Tensor
) -> tuple[Tensor, Tensor]:
    """Gradients at `finer` times the resolution, and central differences at four times, both (views, 6)."""
    mesh = RenderMesh.from_mesh(model.mesh)
    pose = _views(model, views, seed=0)
    rough = torch.randn(views, 3, 5, 5, generator=torch.Generator().manual_seed(0))
    weight = torch.nn.functional.interpolate(rough, (SIZE, SIZE), mode="bicubic")
    weight = weight[:, :1] if name == "mask" else weight
    step = torch.zeros(views, 6, requires_grad=True)
    (gradient,) = torch.autograd.grad(_weighted(mesh, pose, step, weight, finer, name).sum(), step)
    with torch.no_grad():
        change = [
            _weighted(mesh, pose, d.expand(views, 6), weight, 4, name)
            - _weighted(mesh, pose, -d.expand(views, 6), weight, 4, name)
            for d in torch.diag(sizes)
        ]
    return gradient, torch.stack(change, dim=1) / (2 * sizes)


def _agree(ours: Tensor, theirs: Tensor, cosine: float, scale: float) -> None:
    for part in (slice(0, 3), slice(3, 5), slice(5, 6)):
        a, b = ours[:, part].flatten(), theirs[:, part].flatten()
        assert torch.nn.functional.cosine_similarity(a, b, dim=0) > cosine
        assert float(a.norm() / b.norm()) == pytest.approx(1, abs=scale)


def test_silhouette_gradients_follow_finite_differences(model: objects.ObjectModel) -> None:
    sizes = torch.tensor([0.02] * 3 + [0.005 * model.diameter] * 2 + [0.04 * model.diameter])
    _agree(*_gradients(model, 8, 1, "mask", sizes), cosine=0.97, scale=0.1)


@pytest.mark.parametrize(("name", "cosine"), [("cup", 0.9), ("fork", 0.8), ("knife", 0.9), ("bottle", 0.9)])
def test_gradients_of_normals_follow_finite_differences_across_creases(name: str, cosine: float) -> None:
    model = objects.build(name)
    sizes = torch.tensor([0.02] * 3 + [0.005 * model.diameter] * 2 + [0.04 * model.diameter])
    _agree(*_gradients(model, 8, 4, "normals", sizes), cosine, scale=0.25)


def test_the_edge_of_a_folded_plate_moves_its_normals() -> None:
    box = RenderMesh.from_mesh(Mesh.from_arrays(*object_meshes.box((0.2, 0.2, 0.2))))
    R = _rotate(torch.tensor([[0.0, np.pi / 4, 0]]))  # one upright edge towards the camera
    t = torch.tensor([[0.0, 0, 0.6]], requires_grad=True)
    K = torch.tensor([[[150.0, 0, 63], [0, 150, 63], [0, 0, 1]]])
    output = render(box, R, t, K, SIZE, SIZE)
    near = torch.zeros(1, 3, SIZE, SIZE)
    near[:, 0, 54:74, 50:78] = 1  # around the edge alone
    (gradient,) = torch.autograd.grad((output.normals * near).sum(), t)
    jump, rows, depth = -np.sqrt(2), 20, 0.6 - 0.1 * np.sqrt(2)  # left minus right, of the normals' x
    assert float(gradient[0, 0]) == pytest.approx(jump * rows * 150 / depth, rel=0.02)


@pytest.mark.parametrize("name", ["cup", "knife"])
def test_mask_and_normals_lead_back_to_the_pose(name: str) -> None:
    model = objects.build(name)
    mesh = RenderMesh.from_mesh(model.mesh)
    R, t, K = _views(model, 3, seed=8)
    target = render(mesh, R, t, K, SIZE, SIZE)
    start = (
        _rotate(torch.tensor([[0.06, -0.05, 0.03]])) @ R,
        t + model.diameter * torch.tensor([0.02, 0.02, 0.01]),
    )
    points = torch.from_numpy(model.surface_points(200)).float()

    def moved(change: Tensor) -> tuple[Tensor, Tensor]:
        return _rotate(change[:, :3]) @ start[0], start[1] + 0.5 * model.diameter * change[:, 3:]

    def distance(change: Tensor) -> Tensor:
        turned, shifted = moved(change)
        apart = points @ (turned - R).transpose(1, 2) + (shifted - t)[:, None]
        return apart.norm(dim=-1).mean(1) / model.diameter

    steps = 100
    change, mean, moment = torch.zeros(3, 6), torch.zeros(3, 6), torch.zeros(3, 6, 6)
    assert (distance(change) > 0.03).all()
    for i in range(steps):  # Adam with the whole second moment: tilt and distance look alike
        change.requires_grad_()
        output = render(mesh, *moved(change), K, SIZE, SIZE)
        apart = (output.normals_interior - target.normals).square().sum(1, keepdim=True)
        same = output.mask.detach() * target.mask * (apart.detach() < 0.25)
        difference = output.mask - target.mask
        coarse = torch.nn.functional.avg_pool2d(difference, 4)
        loss = difference.square().sum() + 16 * coarse.square().sum() + 5 * (apart * same).sum()
        (gradient,) = torch.autograd.grad(loss, change)
        mean = 0.8 * mean + 0.2 * gradient
        moment = 0.95 * moment + 0.05 * gradient[:, :, None] * gradient[:, None]
        values, axes = torch.linalg.eigh(moment / (1 - 0.95 ** (i + 1)))
        scale = (values.clamp_min(0) + 1e-4 * values[:, -1:] + 1e-16).sqrt()[:, :, None]
        step = axes @ (axes.transpose(1, 2) @ mean[:, :, None] / scale) / (1 - 0.8 ** (i + 1))
        change = change.detach() - 0.03 * (1 - i / steps) * step[:, :, 0]
    assert (distance(change) < 0.02).all()


def test_a_ball_that_comes_nearer_grows_and_one_that_turns_keeps_its_outline() -> None:
    ball = RenderMesh.from_mesh(Mesh.from_arrays(*object_meshes.ellipsoid((0.2, 0.2, 0.2)), crease_deg=60))
    w = torch.zeros(1, 3, requires_grad=True)
    t = torch.tensor([[0.0, 0, 0.6]], requires_grad=True)
    K = torch.tensor([[[150.0, 0, 63], [0, 150, 63], [0, 0, 1]]])
    mask = render(ball, _rotate(w), t, K, SIZE, SIZE).mask
    area = float(mask.detach().sum())
    across = torch.linspace(-1, 1, SIZE).expand(SIZE, SIZE)
    (growth,) = torch.autograd.grad(mask.sum(), t, retain_graph=True)
    turning, moving = torch.autograd.grad((mask * across).sum(), (w, t))
    assert float(growth[0, 2]) == pytest.approx(-2 * 0.6 * area / (0.6**2 - 0.1**2), rel=0.05)
    assert (
        float(turning.abs().max()) < 0.05 * float(moving.abs().max()) * 0.1
    )  # as if its points were its rim


def test_without_silhouettes_the_mask_is_constant() -> None:
    model = objects.build("cup")
    R, t, K = _views(model, 1, seed=4)
    t = t.requires_grad_()
    output = render(RenderMesh.from_mesh(model.mesh), R, t, K, SIZE, SIZE, silhouette=False)
    (gradient,) = torch.autograd.grad(output.mask.sum(), t)
    assert not gradient.any()


@pytest.mark.parametrize("translation", [[5.0, 0, 0.6], [0, 0, -0.6], [0.12, 0, 0.6], [0, 0, 0.02]])
@pytest.mark.parametrize("function", [render, render_reference])
def test_off_screen_clipped_and_behind_the_camera(function: type(render), translation: list[float]) -> None:
    model = objects.build("cup")
    R, _, K = _views(model, 1, seed=5)
    pose = R.requires_grad_(), torch.tensor([translation]).requires_grad_()
    o = function(RenderMesh.from_mesh(model.mesh), *pose, K, SIZE, SIZE)
    total = o.mask.sum() + o.normals.square().sum() + o.depth.sum() + o.nocs.sum()
    total.backward()
    for value in (total, pose[0].grad, pose[1].grad):
        assert value is not None
        assert torch.isfinite(value).all()
    if abs(translation[0]) > 1 or translation[2] < 0:
        assert not o.mask.any()
        assert pose[1].grad is not None
        assert not pose[1].grad.any()


def test_a_batch_is_its_images_and_autocast_stays_in_float32() -> None:
    model = objects.build("fork")
    mesh = RenderMesh.from_mesh(model.mesh)
    R, t, K = _views(model, 3, seed=6)
    batch = render(mesh, R, t, K, SIZE, SIZE)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        single = render(mesh, R[1:2], t[1:2], K[1:2], SIZE, SIZE)
    assert single.normals.dtype == torch.float32
    torch.testing.assert_close(single.nocs[0], batch.nocs[1])
    torch.testing.assert_close(single.normals[0], batch.normals[1])


def test_a_batch_of_objects_is_each_of_them_with_its_gradients() -> None:
    cup, fork = (RenderMesh.from_mesh(objects.build(name).mesh) for name in ("cup", "fork"))
    R, t, K = _views(objects.build("cup"), 4, seed=9)
    weight = torch.randn(4, 8, SIZE, SIZE, generator=torch.Generator().manual_seed(0))
    order = [cup, fork, cup, fork]
    results = []
    for separately in (False, True):
        pose = R.clone().requires_grad_(), t.clone().requires_grad_()
        if separately:
            single = [
                render(mesh, pose[0][[i]], pose[1][[i]], K[[i]], SIZE, SIZE) for i, mesh in enumerate(order)
            ]
            maps = torch.cat([torch.cat([o.mask, o.normals, o.depth, o.nocs], dim=1) for o in single])
        else:
            o = render_each(order, *pose, K, SIZE, SIZE)
            maps = torch.cat([o.mask, o.normals, o.depth, o.nocs], dim=1)
        results.append((maps.detach(), *torch.autograd.grad((maps * weight).sum(), pose)))
    for together, apart in zip(*results, strict=True):
        torch.testing.assert_close(together, apart)
    with pytest.raises(ToolkitError, match="3 meshes at 4 poses"):
        render_each(order[:3], R, t, K, SIZE, SIZE)


def test_poses_and_cameras_that_do_not_belong_together_are_refused() -> None:
    mesh = RenderMesh.from_mesh(objects.build("cup").mesh)
    R, t, K = _views(objects.build("cup"), 2, seed=1)
    for wrong in ((R, t, K[:1]), (R[:1], t, K), (R, t[0], K)):
        with pytest.raises(ToolkitError, match="must be"):
            render(mesh, *wrong, SIZE, SIZE)
    render(mesh, R, t, K.requires_grad_(), SIZE, SIZE).mask.sum()  # no gradient to the camera, no error


@pytest.mark.parametrize("function", [render, render_reference])
def test_a_pose_that_is_no_number_shows_nothing(function: type(render)) -> None:
    mesh = RenderMesh.from_mesh(objects.build("cup").mesh)
    R, t, K = _views(objects.build("cup"), 1, seed=1)
    assert not function(mesh, R, t * torch.nan, K, SIZE, SIZE).mask.any()
    assert not function(mesh, R * torch.nan, t, K, SIZE, SIZE).mask.any()
