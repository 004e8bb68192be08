"""Unwrapped frame ids: they continue over the wrap and keep every gap."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquisition.cameras.frame_ids import FrameIds


def unwrap(block_ids: list[int]) -> list[int]:
    ids = FrameIds()
    return [ids.unwrap(block_id) for block_id in block_ids]


@pytest.mark.parametrize(
    ("block_ids", "expected"),
    [
        ([65534, 65535, 1, 2], [65534, 65535, 65536, 65537]),
        ([65535, 3], [65535, 65538]),
        ([7], [7]),
        ([10, 12, 11, 13], [10, 12, 11, 13]),
        ([1, 65535], [1, 0]),
        ([65534, 65535, 65536, 65537, 65538], [65534, 65535, 65536, 65537, 65538]),
        ([100_000, 100_002], [100_000, 100_002]),
    ],
    ids=["wrap", "gap over the wrap", "single", "late frame", "late over the wrap", "64 bits", "64-bit gap"],
)
def test_known_sequences(block_ids: list[int], expected: list[int]) -> None:
    assert unwrap(block_ids) == expected


@given(st.integers(1, 65535), st.lists(st.integers(1, 32766), max_size=50))
def test_differences_survive_any_number_of_wraps(first: int, gaps: list[int]) -> None:
    true_ids = [first]
    for gap in gaps:
        true_ids.append(true_ids[-1] + gap)
    block_ids = [(true_id - 1) % 65535 + 1 for true_id in true_ids]
    assert unwrap(block_ids) == true_ids


def test_ids_go_on_when_the_camera_counts_anew() -> None:
    ids = FrameIds()
    assert [ids.unwrap(block_id) for block_id in (65534, 65535, 1)] == [65534, 65535, 65536]
    ids.resume()
    assert [ids.unwrap(block_id) for block_id in (65401, 65402, 65404)] == [65537, 65538, 65540]


def test_resuming_before_the_first_frame_changes_nothing() -> None:
    ids = FrameIds()
    ids.resume()
    assert ids.unwrap(7) == 7
