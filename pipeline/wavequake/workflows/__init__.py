"""Study files, the case table, the Dask engine, the store, and the workflows themselves."""
