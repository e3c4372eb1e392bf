"""The entry of the command line: Ctrl-C ends it while it is still being loaded, too."""

from __future__ import annotations

from orthocal.interrupts import ending_at_interrupt


def main() -> None:
    """Load the command line, and run it."""
    with ending_at_interrupt():
        from orthocal.cli import main as run
    run()


if __name__ == "__main__":
    main()
