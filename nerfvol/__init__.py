"""nerfvol: from posed photographs to a sparse octree radiance field, on an ordinary CPU."""

__version__ = "0.1.0"
