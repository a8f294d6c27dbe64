"""Where PoCL cannot write its cache it offers no device, and does not say why: give it a folder then."""

import atexit
import os
import shutil
import tempfile
from pathlib import Path


def ensure_cache() -> None:
    """Have PoCL keep its programs in a folder of this process, if its own cannot be written."""
    own = os.environ.get("POCL_CACHE_DIR")
    try:
        above = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        folder = Path(own) if own else above / "pocl"
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return
    except (OSError, RuntimeError):  # RuntimeError: there is no home
        spare = tempfile.mkdtemp(prefix="wavequake-pocl-")
        os.environ["POCL_CACHE_DIR"] = spare
        atexit.register(shutil.rmtree, spare, ignore_errors=True)
