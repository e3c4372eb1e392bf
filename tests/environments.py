"""Clean environments: what a distribution declares, and nothing else."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from importlib.metadata import distribution
from importlib.util import cache_from_source
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name


def declared(requirements):
    """Distributions that requirements ask for, and theirs in turn, as they are installed here."""
    found, pending = {}, [(Requirement(text), "") for text in requirements]
    seen = set()
    while pending:
        requirement, extra = pending.pop()
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": extra}):
            continue
        own = distribution(requirement.name)
        assert requirement.specifier.contains(own.version, prereleases=True), str(requirement)
        name = canonicalize_name(requirement.name)
        found[name] = own
        for wanted in ("", *requirement.extras):
            if (name, wanted) not in seen:
                seen.add((name, wanted))
                pending += [(Requirement(text), wanted) for text in own.requires or ()]
    return list(found.values())


def make_environment(folder, distributions):
    """An environment with the files of distributions, by hard links where that can be; its Python.

    They come with what is compiled of them. What they have outside of their library folder, such as
    commands, is left out.
    """
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True)
    (library,) = folder.glob("lib/python*/site-packages")
    for own in distributions:
        files = [Path(file) for file in own.files or ()]
        compiled = [Path(cache_from_source(f)) for f in files if f.suffix == ".py"]
        for file in dict.fromkeys([*files, *compiled]):
            source, target = Path(own.locate_file(file)), library / file
            if ".." in file.parts or not source.exists():
                continue
            target.parent.mkdir(parents=True, exist_ok=True)
            try:
                os.link(source, target)
            except OSError:
                shutil.copy2(source, target)
    return folder / "bin/python"
