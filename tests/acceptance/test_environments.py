"""Environments that developers never have: a run is merely slower in them, or says in one line what is missing."""

import os
import shutil
import subprocess
import sys

import pytest
from support.recorded_footage import contents, record

resource = pytest.importorskip("resource", reason="this system limits no processes")

PROGRAM = "import sys; from pipeline.cli.start import main; sys.argv[0] = 'colorphase'; main()"
#: Becomes a user without a name, who may read everything, as Python may lie in another user's home.
FOREIGN = ["setpriv", "--reuid=54321", "--regid=54321", "--clear-groups"]
FOREIGN += [f"--{kind}-caps=+dac_read_search" for kind in ("inh", "ambient")]
NOT_KEPT = "warning: compiled kernels are not kept, so that each start takes long: set XDG_CACHE_HOME"


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    """Return a folder that everybody may write to, with footage that is worth two processes."""
    folder = tmp_path_factory.mktemp("film")
    record(folder / "film.zarr", 66)
    for place in (folder, *folder.parents[:3]):
        place.chmod(0o777)
    return folder


def decode(film, out, environment=None, words=(), foreign=False, limits=None, **options):
    """Decode footage in an environment; without `foreign` kernels are those that tests keep."""

    def limit():
        for kind, most in (limits or {}).items():
            resource.setrlimit(kind, (most, most))

    command = [*(FOREIGN if foreign else []), sys.executable, "-c", PROGRAM, "decode", "film.zarr", "--out", out]
    command += ["--arch", "cpu", "--fields", "mask", "range_image", *(words or ("--stop", "1"))]
    environment = {"PYTHONPATH": os.pathsep.join(sys.path), **(os.environ if environment is None else environment)}
    done = subprocess.run(
        command, cwd=film, env=environment, preexec_fn=limit, capture_output=True, text=True, timeout=240, **options
    )
    assert "Traceback" not in done.stderr, done.stderr
    return done


def without_a_cache(**more):
    """Return an environment without a home, and without the kernels that tests keep."""
    kept = {name: value for name, value in os.environ.items() if not name.endswith(("HOME", "CACHE_FILE_PATH"))}
    return {**kept, **more}


@pytest.fixture(scope="module")
def expected(film):
    decode(film, "usual")
    return contents(film / "usual" / "result.zarr")


def can_be_foreign():
    if os.geteuid() != 0 or shutil.which("setpriv") is None:
        return False
    return subprocess.run([*FOREIGN, sys.executable, "-c", "import numpy"], capture_output=True).returncode == 0


AS_FOREIGN = pytest.mark.skipif(not can_be_foreign(), reason="only root becomes another user")


@pytest.mark.parametrize("foreign", [False, pytest.param(True, marks=AS_FOREIGN)])
def test_no_home(film, tmp_path, foreign):
    """As systemd's services and containers have it; the processes that a run starts share what one compiles."""
    temporary = film / f"temporary {foreign}"
    temporary.mkdir()
    temporary.chmod(0o777)
    out = f"homeless {foreign}"
    done = decode(film, out, without_a_cache(TMPDIR=str(temporary)), ("--workers", "2"), foreign=foreign)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count(NOT_KEPT) == 1
    assert len(list((film / out / "result.zarr" / "mask").glob("c.*"))) == 66
    assert not list(temporary.glob("colorphase*"))


@pytest.mark.parametrize(
    "environment",
    [
        {"TMPDIR": "/nowhere"},
        {"LANG": "C", "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
        {"PYTHONOPTIMIZE": "1"},
        {"COLUMNS": "nonsense", "TERM": ""},
    ],
    ids=["no folder for temporary files", "no locale", "no assertions", "no terminal"],
)
def test_the_result_is_the_same(film, expected, environment, request):
    out = request.node.callspec.id
    done = decode(film, out, {**os.environ, **environment})
    assert done.returncode == 0, done.stderr
    assert contents(film / out / "result.zarr") == expected


@pytest.mark.parametrize(
    ("limits", "umask", "said"),
    [
        ({resource.RLIMIT_NOFILE: 40}, -1, None),
        ({}, 0o077, None),
        ({resource.RLIMIT_FSIZE: 1000}, -1, "files may not be as large there: choose another disk, or raise your"),
        ({resource.RLIMIT_AS: 2**30}, -1, "error: "),
    ],
    ids=["files", "umask", "length of files", "memory"],
)
def test_low_limits(film, expected, request, limits, umask, said):
    out = request.node.callspec.id
    done = decode(film, out, limits=limits, umask=umask)
    if said is None:
        assert done.returncode == 0, done.stderr
        assert contents(film / out / "result.zarr") == expected
    else:
        assert done.returncode == 1 and said in done.stderr.splitlines()[-1]


@AS_FOREIGN
@pytest.mark.parametrize(
    ("limits", "umask", "said"),
    [
        ({resource.RLIMIT_NPROC: 1}, -1, "error: the system starts no more threads: raise your limit (ulimit -u)"),
        ({}, 0o777, "the folder is not writable: choose another one"),
    ],
    ids=["threads", "umask"],
)
def test_limits_that_no_root_has(film, request, limits, umask, said):
    done = decode(film, f"foreign {request.node.callspec.id}", foreign=True, limits=limits, umask=umask)
    assert done.returncode == 1 and said in done.stderr.splitlines()[-1]


FORKED = """
import multiprocessing, sys
from pipeline import Decoder, DecodeSettings
from pipeline.errors import DecodeWarning
from pipeline.simulation import simulate_frame, simulated_rig
import warnings
warnings.simplefilter("ignore", DecodeWarning)

decoder = Decoder(DecodeSettings(), arch="cpu")
image = simulate_frame(simulated_rig((128, 96), period_px=2 * 768 / 44)).image

def decode(number):
    return int(decoder.decode(image).mask.sum())

before = decode(0)
with multiprocessing.get_context("fork").Pool(2) as pool:
    try:
        pool.map(decode, range(4))
    except RuntimeError as error:
        print(error)
sys.exit(decode(0) != before)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system forks no processes")
def test_a_pool_of_forks_is_refused_at_once():
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", FORKED]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "start processes by spawn" in done.stdout
