"""Clocks fitted to simulated captures, in virtual time: known offset and drift, one-sided lateness."""

import numpy as np
import pytest
from numpy.typing import NDArray

from dataset.clocks import DeviceClock, fit_clock
from dataset.errors import ToolkitError

HOST_EPOCH_NS = 3_300_000_000_000_000
Times = NDArray[np.int64]


def capture(
    seconds: float,
    rate_hz: float,
    drift_ppm: float,
    jitter_s: float,
    late_fraction: float = 0.0,
    *,
    warming_ppm: float = 0.0,
    busy: tuple[float, float, float] = (0.0, 0.0, 0.0),
    epoch_ns: int = 7_000_000_000,
    seed: int = 7,
) -> tuple[Times, Times, Times]:
    """Device times, arrival times, and when the samples truly were taken on the host's clock.

    `warming_ppm`: by how much the rate changes while the device warms up, in about ten minutes; `busy`: from,
    to (s), and by how much everything is late meanwhile (s).
    """
    rng = np.random.default_rng(seed)
    elapsed = (np.arange(int(seconds * rate_hz)) * (1e9 / rate_hz)).astype(np.int64)
    t = elapsed * 1e-9
    drift_us = drift_ppm * t + warming_ppm * (t - 600.0 * (1.0 - np.exp(-t / 600.0)))
    true = HOST_EPOCH_NS + elapsed + np.rint(1e3 * drift_us).astype(np.int64)
    late_s = rng.exponential(jitter_s, len(elapsed))
    late_s += (rng.random(len(elapsed)) < late_fraction) * rng.uniform(0, 0.06, len(elapsed))
    late_s[(t >= busy[0]) & (t < busy[1])] += busy[2]
    # A stream arrives in order: what follows a late sample is late as well.
    host = np.maximum.accumulate(true + (1e9 * late_s).astype(np.int64))
    return epoch_ns + elapsed, host, true


def errors(clock: DeviceClock, device: Times, true: Times) -> tuple[float, float]:
    """The largest error, milliseconds, and the largest in units of its own sigma."""
    error = np.abs(clock.to_host(device) - true)
    return float(error.max()) * 1e-6, float((error / clock.sigmas_ns(len(device))).max())


@pytest.mark.parametrize(
    ("seconds", "rate_hz", "drift_ppm", "jitter_s", "late", "largest_ms"),
    [
        (60, 22, 80, 0.5e-3, 0.0, 0.05),
        (60, 500, -80, 0.5e-3, 0.02, 0.02),
        (5, 22, 80, 0.5e-3, 0.0, 0.15),
        (5, 125, 50, 0.5e-3, 0.05, 0.05),
        (3600, 5, 30, 1e-3, 0.1, 0.1),
        (90, 0.4, 50, 1e-3, 0.0, 0.8),  # single pictures
        (60, 22, 80, 0.5e-3, 0.3, 0.05),
        (14, 3, 50, 0.3e-3, 0.6, 0.5),  # a busy host: most frames are late
        (60, 22, 80, 0.5e-3, 0.9, 0.2),
    ],
)
@pytest.mark.parametrize("seed", [7, 8, 9])
def test_recovers_offset_and_drift(
    seconds: float,
    rate_hz: float,
    drift_ppm: float,
    jitter_s: float,
    late: float,
    largest_ms: float,
    seed: int,
) -> None:
    device, host, true = capture(seconds, rate_hz, drift_ppm, jitter_s, late, seed=seed)
    clock = fit_clock(device, host)
    error_ms, in_sigmas = errors(clock, device, true)
    assert error_ms < largest_ms
    assert in_sigmas < 3.0
    assert clock.fits[0].b == pytest.approx(1 + 1e-6 * drift_ppm, abs=60e-6)
    assert clock.restarts == ()


