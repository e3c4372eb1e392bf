"""Folders of sessions: those that users are shown, and those that only tests read."""

from __future__ import annotations


def session_folder(root, name):
    """The folder of an example; or of a session that is none, for it could not be measured."""
    own = root / "tests/sessions" / name
    return own if own.is_dir() else root / "examples" / name
