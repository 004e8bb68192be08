"""When an arm that is guided by hand was held still: the touches of a tool-tip recording.

A touch is read off the trace of poses alone, so a recording and whoever reads it later find the same ones.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dataset.frames import RobotTrace
from dataset.transforms import SE3


@dataclass(frozen=True)
class Rest:
    """A moment in which the arm was held still.

    Attributes:
        begin, end: sample indices of the trace, counted from the first that was given, `end` excluded.
        host_time_ns: middle, host monotonic clock.
        T_base_tcp: mean pose.
    """

    begin: int
    end: int
    host_time_ns: int
    T_base_tcp: SE3


class RestFinder:
    """Finds rests in a trace that is handed over piece by piece.

    A rest is taken `still_s` after the arm came to within the tolerances of where it then stayed, once, and
    only at `apart_m` or `apart_rad` at least from the rest before (for the first: from the first sample). The
    defaults are our choice.

    Args:
        still_s: seconds of stillness.
        tolerance_m, tolerance_rad: how far the tool may stray meanwhile.
        apart_m, apart_rad: how far two rests lie apart at least, in one of the two.
    """

    def __init__(
        self,
        still_s: float = 0.6,
        tolerance_m: float = 3e-4,
        tolerance_rad: float = 2e-3,
        apart_m: float = 3e-3,
        apart_rad: float = 0.05,
    ) -> None:
        self._still_s = still_s
        self._tolerance = (tolerance_m, tolerance_rad)
        self._apart = (apart_m, apart_rad)
        self._anchor: _Sample | None = None
        self._last: _Sample | None = None
        self._since: list[_Sample] = []
        self._count = 0

    def feed(self, trace: RobotTrace) -> list[Rest]:
        """The rests that these next samples complete, oldest first."""
        return list(self._feed(trace))

    def _feed(self, trace: RobotTrace) -> Iterator[Rest]:
        rotations = trace.poses.rotation
        for i in range(len(trace)):
            sample = _Sample(
                self._count,
                int(trace.host_time_ns[i]),
                float(trace.robot_time_s[i]),
                trace.pose[i],
                rotations[i],
            )
            self._count += 1
            if self._anchor is None:
                self._anchor = self._last = sample
            if sample.strays(self._anchor, *self._tolerance):
                self._anchor, self._since = sample, []
            self._since.append(sample)
            rest = self._complete(sample)
            if rest is not None:
                yield rest

    def _complete(self, sample: _Sample) -> Rest | None:
        """The rest that ends with this sample, where it is long enough and elsewhere than the last."""
        assert self._anchor is not None
        assert self._last is not None
        if sample.time_s - self._anchor.time_s < self._still_s:
            return None
        if not self._anchor.strays(self._last, *self._apart):
            self._since = self._since[-1:]  # nothing will come of this stillness
            return None
        samples, self._since, self._last = self._since, [], sample
        return Rest(
            begin=samples[0].index,
            end=samples[-1].index + 1,
            host_time_ns=(samples[0].host_time_ns + samples[-1].host_time_ns) // 2,
            T_base_tcp=_mean(np.stack([s.pose for s in samples])),
        )


def find_rests(trace: RobotTrace) -> list[Rest]:
    """The rests of a whole trace, with the tolerances of `RestFinder`."""
    return RestFinder().feed(trace)


@dataclass(frozen=True, eq=False)
class _Sample:
    index: int
    host_time_ns: int
    time_s: float
    pose: NDArray[np.float64]
    rotation: NDArray[np.float64]

    def strays(self, other: _Sample, limit_m: float, limit_rad: float) -> bool:
        """Whether the two poses differ by more than one of the limits."""
        if np.abs(self.pose[:3] - other.pose[:3]).max() > limit_m:
            return True
        cosine = (np.vdot(self.rotation, other.rotation) - 1) / 2
        return bool(cosine < np.cos(limit_rad))


def _mean(poses: NDArray[np.float64]) -> SE3:
    """The mean of poses (n, 6) that lie close together."""
    batch = SE3.from_pose6(poses)
    first = batch[0]
    return first @ SE3.exp((first.inverse() @ batch).log().mean(axis=0))
