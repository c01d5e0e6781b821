"""The sparse octree: vertex rows, topology, the tree, its field at points, level of detail, files."""

from nerfvol.octree.tree import Octree

__all__ = ["Octree"]
