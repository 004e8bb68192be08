"""Sets: the same frames from whoever renders them, after whatever interruption, and again years later."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dataset import Intrinsics, ToolkitError
from dataset.session import Session, write_split
from s2p3 import objects
from s2p3.synthesis import (
    SYNTHETIC,
    Analytic,
    Domain,
    PathTraced,
    Views,
    ViewsLike,
    render_again,
    synthesize,
)

TINY = Intrinsics(np.array([[60.0, 0, 39.0], [0, 60.0, 31.5], [0, 0, 1]]), np.zeros(0), 64, 80)
CUP = objects.build("cup")
NEAR = replace(SYNTHETIC, views=Views(distance_m=(0.2, 0.3)))


def _raws(path: Path) -> np.ndarray:
    with Session.open(path) as session:
        return np.stack([session.raw(i) for i in range(len(session))])


def test_a_path_traced_set_is_a_session_each_frame_of_which_can_be_rendered_again(tmp_path: Path) -> None:
    path = tmp_path / "set.h5"
    backend = PathTraced(PathTraced.here().engine, 16)
    synthesize(CUP, 2, TINY, 3, path, workers=2, domain=NEAR, backend=backend)
    raws = _raws(path)
    for index in (1, 0):
        image, raw = render_again(path, index)
        np.testing.assert_array_equal(raw, raws[index])
        with Session.open(path) as session:
            np.testing.assert_array_equal(session.object_poses("cup").mask(index), image.mask)
    manifest = json.loads((tmp_path / "set.manifest.json").read_text())
    assert manifest["request"]["backend"]["samples"] == 16
    assert manifest["frames"][1]["scene"]["surface"]["kind"] == "plastic"
    assert 0 < manifest["frames"][1]["visible_fraction"] <= 1


def test_a_frame_that_would_come_out_otherwise_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "set.h5"
    synthesize(CUP, 1, TINY, 3, path, domain=NEAR)
    with pytest.raises(ToolkitError, match="frames 0 to 0, not 1"):
        render_again(path, 1)
    manifest = tmp_path / "set.manifest.json"
    good = json.loads(manifest.read_text())
    manifest.write_text(json.dumps(good | {"request": good["request"] | {"toolkit": "0.0.1"}}))
    with pytest.raises(ToolkitError, match=r"0\.0\.1.*install those versions"):
        render_again(path, 0)
    good["frames"][0]["sha256"] = "0" * 64
    manifest.write_text(json.dumps(good))
    with pytest.raises(ToolkitError, match="draws another scene"):
        render_again(path, 0)
    manifest.write_text("{")
    with pytest.raises(ToolkitError, match="cannot be read"):
        render_again(path, 0)
    manifest.unlink()
    with pytest.raises(ToolkitError, match="belong together"):
        render_again(path, 0)


def test_a_ray_cluster_of_two_nodes_renders_the_same_set(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each node has one CPU, and each of the two actors wants one: both nodes render."""
    from ray.cluster_utils import Cluster  # takes seconds to import

    synthesize(CUP, 5, TINY, 4, tmp_path / "local.h5", domain=NEAR)
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    try:
        cluster.add_node(num_cpus=1)
        monkeypatch.setenv("RAY_ADDRESS", cluster.address)
        synthesize(CUP, 5, TINY, 4, tmp_path / "ray.h5", workers=2, domain=NEAR, executor="ray")
    finally:
        cluster.shutdown()
    np.testing.assert_array_equal(_raws(tmp_path / "local.h5"), _raws(tmp_path / "ray.h5"))


def test_a_mistake_in_a_ray_worker_is_told_in_one_line(tmp_path: Path) -> None:
    far = replace(SYNTHETIC, views=Views(distance_m=(40.0, 50.0)))
    with pytest.raises(ToolkitError, match="hardly visible") as caught:
        synthesize(CUP, 1, TINY, 0, tmp_path / "far.h5", domain=far, executor="ray")
    assert "\n" not in str(caught.value)


_COMMAND = """
from pathlib import Path
import numpy as np
from dataset import Intrinsics
from s2p3 import objects
from s2p3.synthesis import synthesize
camera = Intrinsics(np.array([[240.0, 0, 159.0], [0, 240, 127.5], [0, 0, 1]]), np.zeros(0), 256, 320)
if __name__ == "__main__":
    synthesize(objects.build("cup"), 12, camera, 5, Path({out!r}), workers=2)
"""


def test_a_set_whose_process_was_killed_goes_on_and_comes_out_the_same(tmp_path: Path) -> None:
    out = tmp_path / "killed.h5"
    script = tmp_path / "run.py"
    script.write_text(_COMMAND.format(out=str(out)))
    process = subprocess.Popen([sys.executable, str(script)], start_new_session=True)
    parts = tmp_path / "killed.h5.parts"
    deadline = time.monotonic() + 120
    while len(list(parts.glob("*.npz"))) < 2 and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.005)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    kept = {path.name: path.stat().st_mtime_ns for path in parts.glob("*.npz")}
    assert 2 <= len(kept) < 12
    assert not out.exists()
    camera = Intrinsics(np.array([[240.0, 0, 159.0], [0, 240, 127.5], [0, 0, 1]]), np.zeros(0), 256, 320)
    done: list[int] = []
    synthesize(CUP, 12, camera, 5, out, on_progress=lambda count, _: done.append(count))
    assert done == list(range(len(kept) + 1, 13))
    synthesize(CUP, 12, camera, 5, tmp_path / "whole.h5")
    np.testing.assert_array_equal(_raws(out), _raws(tmp_path / "whole.h5"))


