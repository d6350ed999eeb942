"""Where work is done: processes of this computer, a Dask cluster, jobs of a Slurm cluster; one seam for all of them."""
