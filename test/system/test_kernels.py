"""The machine code: all of it made ahead, kept where that is possible, and no slower where not."""

import os
import shutil
import signal
import stat
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest
from support.paths import ROOT

from hybrid_ins import kernels, parameters
from hybrid_ins.bags.reader import BagReader
from hybrid_ins.bags.writer import BagWriter
from hybrid_ins.cli import simulate
from hybrid_ins.core import compilation
from hybrid_ins.replay import replay

LOADED = """
import numpy as np
from hybrid_ins import kernel_cache
kernel_cache.enable()
from hybrid_ins.core.imu.straight_line import no_line
from hybrid_ins.ros.estimator import imu_admission
one = np.ones((1, 3))
imu_admission.end_of_stretch(np.arange(1), one, one, 0, 0, 1, 2, 9.0, 9.0, *no_line())
stats = imu_admission.end_of_stretch.stats
print(sum(stats.cache_hits.values()), sum(stats.cache_misses.values()))
"""


def compilations() -> Counter[str]:
    """Return how often each kernel of the core was compiled by this process."""
    return Counter(
        {
            f"{kernel.py_func.__module__}.{kernel.py_func.__qualname__}": sum(
                kernel.stats.cache_misses.values()
            )
            for kernel in compilation.KERNELS
            if kernel.py_func.__module__.startswith("hybrid_ins.core")
        }
    )


@pytest.mark.slow
def test_nothing_is_compiled_once_the_filter_runs(tmp_path: Path) -> None:
    """GIVEN all kernels WHEN a flight with everything in it is smoothed THEN none is added."""
    kernels.prepare(parts=kernels.OFFLINE)
    before = compilations()
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
        estimator = replay(source, out, parameters.defaults(), smooth=True)

    assert estimator.reporter.fixes_fused > 100
    assert compilations() - before == Counter()


WITHOUT_HEIGHTS = """
import math
from support.drive import KNOWN, Drive
from hybrid_ins import kernels
from hybrid_ins.core import compilation

class Flat(Drive):
    def fix(self, k):
        self.fix_lla[k, 2] = math.nan
        super().fix(k)

def signatures():
    return {(kernel.py_func.__qualname__, *kernel.signatures) for kernel in compilation.KERNELS}

kernels.prepare()
Drive(**KNOWN).play(0.0, 6.0)
before = signatures()
drive = Flat(**KNOWN)
drive.play(0.0, 6.0)
assert drive.estimator.reporter.fixes_fused > 10
print(*sorted(name for name, *_ in signatures() - before))
"""


def test_fixes_without_heights_use_the_same_machine_code() -> None:
    """GIVEN all kernels WHEN altitudes are NaN THEN a node does not stop to compile another."""
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_HEIGHTS],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'test'}"},
    )

    assert (done.stdout.strip(), done.stderr) == ("", "")


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
    (package / "__pycache__").touch()
    return package.parent


def run(site: Path, home: Path) -> tuple[int, int]:
    """Run a kernel in another process; return how often it was loaded, and compiled."""
    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    done = subprocess.run(
        [sys.executable, "-c", LOADED],
        capture_output=True,
        text=True,
        check=False,
        cwd=home,
        timeout=250,
        env=environment
        | {"PYTHONPATH": str(site), "HOME": str(home), "XDG_CACHE_HOME": str(home / "cache")},
    )
    assert done.returncode == 0, done.stderr
    loaded, compiled = map(int, done.stdout.split())
    return loaded, compiled


@pytest.mark.slow
def test_a_read_only_installation_compiles_once(installed: Path, tmp_path: Path) -> None:
    """GIVEN no right to write WHEN started twice THEN the second loads what the first kept."""
    home = tmp_path / "home"
    home.mkdir()

    assert run(installed, home) == (0, 1)
    assert list((home / "cache" / "hybrid_ins").rglob("*.nbc"))
    assert not list(installed.rglob("*.nbc"))
    assert run(installed, home) == (1, 0)


