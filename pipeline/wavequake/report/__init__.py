"""Reports: tables for the terminal, figures, HTML pages, exports.

`wavequake.report` is a function for users, too: `wavequake.doors.studies.report`.
"""

import sys
from pathlib import Path
from types import ModuleType


class _Report(ModuleType):
    """The package, which can be called."""

    def __call__(self, store: str | Path) -> Path:
        from wavequake.report.campaign import report_store

        return report_store(Path(store))[1]


sys.modules[__name__].__class__ = _Report
