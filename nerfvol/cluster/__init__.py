"""Work shared by several machines through Dask ``distributed``: the extra ``nerfvol[cluster]``, imported when asked for."""
