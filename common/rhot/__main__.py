"""The program `rhot`; `python -m rhot` is the same."""

from __future__ import annotations

import sys


def run() -> None:
    """Run the command line; a Ctrl-C while its modules load ends it like any other, without a traceback."""
    try:
        from rhot.cli import main  # noqa: PLC0415  # so that loading it is inside the block
    except KeyboardInterrupt:
        sys.exit(130)
    main()


if __name__ == "__main__":
    run()
