"""Run the command line as ``python -m wavequake``."""

from wavequake.cli import main

main()
