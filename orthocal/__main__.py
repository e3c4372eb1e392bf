"""Entry point of the command line, which Ctrl-C ends even while it is being loaded."""

from __future__ import annotations

import gc

from orthocal.runtime.interrupts import ending_at_interrupt

GARBAGE_THRESHOLD = 400_000
"""New objects before a garbage collection: loading libraries creates many permanent ones."""


def main() -> None:
    """Load and run the command line."""
    gc.set_threshold(GARBAGE_THRESHOLD, *gc.get_threshold()[1:])
    with ending_at_interrupt():
        from orthocal.cli import main as run
    try:
        run()
    finally:
        gc.freeze()  # no collection when the process ends


if __name__ == "__main__":
    main()