def _interrupted(out: Path, count: int, seed: int) -> Path:
    """The parts of a set that was stopped after two frames."""

    def stop(done: int, _: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        synthesize(CUP, count, TINY, seed, out, domain=NEAR, on_progress=stop)
    return out.with_name(out.name + ".parts")


def test_a_set_goes_on_only_as_it_began(tmp_path: Path) -> None:
    out = tmp_path / "set.h5"
    parts = _interrupted(out, 3, 1)
    with pytest.raises(ToolkitError, match="2 frames of a set that was begun with another domain and seed"):
        synthesize(CUP, 3, TINY, 2, out)
    with pytest.raises(ToolkitError, match="another backend"):
        synthesize(CUP, 3, TINY, 1, out, domain=NEAR, backend=PathTraced(PathTraced.here().engine, 16))
    assert len(list(parts.glob("*.npz"))) == 2
    synthesize(CUP, 3, TINY, 1, out, domain=NEAR)
    synthesize(CUP, 3, TINY, 1, tmp_path / "whole.h5", domain=NEAR)
    np.testing.assert_array_equal(_raws(out), _raws(tmp_path / "whole.h5"))
    assert not parts.exists()


def test_a_frame_without_its_end_is_rendered_again(tmp_path: Path) -> None:
    out = tmp_path / "set.h5"
    parts = _interrupted(out, 3, 1)
    whole = (parts / "000000.npz").read_bytes()
    (parts / "000000.npz").write_bytes(whole[: len(whole) // 2])
    (parts / "000001.npz").write_bytes(b"")
    done: list[int] = []
    synthesize(CUP, 3, TINY, 1, out, domain=NEAR, on_progress=lambda count, _: done.append(count))
    assert done == [1, 2, 3]


def test_two_processes_do_not_render_the_same_set(tmp_path: Path) -> None:
    out = tmp_path / "set.h5"

    def again(done: int, _: int) -> None:
        with pytest.raises(ToolkitError, match="another process renders this set"):
            synthesize(CUP, 2, TINY, 1, out, domain=NEAR)

    synthesize(CUP, 2, TINY, 1, out, domain=NEAR, on_progress=again)
    assert len(_raws(out)) == 2


def test_a_name_that_no_session_takes_is_refused_before_anything_is_rendered(tmp_path: Path) -> None:
    with pytest.raises(ToolkitError, match="may hold only letters"):
        synthesize(replace(CUP, name="a/b"), 1, TINY, 1, tmp_path / "set.h5")
    assert not list(tmp_path.iterdir())


def test_sets_whose_names_differ_by_what_looks_like_a_suffix_keep_their_own_manifests(tmp_path: Path) -> None:
    for seed in (1, 2):
        synthesize(CUP, 1, TINY, seed, tmp_path / f"cup.v{seed}", domain=NEAR)
    for seed in (1, 2):
        path = tmp_path / f"cup.v{seed}"
        np.testing.assert_array_equal(render_again(path, 0)[1], _raws(path)[0])


def test_a_worker_that_is_ended_is_told_in_one_line(tmp_path: Path) -> None:
    def end_a_worker(done: int, count: int) -> None:
        for pid in Path("/proc").glob("[0-9]*"):
            try:
                words = (pid / "stat").read_text().rsplit(") ", 1)[1].split()
                command = (pid / "cmdline").read_text()
            except OSError:
                continue
            if int(words[1]) == os.getpid() and "spawn_main" in command:
                os.kill(int(pid.name), signal.SIGKILL)

    with pytest.raises(ToolkitError, match="ended from outside"):
        synthesize(CUP, 40, TINY, 6, tmp_path / "set.h5", workers=2, on_progress=end_a_worker)
    assert list((tmp_path / "set.h5.parts").glob("*.npz"))


def test_views_like_a_sessions_are_distributed_as_its_are(tmp_path: Path) -> None:
    low = Views(distance_m=(0.5, 0.6), elevation_deg=(20.0, 30.0), roll_deg=(-5.0, 5.0), offset=0.2)
    synthesize(CUP, 40, TINY, 1, tmp_path / "seen.h5", domain=replace(SYNTHETIC, views=low))
    like = ViewsLike.of(tmp_path / "seen.h5", "cup")
    rng = np.random.default_rng(0)
    elevations, distances = [], []
    for _ in range(200):
        pose = like.draw(CUP, TINY, rng)
        eye = pose.inverse().translation
        distances.append(np.linalg.norm(eye))
        elevations.append(np.degrees(np.arcsin(eye[2] / distances[-1])))
        assert (TINY.project(pose.translation) >= 0).all()
    assert np.mean(elevations) == pytest.approx(25, abs=2.5)
    assert np.std(elevations) < 8
    assert np.mean(distances) == pytest.approx(0.55, abs=0.02)
    domain = Domain(views=like)
    synthesize(CUP, 1, TINY, 1, tmp_path / "like.h5", domain=domain)
    np.testing.assert_array_equal(render_again(tmp_path / "like.h5", 0)[1], _raws(tmp_path / "like.h5")[0])
    with pytest.raises(ToolkitError):
        ViewsLike.of(tmp_path / "seen.h5", "fork")
    write_split(tmp_path / "seen.h5", "train", [3, 5])
    assert ViewsLike.of(tmp_path / "seen.h5", "cup").poses == (like.poses[3], like.poses[5])


def test_analytic_is_what_a_set_is_rendered_with_unless_told(tmp_path: Path) -> None:
    synthesize(CUP, 1, TINY, 2, tmp_path / "one.h5", domain=NEAR)
    synthesize(CUP, 1, TINY, 2, tmp_path / "two.h5", domain=NEAR, backend=Analytic())
    np.testing.assert_array_equal(_raws(tmp_path / "one.h5"), _raws(tmp_path / "two.h5"))
