"""What every estimate of memory has: the program itself, how much of the machine may be planned for, bytes in words."""

from __future__ import annotations

BASE_BYTES = 160 << 20
"""The interpreter with numpy and Pillow (45 MiB resident), the kernels' records of a step, and what the allocator keeps: what
runs have at their peak next to the arrays that the other files count."""
SHARE = 0.9
"""Of the memory at hand that a run may plan for."""


def gib(size: int) -> str:
    """Bytes in GiB with two digits."""
    return f"{size / 2**30:.2f} GiB"
