"""Look for garbage seldom in the process that workers are forked from, and never among what it has loaded.

It loads this first. Modules live on: going through all their objects again and again took a tenth of the time
to load them, and would give every worker a copy of the memory that it shares with the others.
"""

import gc
import os

gc.set_threshold(50_000)
os.register_at_fork(before=gc.freeze)
