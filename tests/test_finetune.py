"""Coarse to fine: when leaves go and when they are split."""

from nerfvol.datasets import load_dataset
from nerfvol.finetune import OctreeConfig, OctreeTrainer


def test_nothing_is_pruned_before_it_could_become_visible(tiny_scene):
    """A thin start needs steps: however few the tiles and however short the stage, pruning waits for them."""
    config = OctreeConfig(
        levels=[4, 5], downscales=[4, 2], until=[0.001, 1.0], tiles=[4, 4], prunes=[1, 1], prune_steps=12
    )
    tuner = OctreeTrainer(load_dataset(tiny_scene, "train"), (1, 1, 1), config, 0, None)
    leaves = tuner.octree.n_leaves
    for _ in range(12):
        tuner.step(0.5)
        assert tuner.octree.n_leaves == leaves and tuner.stage == 0
    tuner.step(0.5)
    assert tuner.prunings == 1 and tuner.octree.n_leaves < leaves


def test_splitting_stays_within_the_memory(tiny_scene, capsys):
    """Where memory allows fewer leaves than a stage wants, it splits those with the largest error, and says so."""
    config = OctreeConfig(
        levels=[4, 5], downscales=[2, 1], until=[0.01, 1.0], tiles=[16, 16], prunes=[0, 0], prune_steps=4
    )
    tuner = OctreeTrainer(load_dataset(tiny_scene, "train"), (1, 1, 1), config, 0, None)
    tuner.max_leaves = 6000
    for _ in range(9):
        tuner.step(0.5)
    assert tuner.stage == 1 and tuner.octree.n_leaves <= 6000
    assert "memory allows 6,000 leaves" in capsys.readouterr().out
