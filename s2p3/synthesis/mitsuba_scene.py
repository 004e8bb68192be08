"""A scene in Mitsuba's terms: meshes, materials, light and camera. The world is the table's frame.

Mitsuba's camera looks along +z with +x to the left and +y up; ours has +x right and +y down.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataset import SE3, Intrinsics
from s2p3.rendering import Mesh
from s2p3.synthesis.lighting import Light, Surface
from s2p3.synthesis.scene import Scene

Array = NDArray[np.float64]
Image = NDArray[np.float32]

_TABLE_M = 4.0  # side of the table; beyond its edge one sees the surroundings
_PANORAMA_ROWS = 128
_WALL_DEG = (
    -4.0,
    30.0,
    40.0,
)  # elevations between which the wall stands, and where it has faded into the sky
_SMOOTHEST = 0.002
_BOUNCES, _BOUNCES_IN_GLASS = (6, 3), (14, 10)  # at most, and before paths may be ended by chance


def scene_dict(mi: Any, scene: Scene) -> dict[str, Any]:
    """The dictionary of `mitsuba.load_dict`: shapes, emitter and integrator, without a sensor.

    Args:
        mi: the module, set to a variant.
    """
    surfaces = [scene.parameters.surface, *(item.surface for item in scene.parameters.clutter)]
    glassy = any(surface.kind == "glass" for surface in surfaces)
    bounces, sure_bounces = _BOUNCES_IN_GLASS if glassy else _BOUNCES
    out: dict[str, Any] = {
        "type": "scene",
        "integrator": {
            "type": "stokes",
            "nested": {"type": "path", "max_depth": bounces, "rr_depth": sure_bounces},
        },
        "table": _table(mi, scene),
        "light": _surroundings(mi, scene.parameters.light, scene.parameters.wall),
        "object": mesh_shape(mi, scene.model.mesh, scene.model.resting, scene.parameters.surface),
    }
    for number, item in enumerate(scene.parameters.clutter):
        out[f"item_{number}"] = mesh_shape(mi, item.mesh, item.T_table_item, item.surface)
    return out


def sensor_dict(mi: Any, intrinsics: Intrinsics, T_world_cam: SE3, samples: int) -> dict[str, Any]:
    """A pinhole of square pixels: the focal length is that along x.

    Args:
        intrinsics: pixel centres at integer coordinates; Mitsuba has them at halves.
        samples: per pixel.
    """
    K, width, height = intrinsics.K, intrinsics.width, intrinsics.height
    return {
        "type": "perspective",
        "fov_axis": "x",
        "fov": float(np.degrees(2 * np.arctan(0.5 * width / K[0, 0]))),
        "near_clip": 1e-3,
        "principal_point_offset_x": float(0.5 - (K[0, 2] + 0.5) / width),
        "principal_point_offset_y": float(0.5 - (K[1, 2] + 0.5) / height),
        "to_world": mi.ScalarTransform4f(T_world_cam.as_matrix() @ np.diag([-1.0, -1.0, 1.0, 1.0])),
        "film": {
            "type": "hdrfilm",
            "width": width,
            "height": height,
            "rfilter": {"type": "box"},
            "pixel_format": "luminance",
            "component_format": "float32",
        },
        "sampler": {"type": "independent", "sample_count": samples},
    }


def mesh_shape(mi: Any, mesh: Mesh, T_world_mesh: SE3, surface: Surface) -> Any:
    """A mesh with the very normals that the rasterizer interpolates, creases included."""
    corners = np.concatenate([mesh.vertices[mesh.faces.ravel()], mesh.corner_normals.reshape(-1, 3)], axis=1)
    points, faces = np.unique(corners, axis=0, return_inverse=True)
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf(surface))
    shape = mi.Mesh("mesh", len(points), len(mesh.faces), has_vertex_normals=True, props=properties)
    parameters = mi.traverse(shape)
    parameters["vertex_positions"] = _flat(T_world_mesh.apply(points[:, :3].astype(np.float64)))
    parameters["vertex_normals"] = _flat(points[:, 3:] @ T_world_mesh.rotation.T)
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters.update()
    return shape


def bsdf(surface: Surface, reflectance: Any = None) -> dict[str, Any]:
    """A surface as Mitsuba's material.

    Args:
        reflectance: a texture instead of the surface's albedo.
    """
    body = reflectance if reflectance is not None else _uniform(surface.albedo)
    rough = {"distribution": "beckmann", "alpha": max(surface.roughness, _SMOOTHEST)}
    if surface.kind == "matte":
        return {"type": "diffuse", "reflectance": body}
    if surface.kind == "glass":
        return {"type": "dielectric", "int_ior": surface.refractive_index, "ext_ior": 1.0}
    if surface.kind == "metal":
        return {
            "type": "roughconductor",
            "eta": _uniform(surface.refractive_index),
            "k": _uniform(surface.extinction),
            "specular_reflectance": _uniform(surface.gloss),
            **rough,
        }
    return {
        "type": "pplastic",
        "int_ior": surface.refractive_index,
        "ext_ior": 1.0,
        "diffuse_reflectance": body,
        "specular_reflectance": _uniform(surface.gloss),
        **rough,
    }


def _table(mi: Any, scene: Scene) -> Any:
    """A square whose corners carry the texture's scale: a transformation of the texture would become part of
    the kernel, which would then be compiled anew for every scene."""
    parameters = scene.parameters
    texture = {"type": "bitmap", "bitmap": _bitmap(mi, parameters.texture), "wrap_mode": "mirror"}
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf(parameters.table, texture))
    shape = mi.Mesh("table", 4, 2, has_vertex_texcoords=True, props=properties)
    corners = 0.5 * _TABLE_M * np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
    table = mi.traverse(shape)
    table["vertex_positions"] = _flat(np.column_stack([corners, np.zeros(4)]))
    table["vertex_texcoords"] = _flat(corners / parameters.texture_m + 0.5)  # its middle is at the origin
    table["faces"] = np.array([0, 1, 2, 0, 2, 3], np.uint32)
    table.update()
    return shape


def _surroundings(mi: Any, light: Light, wall: Image) -> dict[str, Any]:
    """The light as a panorama, with the wall around the horizon.

    Mitsuba's panorama has its pole along y, and its columns run clockwise seen from there.
    """
    polar = np.pi * np.arange(_PANORAMA_ROWS) / (_PANORAMA_ROWS - 1)
    columns = 2 * _PANORAMA_ROWS
    azimuth = -2 * np.pi * np.arange(columns) / columns
    z, r = np.cos(polar)[:, None], np.sin(polar)[:, None]
    directions = np.stack(
        [r * np.cos(azimuth), r * np.sin(azimuth), np.broadcast_to(z, (_PANORAMA_ROWS, columns))], axis=-1
    )
    radiance = light.radiance(directions)
    foot, top, gone = _WALL_DEG
    elevation = 90 - np.degrees(polar)
    share = np.clip((gone - elevation) / (gone - top), 0, 1) * (elevation > foot)
    around = np.concatenate([wall, wall[:, ::-1]], axis=1)  # mirrored: no seam
    row = np.clip((gone - elevation) / (gone - foot) * (len(wall) - 1), 0, len(wall) - 1).astype(int)
    column = np.arange(columns) * around.shape[1] // columns
    radiance += share[:, None].astype(np.float32) * (around[row][:, column] - radiance)
    to_world = np.array([[0.0, 0, -1, 0], [-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    return {
        "type": "envmap",
        "bitmap": _bitmap(mi, radiance),
        "to_world": mi.ScalarTransform4f(to_world),
    }


def _bitmap(mi: Any, values: Image) -> Any:
    """Grey in three channels: every variant reads those."""
    return mi.Bitmap(np.ascontiguousarray(np.repeat(values[..., None], 3, axis=2), np.float32))


def _uniform(value: float) -> dict[str, Any]:
    return {"type": "uniform", "value": float(value)}


def _flat(points: Array) -> Image:
    return np.ascontiguousarray(points, np.float32).ravel()
