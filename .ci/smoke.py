"""Smoke tests on other Pythons and other versions of what orthocal depends on.

Runs `tests/test_smoke.py` and the symbolic kinematics in environments of their own: on the oldest
and the newest Python of this machine that orthocal supports with the newest releases and the extra
`fast` (except the Python that runs this file, on which the whole suite runs), and on the oldest
with the lowest versions that pyproject.toml allows.

Needs `uv`, which is installed into the environment of the Python that runs this file.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
OLDEST = (3, 11)
TESTS = ["tests/test_smoke.py", "tests/kinematics/test_symbolic.py"]
ASK_VERSION = "import sys; print(*sys.version_info[:2])"


def find_pythons() -> dict[tuple[int, int], Path]:
    """Interpreters on the PATH and of pyenv that start and that orthocal supports, by version."""
    versions = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    directories = [Path(p) for p in os.environ["PATH"].split(os.pathsep)]
    directories += [p / "bin" for p in sorted(versions.glob("*"))]
    pythons: dict[tuple[int, int], Path] = {}
    for directory in directories:
        for file in sorted(directory.glob("python3.*")):
            if not re.fullmatch(r"python3\.\d+", file.name):
                continue
            asked = subprocess.run([file, "-c", ASK_VERSION], capture_output=True, text=True)
            if asked.returncode == 0:
                major, minor = map(int, asked.stdout.split())
                if (major, minor) >= OLDEST:
                    pythons.setdefault((major, minor), file)
    return pythons


def run(command: list[str | Path], *, env: dict[str, str] | None = None) -> str:
    """What a command prints, on both streams."""
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    return subprocess.run(command, check=True, text=True, cwd=ROOT, env=env, **streams).stdout


def run_lane(python: Path, *, resolution: str) -> str:
    """Install orthocal into a new environment, run the smoke tests there, and return the report."""
    uv = [sys.executable, "-m", "uv", "--quiet"]
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="orthocal-smoke-") as directory:
        environment = Path(directory) / "environment"
        inside = environment / "bin/python"
        run([*uv, "venv", "--python", python, environment])
        install = [*uv, "pip", "install", "--python", inside, "--resolution", resolution]
        tools = ["pytest>=8.0", "pytest-timeout>=2.3"]
        extra = "[fast]" if resolution == "highest" else ""
        run([*install, "--editable", f"{ROOT}{extra}", *tools])
        cache = {**os.environ, "ORTHOCAL_CACHE": str(Path(directory) / "cache")}
        # beside the whole suite, with lower priority, a test may wait as long as the suite takes;
        # Python shows no user the deprecations within libraries
        options = "-q --timeout=1800 -p no:cacheprovider -W ignore::DeprecationWarning".split()
        said = run([inside, "-m", "pytest", *options, *TESTS], env=cache)
    return f"{said}{python} with {resolution} versions: {time.monotonic() - began:.0f} s"


def main() -> None:
    """Run all lanes, one on each core; the exit code is that of the first that fails."""
    pythons = find_pythons()
    lanes = [(min(pythons), "lowest-direct")]
    tested = sys.version_info[:2]
    lanes += [(v, "highest") for v in sorted({min(pythons), max(pythons)} - {tested})]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        running = [pool.submit(run_lane, pythons[v], resolution=r) for v, r in lanes]
        for lane in running:
            print(lane.result(), flush=True)


if __name__ == "__main__":
    try:
        main()
    except subprocess.CalledProcessError as error:
        print(error.stdout, error, sep="\n", file=sys.stderr)
        sys.exit(error.returncode)
