"""Write the HTML report of a store, into its folder or a file, and return the file.

The package of reports (tables for the terminal, figures, HTML pages, exports) can be called, as
`wavequake.doors.studies.report`, since its name is that of a function for users.

Examples
--------
>>> import wavequake as wq
>>> wq.report("runs/tmt-segments-1a2b3c4d")  # doctest: +SKIP
"""

import sys
from pathlib import Path
from types import ModuleType


class _Report(ModuleType):
    """The package, which can be called."""

    def __call__(self, store: str | Path, file: str | Path | None = None) -> Path:
        from wavequake.report.campaign import report_store

        return report_store(Path(store), None if file is None else Path(file))[1]


sys.modules[__name__].__class__ = _Report