@pytest.mark.parametrize(("drift_ppm", "warming_ppm"), [(100.0, 0.0), (80.0, 3.0), (-80.0, -8.0)])
def test_drift_over_an_hour_is_followed_not_averaged(drift_ppm: float, warming_ppm: float) -> None:
    device, host, true = capture(3600, 22, drift_ppm, 0.5e-3, 0.05, warming_ppm=warming_ppm)
    clock = fit_clock(device, host)
    error_ms, in_sigmas = errors(clock, device, true)
    assert error_ms < 0.15  # one minimum alone would be off by 360 ms at the other end
    assert in_sigmas < 3.0
    if warming_ppm:  # and one line by what it bends
        elapsed, ahead = 1e-9 * (device - device[0]), true - device - (true[0] - device[0])
        bend = ahead - np.polyval(np.polyfit(elapsed, ahead, 1), elapsed)
        assert np.abs(bend).max() > 400_000


@pytest.mark.parametrize(
    "busy",
    [
        (200.0, 260.0, 0.010),  # a minute in ten
        (0.0, 60.0, 0.002),  # at the beginning, where a tilted line explains it as well
        (540.0, 600.0, 0.005),  # at the end
        (100.0, 500.0, 0.003),  # most of the time
    ],
)
@pytest.mark.parametrize("seconds", [120.0, 600.0])
def test_a_busy_host_does_not_bias_in_silence(seconds: float, busy: tuple[float, float, float]) -> None:
    scaled = (busy[0] * seconds / 600, busy[1] * seconds / 600, busy[2])
    device, host, true = capture(seconds, 22, 80, 0.5e-3, 0.05, busy=scaled)
    assert errors(fit_clock(device, host), device, true)[1] < 3.0


def test_a_restart_begins_a_new_piece() -> None:
    device, host, true = capture(40, 22, 50, 0.5e-3)
    device[500:] -= device[500] - 1_000_000  # the device's clock begins at 1 ms again
    clock = fit_clock(device, host)
    assert (clock.first, clock.restarts) == ((0, 500), (500,))
    assert errors(clock, device, true)[0] < 0.1


@pytest.mark.parametrize("jump_s", [0.3, 10.0, 1e6])
def test_a_clock_set_forward_begins_a_new_piece(jump_s: float) -> None:
    device, host, true = capture(40, 22, 50, 0.5e-3)
    device[300:] += int(1e9 * jump_s)
    clock = fit_clock(device, host)
    assert (clock.first, clock.restarts) == ((0, 300), (300,))
    assert errors(clock, device, true)[0] < 0.1


def test_a_known_start_is_no_surprise() -> None:
    device, host, true = capture(40, 22, 50, 0.5e-3)
    device[500:] -= device[500]
    clock = fit_clock(device, host, starts=(0, 500))
    assert (clock.first, clock.restarts) == ((0, 500), ())
    assert errors(clock, device, true)[0] < 0.1


def test_a_stall_that_lost_frames_is_no_jump() -> None:
    device, host, _ = capture(40, 22, 50, 0.5e-3)
    host[400] += 1_500_000_000  # the host stood still: one frame was stamped late, those behind it were lost
    keep = np.r_[0:401, 434 : len(device)]
    clock = fit_clock(device[keep], np.maximum.accumulate(host[keep]))
    assert (clock.first, clock.restarts) == ((0,), ())


def test_a_handful_of_arrivals_is_as_good_as_the_worst_of_them() -> None:
    device, host, true = capture(2, 2, 50, 3e-3)
    clock = fit_clock(device, host)
    assert len(device) == 4
    assert clock.fits[0].b == 1.0
    assert clock.sigma_ns >= 5e6
    assert errors(clock, device, true)[1] < 3.0


def test_epoch_nanoseconds_keep_their_precision() -> None:
    device, host, true = capture(20, 100, 20, 0.1e-3, epoch_ns=1_700_000_000_000_000_000)
    assert np.abs(fit_clock(device, host).to_host(device) - true).max() < 100_000


