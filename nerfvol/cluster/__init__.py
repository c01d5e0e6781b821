"""Work shared by several machines through Dask ``distributed`` (the extra ``nerfvol[cluster]``), imported only when asked for."""
