"""Meshes of a BOP data set: PLY files in millimetres, and models_info.json."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dataset.bop.layout import MM, model_file, read_json, write_json
from dataset.meshes import read_mesh
from dataset.session import ObjectRecord

FOLDERS = ("models", "models_eval")
"""The meshes for training, and those that errors are computed with: here the same (our choice)."""


def write_models(root: Path, records: Mapping[int, ObjectRecord]) -> None:
    """Writes meshes and models_info.json of objects by their id."""
    infos = {object_id: _info(record) for object_id, record in sorted(records.items())}
    for folder in FOLDERS:
        (root / folder).mkdir(parents=True, exist_ok=True)
        for object_id, record in records.items():
            _write_ply(model_file(root / folder, object_id), record)
        write_json(root / folder / "models_info.json", infos)


def read_models(root: Path, described: Mapping[str, Any]) -> dict[int, ObjectRecord]:
    """Objects by id, from the meshes in millimetres and models_info.json.

    Args:
        root: of the data set.
        described: name, material, refractive_index and extinction by id, where known; others are named
            `obj_000001` and taken as a plastic of index 1.5 (our choice).

    Raises:
        ToolkitError: a file is missing or malformed.
    """
    records = {}
    for key, info in read_json(root / "models" / "models_info.json").items():
        known = described.get(key, {})
        vertices, faces = read_mesh(model_file(root / "models", int(key)), 1 / MM)
        records[int(key)] = ObjectRecord(
            name=known.get("name", f"obj_{int(key):06d}"),
            vertices=vertices,
            faces=faces,
            material=known.get("material", "plastic"),
            refractive_index=float(known.get("refractive_index", 1.5)),
            extinction=float(known.get("extinction", 0.0)),
            symmetry=json.dumps(_scaled_symmetries(info, 1 / MM)),
            diameter=float(info["diameter"]) / MM,
        )
    return records


def _info(record: ObjectRecord) -> dict[str, Any]:
    low, size = record.vertices.min(axis=0) * MM, np.ptp(record.vertices, axis=0) * MM
    box = {f"min_{axis}": float(value) for axis, value in zip("xyz", low, strict=True)}
    box |= {f"size_{axis}": float(value) for axis, value in zip("xyz", size, strict=True)}
    symmetry = json.loads(record.symmetry) if record.symmetry else {}
    scaled = _scaled_symmetries(symmetry if isinstance(symmetry, dict) else {}, MM)
    return {
        "diameter": record.diameter * MM,
        **box,
        **{name: found for name, found in scaled.items() if found},
    }


def _scaled_symmetries(info: Mapping[str, Any], scale: float) -> dict[str, Any]:
    """The two symmetry entries of models_info.json with their lengths scaled."""
    discrete = np.array(info.get("symmetries_discrete", []), dtype=np.float64).reshape(-1, 4, 4)
    discrete[:, :3, 3] *= scale
    continuous = [
        {"axis": list(found["axis"]), "offset": [scale * value for value in found["offset"]]}
        for found in info.get("symmetries_continuous", [])
    ]
    return {"symmetries_discrete": discrete.reshape(-1, 16).tolist(), "symmetries_continuous": continuous}


def _write_ply(path: Path, record: ObjectRecord) -> None:
    """ASCII, millimetres, with vertex normals (area-weighted means of the faces')."""
    vertices, faces = record.vertices * MM, record.faces
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], across)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    head = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}"]
    head += [f"property double {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    head += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    points = (" ".join(repr(float(value)) for value in row) for row in np.hstack([vertices, normals]))
    triangles = (f"3 {a} {b} {c}" for a, b, c in faces)
    path.write_text("\n".join([*head, *points, *triangles]) + "\n", encoding="ascii")
