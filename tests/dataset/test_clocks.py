"""Clock fits on simulated captures: known offset and drift, one-sided lateness."""

import numpy as np
import pytest

from dataset.clocks import fit_clock
from dataset.errors import ToolkitError

HOST_EPOCH_NS = 3_300_000_000_000_000


def capture(
    seconds: float,
    rate_hz: float,
    drift_ppm: float,
    jitter_s: float,
    late_fraction: float = 0.0,
    epoch_ns: int = 7_000_000_000,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Device times, arrival times, and when the samples truly were taken on the host's clock."""
    rng = np.random.default_rng(7)
    elapsed = (np.arange(int(seconds * rate_hz)) * (1e9 / rate_hz)).astype(np.int64)
    true = HOST_EPOCH_NS + np.rint(elapsed * (1 + 1e-6 * drift_ppm)).astype(np.int64)
    late_s = rng.exponential(jitter_s, len(elapsed))
    late_s += (rng.random(len(elapsed)) < late_fraction) * rng.uniform(0, 0.06, len(elapsed))
    # A stream arrives in order: what follows a late sample is late as well.
    host = np.maximum.accumulate(true + (1e9 * late_s).astype(np.int64))
    return epoch_ns + elapsed, host, true


@pytest.mark.parametrize(
    ("seconds", "rate_hz", "drift_ppm", "jitter_s", "late", "largest_ms"),
    [
        (60, 22, 80, 0.5e-3, 0.0, 0.15),
        (60, 500, -80, 0.5e-3, 0.02, 0.05),
        (5, 22, 80, 0.5e-3, 0.0, 0.25),
        (5, 125, 50, 0.5e-3, 0.05, 0.15),
        (3600, 5, 30, 1e-3, 0.1, 0.3),
        (90, 0.4, 50, 1e-3, 0.0, 1.5),  # single pictures
        (60, 22, 80, 0.5e-3, 0.3, 0.5),
        (14, 3, 50, 0.3e-3, 0.6, 0.5),  # a busy host: most frames are late
    ],
)
def test_recovers_offset_and_drift(
    seconds: float, rate_hz: float, drift_ppm: float, jitter_s: float, late: float, largest_ms: float
) -> None:
    device, host, true = capture(seconds, rate_hz, drift_ppm, jitter_s, late)
    fit = fit_clock(device, host)
    error_ms = 1e-6 * (fit.to_host(device) - true)
    assert np.abs(error_ms).max() < largest_ms
    assert np.abs(error_ms).max() < 8e-6 * fit.sigma_ns + 0.02
    assert fit.b == pytest.approx(1 + 1e-6 * drift_ppm, abs=60e-6)


def test_drift_over_an_hour_is_followed_not_averaged() -> None:
    device, host, true = capture(3600, 22, 100, 0.5e-3)
    error_ns = np.abs(fit_clock(device, host).to_host(device) - true)
    assert error_ns.max() < 100_000  # one minimum alone would be off by 360 ms at the other end


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


def test_too_few_samples() -> None:
    with pytest.raises(ToolkitError, match="4 samples"):
        fit_clock([0, 1, 2, 3], [0, 1, 2, 3])


@pytest.mark.parametrize(("which", "name"), [(0, "device"), (1, "host")])
def test_time_that_goes_back_is_named(which: int, name: str) -> None:
    times = [np.arange(20) * 10**7, np.arange(20) * 10**7]
    times[which][12] -= 5 * 10**7
    with pytest.raises(ToolkitError, match=f"{name} time goes from .* at sample 12"):
        fit_clock(*times)


def test_repeated_device_time_is_refused_but_shared_arrivals_are_not() -> None:
    device = np.arange(20) * 10**7
    fit_clock(device, (np.arange(20) // 2) * 2 * 10**7)
    device[5] = device[4]
    with pytest.raises(ToolkitError, match="sample 5"):
        fit_clock(device, np.arange(20) * 10**7)


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
    assert abs(fit.b - 1) < 1e-2
    lateness = host - fit.to_host(device)
    assert -1e6 < np.median(lateness) < 1e9
