"""Run the command line as ``wavequake`` or ``python -m wavequake``."""

import signal
import sys


def main() -> None:
    """Run the command line, which takes a moment to load; SIGTERM ends it as Ctrl-C does."""
    # What ends a job on a cluster is to it what Ctrl-C is at a terminal.
    signal.signal(signal.SIGTERM, lambda number, frame: signal.raise_signal(signal.SIGINT))
    try:
        from wavequake.cli import main as command_line
    except KeyboardInterrupt:
        print("Interrupted before anything was begun; to start: the same command again.", file=sys.stderr)
        sys.exit(130)
    command_line()


if __name__ == "__main__":
    main()
