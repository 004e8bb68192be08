"""Rests of a hand-guided arm: found once each, wherever the trace is cut, and nowhere else."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from dataset.frames import RobotTrace
from dataset.rests import RestFinder, find_rests
from dataset.transforms import SE3, rotation_error_deg

RATE_HZ = 100


def trace_of(pose: NDArray[np.float64]) -> RobotTrace:
    count = len(pose)
    seconds = np.arange(count) / RATE_HZ
    return RobotTrace(
        host_time_ns=(5_000_000_000 + 1e9 * seconds).astype(np.int64),
        robot_time_s=100.0 + seconds,
        q=np.zeros((count, 6)),
        pose=pose,
        safety_bits=np.ones(count, np.uint32),
    )


def part_of(trace: RobotTrace, begin: int, end: int) -> RobotTrace:
    columns = ("host_time_ns", "robot_time_s", "q", "pose", "safety_bits")
    return RobotTrace(*(getattr(trace, name)[begin:end] for name in columns))


def guided(stops: NDArray[np.float64], still_s: float, seed: int = 0) -> RobotTrace:
    """From a start through each stop (n, 6): half a second of motion, then still, with an encoder's noise."""
    start = np.array([0.4, 0.0, 0.5, 0.0, 3.0, 0.0])
    corners = np.vstack([start, stops])
    parts = [np.repeat(start[None], RATE_HZ, axis=0)]  # the arm also waits before it is guided
    for begin, end in itertools.pairwise(corners):
        way = np.linspace(0, 1, RATE_HZ // 2)[:, None]
        parts += [begin + way * (end - begin), np.repeat(end[None], int(still_s * RATE_HZ), axis=0)]
    pose = np.concatenate(parts)
    return trace_of(pose + 1e-5 * np.random.default_rng(seed).standard_normal(pose.shape))


STOPS = np.array(
    [
        [0.45, 0.1, 0.3, 0.0, 3.0, 0.1],
        [0.45, 0.11, 0.3, 0.0, 3.0, 0.1],
        [0.45, 0.11, 0.3, 0.0, 2.8, 0.1],  # turned in place
    ]
)


def test_each_stop_is_one_rest_at_its_pose() -> None:
    rests = find_rests(guided(STOPS, still_s=1.5))
    assert len(rests) == len(STOPS)
    for rest, stop in zip(rests, STOPS, strict=True):
        np.testing.assert_allclose(rest.T_base_tcp.translation, stop[:3], atol=2e-5)
        assert rotation_error_deg(rest.T_base_tcp, SE3.from_pose6(stop)) < 0.01


def test_a_rest_names_its_samples_and_their_middle() -> None:
    trace = guided(STOPS, still_s=1.5)
    for rest in find_rests(trace):
        times = trace.host_time_ns[rest.begin : rest.end]
        assert rest.host_time_ns == (times[0] + times[-1]) // 2
        assert np.ptp(trace.robot_time_s[rest.begin : rest.end]) >= 0.6
        assert np.ptp(trace.pose[rest.begin : rest.end, :3], axis=0).max() < 1e-3


def test_a_short_stop_is_none() -> None:
    assert find_rests(guided(STOPS, still_s=0.4)) == []


def test_staying_where_the_arm_began_is_none() -> None:
    assert find_rests(trace_of(np.tile([0.4, 0.0, 0.5, 0.0, 3.0, 0.0], (500, 1)))) == []


def test_coming_back_to_the_same_point_is_not_a_second_one() -> None:
    lifted = STOPS[0] + [0, 0, 0.05, 0, 0, 0]
    path = guided(np.array([STOPS[0], lifted, STOPS[0]]), still_s=0.3)
    brief = find_rests(path)
    assert brief == []
    trembling = STOPS[0] + [1e-3, 0, 0, 0, 0, 0]  # strays, and rests within 3 mm of the rest before
    assert len(find_rests(guided(np.array([STOPS[0], trembling]), still_s=1.0))) == 1


def test_slow_motion_is_none() -> None:
    pose = np.tile([0.4, 0.0, 0.5, 0.0, 3.0, 0.0], (600, 1))
    pose[:, 0] += np.arange(600) / RATE_HZ * 2e-3  # 2 mm/s
    assert find_rests(trace_of(pose)) == []


@settings(max_examples=20, deadline=None)
@given(cuts=st.lists(st.integers(0, 700), max_size=6), seed=st.integers(0, 5))
def test_where_the_trace_is_cut_does_not_matter(cuts: list[int], seed: int) -> None:
    trace = guided(STOPS, still_s=1.5, seed=seed)
    finder = RestFinder()
    edges = [0, *sorted(cuts), len(trace)]
    pieces = [
        rest for begin, end in itertools.pairwise(edges) for rest in finder.feed(part_of(trace, begin, end))
    ]
    whole = find_rests(trace)
    assert [(r.begin, r.end, r.host_time_ns) for r in pieces] == [
        (r.begin, r.end, r.host_time_ns) for r in whole
    ]


@pytest.mark.parametrize("count", [0, 1])
def test_no_trace_has_no_rests(count: int) -> None:
    assert find_rests(part_of(guided(STOPS, still_s=1.0), 0, count)) == []
