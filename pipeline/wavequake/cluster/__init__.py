"""Where Dask runs."""
