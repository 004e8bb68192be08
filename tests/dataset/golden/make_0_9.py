"""How session-0.9.h5 was made from session-1.1.h5: `python make_0_9.py session-1.1.h5 session-0.9.h5`."""

from __future__ import annotations

import sys

import h5py
import numpy as np

from dataset.session import Session

_NEWER = ("clocks/camera_pieces", "clocks/robot_pieces", "segments", "camera/pauses")
_SEALS = ("crc32", "crc32_of", "host_boot_id")


def main(new: str, old: str) -> None:
    with (
        Session.open(new) as session,
        h5py.File(new) as source,
        h5py.File(old, "w", libver=("v110", "v110")) as out,
    ):

        def copy(path: str, node: h5py.Group | h5py.Dataset) -> None:
            if isinstance(node, h5py.Group):
                made = out.require_group(path)
            elif path in _NEWER or path.endswith(
                ("mask_crc32", "camera_time_ns", "bbox_xywh", "T_cam_obj", "T_base_cam")
            ):
                return
            elif node.chunks is None or path.endswith(("raw", "mask")):
                source.copy(node, out, name=path)
                made = out[path]
            else:
                made = out.create_dataset(path, data=node[()])
            made.attrs.update({k: v for k, v in node.attrs.items() if k not in _SEALS})
            for name in _SEALS:
                made.attrs.pop(name, None)

        source.visititems(copy)
        out.attrs.update({k: v for k, v in source.attrs.items() if k not in _SEALS} | {"schema": "0.9"})
        out["camera/camera_time_us"] = session.camera_time_ns / 1e3
        assert session.poses is not None
        for path, poses in (
            ("T_base_cam", session.poses),
            ("objects/tetra/T_cam_obj", session.object_poses("tetra").T_cam_obj),
        ):
            out[f"poses/{path}"] = np.concatenate([poses.translation, poses.as_quaternion()], axis=1)
        boxes = session.object_poses("tetra").bbox_xywh
        out["poses/objects/tetra/bbox_xyxy"] = np.concatenate(
            [boxes[:, :2], boxes[:, :2] + boxes[:, 2:]], axis=1
        )


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
