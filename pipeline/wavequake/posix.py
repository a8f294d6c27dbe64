"""What only POSIX systems have: locks of files, limits and the memory of processes.

Stores are safe by these locks. Where they are missing, commands that need none work on; what imports this
module ends with a sentence.
"""

import sys

from wavequake.errors import UserError

try:
    import fcntl as fcntl
    import resource as resource
except ModuleNotFoundError as error:
    raise UserError(
        f"this needs Linux or macOS (Python's module {error.name}, which locks stores, is missing); on "
        "Windows run Wavequake in WSL (`wsl --install`); info, draw, new and studies work without"
    ) from None

_MAXRSS_PER_MB = 2**20 if sys.platform == "darwin" else 2**10


def peak_memory_mb() -> float:
    """Return the most memory that this process has held so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / _MAXRSS_PER_MB
