"""Where a dataset's images are: in memory, or in their files until somebody asks for them again."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import overload

from nerfvol.datasets.images import UInt8


class ImageStore(Sequence[UInt8]):
    """A sequence of ``count`` images, uint8 (h, w, 3 or 4), that ``read`` decodes: when first asked for, and again after
    :meth:`release`. In between they are kept.

    ``images``: those already decoded, where there are such.
    """

    def __init__(self, count: int, read: Callable[[], list[UInt8]], images: list[UInt8] | None = None) -> None:
        self._count, self._read, self._images = count, read, images

    def get(self) -> list[UInt8]:
        """All images, each uint8 (h, w, 3 or 4); InputError where the files can no longer be read."""
        if self._images is None:
            self._images = self._read()
        return self._images

    def release(self) -> None:
        """Give up the images' memory until they are asked for again."""
        self._images = None

    @property
    def nbytes(self) -> int:
        """Bytes held now; 0 after :meth:`release`."""
        return sum(image.nbytes for image in self._images or ())

    def __len__(self) -> int:
        return self._count

    @overload
    def __getitem__(self, index: int) -> UInt8: ...
    @overload
    def __getitem__(self, index: slice) -> list[UInt8]: ...
    def __getitem__(self, index: int | slice) -> UInt8 | list[UInt8]:
        return self.get()[index]

    def __iter__(self) -> Iterator[UInt8]:
        return iter(self.get())


class Corrected(Sequence[UInt8]):
    """Another sequence's images, each through ``change(index, image)`` when it is asked for; nothing is kept."""

    def __init__(self, images: Sequence[UInt8], change: Callable[[int, UInt8], UInt8]) -> None:
        self._images, self._change = images, change

    def __len__(self) -> int:
        return len(self._images)

    @overload
    def __getitem__(self, index: int) -> UInt8: ...
    @overload
    def __getitem__(self, index: slice) -> list[UInt8]: ...
    def __getitem__(self, index: int | slice) -> UInt8 | list[UInt8]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        return self._change(index, self._images[index])

    def __iter__(self) -> Iterator[UInt8]:
        return (self[i] for i in range(len(self)))
