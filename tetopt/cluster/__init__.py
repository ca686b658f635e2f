"""Dask's workers, here or on a cluster, and the tasks that they are given."""
