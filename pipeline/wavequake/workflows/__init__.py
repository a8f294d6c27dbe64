"""Study files, the case table, the Dask engine, the store, and the workflows themselves.

``engine`` runs and keeps the cases of any workflow, which ``contract`` describes; ``statistics`` judges what
is kept. ``segments``, ``mirrors``, ``systems``, ``exposures`` and ``lens`` hold the workflows.
"""
