"""What training needs of the machine's memory, before it starts: an estimate, a refusal, or a bound on the octree.

The figures are sums of array sizes (docstrings say which), so they hold on any machine; tests compare them with what a
run really takes. One file for each representation: octree, splats, fields (a field or a medium).
"""

from nerfvol.training.memory.base import gib as gib
from nerfvol.training.memory.fields import field_backgrounds as field_backgrounds
from nerfvol.training.memory.fields import field_memory as field_memory
from nerfvol.training.memory.fields import medium_memory as medium_memory
from nerfvol.training.memory.octree import OctreePlan as OctreePlan
from nerfvol.training.memory.octree import splits_within as splits_within
from nerfvol.training.memory.splats import SURFACE_BYTES as SURFACE_BYTES
from nerfvol.training.memory.splats import photographs_bytes as photographs_bytes
from nerfvol.training.memory.splats import splat_memory as splat_memory
from nerfvol.training.memory.splats import starting_splats_bytes as starting_splats_bytes
from nerfvol.training.memory.splats import surface_leaves as surface_leaves