def test_a_changed_source_is_compiled_anew(tmp_path: Path) -> None:
    """Another text of any kernel's module takes another directory."""
    name = "from hybrid_ins import kernel_cache; print(kernel_cache.enable())"
    package = tmp_path / "hybrid_ins"
    shutil.copytree(ROOT / "hybrid_ins", package, ignore=shutil.ignore_patterns("__pycache__"))

    def cache() -> Path:
        printed = subprocess.run(
            [sys.executable, "-c", name],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=True,
            env=os.environ | {"PYTHONPATH": str(tmp_path)},
        ).stdout
        return Path(printed.strip())

    before = cache()
    with (package / "core" / "earth.py").open("a") as file:
        file.write("\n# another text\n")

    assert cache() != before


def test_importing_kernels_touches_no_file(tmp_path: Path) -> None:
    package = tmp_path / "hybrid_ins"
    shutil.copytree(ROOT / "hybrid_ins", package, ignore=shutil.ignore_patterns("__pycache__"))
    before = sorted(tmp_path.rglob("*"))
    modules = ("kernels", "core.navigator.navigator", "ros.estimator.estimator")
    code = "import " + ", ".join(f"hybrid_ins.{module}" for module in modules)

    subprocess.run(
        [sys.executable, "-B", "-c", code],
        cwd=tmp_path,
        check=True,
        env=os.environ | {"PYTHONPATH": str(tmp_path), "HOME": str(tmp_path)},
    )

    assert sorted(tmp_path.rglob("*")) == before


def trusted(place: Path) -> bool:
    code = (
        "from hybrid_ins import kernel_cache; from pathlib import Path; "
        f"raise SystemExit(not kernel_cache._make_private(Path({str(place)!r})))"
    )
    return subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0


@pytest.mark.slow
def test_only_a_directory_of_ones_own_is_trusted_among_temporary_files(tmp_path: Path) -> None:
    made, open_to_all, link = tmp_path / "made", tmp_path / "open", tmp_path / "link"
    open_to_all.mkdir()
    open_to_all.chmod(0o777)

    assert trusted(made) and stat.S_IMODE(made.stat().st_mode) == 0o700
    assert trusted(made)
    link.symlink_to(made)
    assert not trusted(open_to_all)
    assert not trusted(link)


def of_cache(directory: Path) -> list[int]:
    """Processes whose machine code is kept in ``directory``."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if f"NUMBA_CACHE_DIR={directory}\0".encode() in (process / "environ").read_bytes():
                found.append(int(process.name))
        except OSError:
            continue
    return found


def until(condition: Callable[[], bool], patience: float = 60.0) -> None:
    end = time.monotonic() + patience
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


@pytest.mark.parametrize(
    "number",
    [
        signal.SIGINT,
        *(pytest.param(n, marks=pytest.mark.slow) for n in (signal.SIGTERM, signal.SIGKILL)),
    ],
)
def test_a_compilation_is_announced_once_and_ends_with_who_started_it(
    number: signal.Signals, tmp_path: Path
) -> None:
    # GIVEN two processes on an empty cache
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONUNBUFFERED": "1"}
    command = [sys.executable, "-m", "hybrid_ins.kernels"]
    outputs = [tmp_path / "first.txt", tmp_path / "second.txt"]
    started = []
    for output in outputs:
        with output.open("w") as file:
            started.append(
                subprocess.Popen(command, cwd=ROOT, env=environment, stdout=file, stderr=file)
            )
        until(lambda output=output: bool(output.read_text()))
    # THEN one compiles, by two children, and the other waits and says so
    assert outputs[0].read_text().strip() == kernels.COMPILING
    assert outputs[1].read_text().strip() == kernels.WAITING
    until(lambda: len(of_cache(tmp_path)) == 4)
    # WHEN the one that waits is ended THEN the other goes on
    started[1].send_signal(number)
    assert started[1].wait(20.0) != 0
    assert started[0].poll() is None
    # WHEN that is ended, too THEN nothing is left of them
    started[0].send_signal(number)
    assert started[0].wait(60.0) != 0
    until(lambda: not of_cache(tmp_path))
