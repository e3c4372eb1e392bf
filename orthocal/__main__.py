"""The entry of the command line: Ctrl-C ends it while it is still being loaded, too."""

from __future__ import annotations

import gc

from orthocal.runtime.interrupts import ending_at_interrupt

FEWEST_OBJECTS = 100_000
"""New ones before garbage is looked for: loading libraries makes many, all of which stay."""


def main() -> None:
    """Load the command line, and run it."""
    gc.set_threshold(FEWEST_OBJECTS, *gc.get_threshold()[1:])
    with ending_at_interrupt():
        from orthocal.cli import main as run
    try:
        run()
    finally:
        gc.freeze()  # of what goes with the process nothing is looked through for garbage first


if __name__ == "__main__":
    main()
