"""Models of finite-element programs: matrices, coordinates and node sets from their files."""

from wavequake.mechanics.importers.model import Imported, ImportedModel, import_model, load_model

__all__ = ["Imported", "ImportedModel", "import_model", "load_model"]
