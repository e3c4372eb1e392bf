"""Folders of sessions: those that users are shown, and those that only tests read."""

from __future__ import annotations


def session_folder(root, name):
    """The folder of an example; or of a session that is none, for it could not be measured."""
    own = root / "tests/sessions" / name
    return own if own.is_dir() else root / "examples" / name


def files_of(folder):
    """Contents of all files of a folder, by their paths within it."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
