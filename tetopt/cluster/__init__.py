"""Dask workers, here or on a cluster, and their tasks."""