def test_exact_times_are_reproduced() -> None:
    device, _, true = capture(10, 50, 0, 0.1e-3)
    fit = fit_clock(device, true)
    assert np.abs(fit.to_host(device) - true).max() <= 2
    assert fit.sigma_ns <= 2


def test_sigma_grows_with_the_jitter() -> None:
    calm = fit_clock(*capture(30, 22, 10, 0.2e-3)[:2])
    rough = fit_clock(*capture(30, 22, 10, 5e-3)[:2])
    assert rough.sigma_ns > 5 * calm.sigma_ns


def test_no_sample() -> None:
    with pytest.raises(ToolkitError, match="record at least one"):
        fit_clock([], [])


def test_host_time_that_goes_back_is_named() -> None:
    device, host = np.arange(20) * 10**7, np.arange(20) * 10**7
    host[12] -= 5 * 10**7
    with pytest.raises(ToolkitError, match=r"host time goes from .* at sample 12"):
        fit_clock(device, host)


def test_packets_that_are_read_together_share_their_arrival() -> None:
    device = np.arange(20) * 10**7
    assert len(fit_clock(device, (np.arange(20) // 2) * 2 * 10**7).first) == 1


def test_wrong_unit_is_noticed() -> None:
    device, host, _ = capture(10, 50, 0, 0.1e-3)
    with pytest.raises(ToolkitError, match="not in nanoseconds"):
        fit_clock((device - device[0]) // 1000, host)


@pytest.mark.parametrize("seed", [22, 189, 527, 679, 738, 812, 829, 841])
def test_a_short_capture_in_bursts_on_a_busy_host_is_fitted(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count, rate_hz = int(rng.integers(5, 300)), float(rng.choice([10, 100, 500]))
    device = (np.arange(count) * 1e9 / rate_hz).astype(np.int64) + 10**12
    late_ns = rng.exponential(10 ** rng.uniform(3, 7.5), count).astype(np.int64)
    host = np.maximum.accumulate(HOST_EPOCH_NS + device + late_ns)
    burst = int(rng.integers(1, 60))  # packets that are read together share their arrival
    host = host[np.minimum((np.arange(count) // burst + 1) * burst - 1, count - 1)]
    fit = fit_clock(device, host)
    assert abs(fit.fits[0].b - 1) < 1e-2
    lateness = host - fit.to_host(device)
    assert -1e6 < np.median(lateness) < 1e9


@pytest.mark.parametrize("stall_s", [0.06, 0.5])
def test_a_moment_recorded_by_a_host_that_stood_still_has_a_clock_in_doubt(stall_s: float) -> None:
    """What a recorder that was killed at once leaves behind: 8 frames in 20 ms, the last of them late."""
    device = 5 * 10**9 + np.arange(8) * 2_500_000
    host = HOST_EPOCH_NS + device + np.where(np.arange(8) < 6, 0, round(stall_s * 1e9))
    (fit,) = fit_clock(device, host).fits
    assert fit.b == 1.0
    assert np.abs(fit.to_host(device) - host).max() <= fit.sigma_ns
    assert fit.sigma_ns == pytest.approx(stall_s * 1e9)


@pytest.mark.parametrize("pause_s", [260.0, 300.0, 900.0, 3600.0])
@pytest.mark.parametrize("filmed_s", [10.0, 250.0])
def test_a_pause_in_which_nothing_arrives_is_bridged(filmed_s: float, pause_s: float) -> None:
    device, host, true = capture(2 * filmed_s + pause_s, 5, 12, 0.5e-3)
    elapsed = (device - device[0]) * 1e-9
    filmed = (elapsed < filmed_s) | (elapsed > filmed_s + pause_s)
    clock = fit_clock(device[filmed], host[filmed])
    worst_ms, in_sigmas = errors(clock, device[filmed], true[filmed])
    assert worst_ms < 1.0
    assert in_sigmas < 4.0
    assert list(clock.first) == sorted(set(clock.first))
