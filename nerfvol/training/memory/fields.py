"""The memory of a field, as the product or as what another model begins with, and of a medium."""

from __future__ import annotations

from nerfvol.config.field import FieldConfig
from nerfvol.config.medium import MediumConfig
from nerfvol.datasets.dataset import Dataset
from nerfvol.defaults import WHITE
from nerfvol.field.layout import layers_of
from nerfvol.training.backgrounds import second_background
from nerfvol.training.memory.base import BASE_BYTES, gib

FIELD_BYTES = 310 << 20
"""torch, the code that it compiles and what the training of a field leaves behind: measured."""
DISTILL_BYTES = 290 << 20
"""Next to the field, the images and their pixels over the background (3 bytes each): an octree of candidates before
and after leaves were merged (0.9 million for lego)."""
BYTES_PER_LIT_PIXEL = 28
"""Per training pixel of a medium: a ray (six float32) and four bytes."""
BYTES_PER_LIT_SAMPLE = 80
"""Per step along a ray of a medium, looked up or not: position, thickness, transmittance, and what torch keeps of them."""


def distillation_bytes(dataset: Dataset, backgrounds: int, held_out_bytes: int) -> int:
    """Bytes, next to the program, while a field is trained and distilled: images, and their pixels before each background."""
    pixels = sum(camera.intrinsics.width * camera.intrinsics.height for camera in dataset.cameras)
    return dataset.nbytes + 3 * backgrounds * pixels + held_out_bytes + DISTILL_BYTES


def field_backgrounds(config: FieldConfig, dataset: Dataset) -> int:
    """The backgrounds, one or two, that a field sees the pictures of ``dataset`` before."""
    return 1 + (second_background(dataset, WHITE, len(dataset) <= config.few_views) is not None)


def field_memory(dataset: Dataset, config: FieldConfig, held_out_bytes: int) -> str:
    """The estimate of training a field that is the product, in words."""
    shape = config.shape
    pixels = sum(camera.intrinsics.width * camera.intrinsics.height for camera in dataset.cameras)
    images = (
        dataset.nbytes + 3 * field_backgrounds(config, dataset) * pixels // min(config.downscales) ** 2 + held_out_bytes
    )
    entries = shape.hash_levels * shape.hash_features << shape.log2_table if shape.encoding == "hash" else 0
    network = sum(layer.numbers for layer in layers_of(shape))
    field = 4 * 4 * (entries + network) + 4 * config.grid_resolution**3 * (1 + dataset.scene.n_shells)
    peak = BASE_BYTES + images + field
    return f"{gib(peak)} at its peak: images {gib(images)}, the field {gib(field)}, the program {gib(BASE_BYTES)}"


def medium_memory(dataset: Dataset, config: MediumConfig, held_out_bytes: int) -> str:
    """The estimate of fitting a medium, in words."""
    pixels = sum(camera.intrinsics.width * camera.intrinsics.height for camera in dataset.cameras)
    images = dataset.nbytes + BYTES_PER_LIT_PIXEL * pixels + held_out_bytes
    # Parameters, moments and gradients; sheared planes of up to four times as many vertices for each light
    medium = 4 * max(config.resolutions) ** 3 * (16 + 24 * config.lights)
    samples = BYTES_PER_LIT_SAMPLE * config.rays * round(2 * max(config.resolutions) / config.step_voxels)
    torch = 300 << 20
    peak = BASE_BYTES + torch + images + medium + samples
    return (f"{gib(peak)} at its peak: images {gib(images)}, the medium {gib(medium)}, samples {gib(samples)}, the program "
            f"{gib(BASE_BYTES + torch)}")  # fmt: skip
