"""Whether the images in a session are those that were stored: mosaics, depth and masks."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from dataset.compression import checksum
from dataset.schema import checksums_of
from dataset.session.files import READ_ERRORS
from dataset.validate.problems import Problem, View


def intact_images(view: View, path: str, hint: str, problems: list[Problem]) -> Iterator[tuple[int, Any]]:
    """(index, image) of those that decompress to the pixels they were stored with.

    Args:
        view: of the session.
        path: of a dataset of images.
        hint: what to do about the others.
        problems: to which one is added for each of the others.
    """
    images, checksums = view.dataset(path), view.read(checksums_of(path))  # masks of schema 1.0 have none
    if images is None:
        return
    for index in range(len(images)):
        where = f"{path}[{index}]"
        try:
            image = images[index]
        except READ_ERRORS as error:
            problems.append(Problem(where, f"cannot be decompressed ({error})", hint))
            continue
        if checksums is not None and index < len(checksums) and checksum(image) != int(checksums[index]):
            problems.append(Problem(where, "the pixels do not match their checksum", hint))
            continue
        yield index, image
