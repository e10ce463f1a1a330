"""The machine code: all of it made ahead, kept where that is possible, and no slower where not."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from support.paths import ROOT

from hybrid_ins import kernels, parameters
from hybrid_ins.bags.reader import BagReader
from hybrid_ins.bags.writer import BagWriter
from hybrid_ins.cli import simulate
from hybrid_ins.core import compilation
from hybrid_ins.replay import replay

STEP = "from hybrid_ins import kernels; kernels._compile_output()"


def compiled() -> dict[str, int]:
    return {
        str(kernel.py_func.__qualname__) + kernel.py_func.__module__: len(kernel.signatures)
        for kernel in compilation.KERNELS
        if kernel.py_func.__module__.startswith("hybrid_ins.core")
    }


def test_nothing_is_compiled_once_the_filter_runs(tmp_path: Path) -> None:
    """GIVEN all kernels WHEN a flight with everything in it is replayed THEN none is added."""
    kernels.prepare()
    before = compiled()
    bag = tmp_path / "flight.mcap"
    assert (
        simulate.main(
            [
                str(bag),
                "--duration",
                "30",
                "--imu-rate",
                "200",
                "--gnss-velocity",
                "--outage",
                "15",
                "8",
            ]
        )
        == 0
    )

    with BagReader(bag) as source, BagWriter(tmp_path / "out.mcap") as out:
        estimator = replay(source, out, parameters.defaults())

    assert estimator.fixes_fused > 100
    assert min(before.values()) >= 1
    assert compiled() == before


def test_no_kernel_needs_a_linear_algebra_library() -> None:
    """SciPy's would take longer to load than everything else that starts."""
    text = (
        "import sys; from hybrid_ins import kernels; kernels.prepare(); "
        "sys.exit('scipy.linalg' in sys.modules)"
    )

    assert subprocess.run([sys.executable, "-c", text], cwd=ROOT, check=False).returncode == 0


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """A copy of the package without machine code, and where none can be kept, not even by root."""
    package = tmp_path / "site" / "hybrid_ins"
    shutil.copytree(ROOT / "hybrid_ins", package, ignore=shutil.ignore_patterns("__pycache__"))
    (package / "core" / "__pycache__").touch()
    return package.parent


def run(site: Path, home: Path) -> float:
    """Compile or load in another process; CPU seconds it took."""
    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    before = os.times()
    done = subprocess.run(
        [sys.executable, "-c", STEP],
        capture_output=True,
        text=True,
        check=False,
        cwd=home,
        timeout=250,
        env=environment
        | {"PYTHONPATH": str(site), "HOME": str(home), "XDG_CACHE_HOME": str(home / "cache")},
    )
    assert done.returncode == 0, done.stderr
    after = os.times()
    return after.children_user - before.children_user


def test_a_read_only_installation_compiles_once(installed: Path, tmp_path: Path) -> None:
    """GIVEN no right to write WHEN started twice THEN the second loads what the first kept."""
    home = tmp_path / "home"
    home.mkdir()

    first = run(installed, home)
    second = run(installed, home)

    assert list((home / "cache" / "hybrid_ins").rglob("*.nbc"))
    assert not list(installed.rglob("*.nbc"))
    assert second < 0.5 * first


def test_a_changed_source_is_compiled_anew(tmp_path: Path) -> None:
    """Another text of any kernel's module takes another directory."""
    name = "import sys; from hybrid_ins.core import compilation; print(compilation.CACHE.name)"
    package = tmp_path / "hybrid_ins"
    shutil.copytree(ROOT / "hybrid_ins", package, ignore=shutil.ignore_patterns("__pycache__"))

    def cache() -> str:
        return subprocess.run(
            [sys.executable, "-c", name],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=True,
            env=os.environ | {"PYTHONPATH": str(tmp_path)},
        ).stdout

    before = cache()
    with (package / "core" / "earth.py").open("a") as file:
        file.write("\n# another text\n")

    assert cache() != before
    assert not list(package.rglob(before.strip()))
