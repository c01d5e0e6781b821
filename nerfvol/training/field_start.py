"""Which trainer a field gets: that of the compiled kernels, or the one in torch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from nerfvol.config.field import FieldConfig
from nerfvol.errors import InputError
from nerfvol.native import need_torch
from nerfvol.training.compiled_field import CompiledFieldTrainer, compiled_refusal
from nerfvol.training.field_phase import domain_of, near_plane_of

if TYPE_CHECKING:
    from nerfvol.datasets.dataset import Dataset
    from nerfvol.training.field_trainer import FieldTrainer


def make_field_trainer(
    dataset: Dataset, config: FieldConfig, seed: int = 0, background: Sequence[float] = (1.0, 1.0, 1.0)
) -> FieldTrainer | CompiledFieldTrainer:
    """The trainer of a field that an octree is made of: by the compiled kernels where they can, else in torch; arguments as of
    both."""
    if (refused := compiled_refusal(config)) is not None:
        need_torch(f"a field that the kernels do not train ({refused})")
        from nerfvol.training.field_trainer import FieldTrainer

        return FieldTrainer(dataset, config, seed, background)
    domain = domain_of(dataset.scene)
    return CompiledFieldTrainer(dataset, domain, config, seed, background, near_plane_of(domain))


def make_final_trainer(
    dataset: Dataset, config: FieldConfig, seed: int, background: Sequence[float]
) -> CompiledFieldTrainer:
    """The trainer of a field that is the product; InputError where the kernels, which draw it later, cannot train it."""
    if (refused := compiled_refusal(config)) is not None:
        raise InputError(f"--representation field trains by the compiled kernels alone: {refused}")
    domain = domain_of(dataset.scene)
    return CompiledFieldTrainer(dataset, domain, config, seed, background, near_plane_of(domain), final=True)
