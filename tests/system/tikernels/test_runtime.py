"""Starting devices, and every module's own examples."""

import doctest
import importlib
import os
import pkgutil
import subprocess
import sys

import numpy as np
import pytest

import colorphase
import tikernels
from tikernels import DeviceNotReady, runtime

MODULES = sorted(module.name for module in pkgutil.walk_packages(tikernels.__path__, "tikernels."))


def test_examples(cpu):
    given = {"colorphase": colorphase, "np": np}
    failed = [name for name in MODULES if doctest.testmod(importlib.import_module(name), extraglobs=given).failed]
    assert not failed


def test_a_named_arch_is_what_runs(arch):
    assert runtime.started() == arch
    assert tikernels.init("auto") == arch  # keeps what runs
    assert tikernels.init(arch) == arch


def test_buffers_come_and_go(arch):
    host = np.arange(12, dtype=np.float32).reshape(3, 4)
    buffer = runtime.to_device(host)
    assert tuple(buffer.shape) == (3, 4)
    assert runtime.is_device_array(buffer) == (arch != "cpu")
    np.testing.assert_array_equal(runtime.to_host(buffer), host)
    assert tuple(runtime.empty((2, 5), np.uint8).shape) == (2, 5)


def test_what_lay_on_another_arch_is_gone(cpu):
    runtime.require("cpu")
    with pytest.raises(DeviceNotReady, match="cpu has been started since, and what lay on vulkan is gone"):
        runtime.require("vulkan")


def test_the_cpu_is_always_there():
    assert tikernels.supported_archs()[-1] == "cpu"


def test_an_unknown_arch_is_refused():
    with pytest.raises(
        tikernels.DeviceNotReady, match=r"no arch is called 'gpu': choose auto, cpu, cuda, metal, vulkan"
    ):
        tikernels.init("gpu")


@pytest.mark.parametrize("threads", [0, -3, 100_000])
def test_a_number_of_threads_that_ends_processes_is_refused(threads):
    with pytest.raises(DeviceNotReady, match=f"cpu_threads is {threads}: give a number from 1 to 1024"):
        tikernels.init("cpu", cpu_threads=threads)


def run(program: str, environment: dict[str, str] | None = None) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", program]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)


def test_a_missing_arch_is_one_line():
    missing = next(name for name in ("metal", "cuda") if name not in tikernels.supported_archs())
    done = run(
        "import tikernels\n"
        f"try: tikernels.init('{missing}')\n"
        "except tikernels.DeviceNotReady as error: print(error)\n"
        "print(tikernels.runtime.is_started(), tikernels.init('cpu'))"
    )
    message, after = done.stdout.splitlines()
    assert message.startswith(f"{missing} cannot be started here ({missing}: ")
    assert message.endswith("`colorphase devices` lists what can")
    assert after == "False cpu"
    assert done.stderr == ""


def test_nothing_takes_the_place_of_a_named_arch_that_could_not_be_started():
    done = run(
        "import sys, numpy as np, tikernels\n"
        "try: tikernels.init('cuda' if sys.platform == 'darwin' else 'metal')\n"
        "except tikernels.DeviceNotReady: pass\n"
        "image = np.zeros((4, 4, 3), np.float32)\n"
        "phase, mask = image[..., 0].copy(), image[..., 0] == 0\n"
        "calls = {\n"
        "    'linearize': lambda: tikernels.linearize(image),\n"
        "    'correct_crosstalk': lambda: tikernels.correct_crosstalk(image, np.eye(3)),\n"
        "    'balance_color': lambda: tikernels.balance_color(image, 12),\n"
        "    'compute_wrapped_phase': lambda: tikernels.compute_wrapped_phase(image),\n"
        "    'equalize_phase': lambda: tikernels.equalize_phase(phase, mask),\n"
        "    'smooth_phase': lambda: tikernels.smooth_phase(phase, mask),\n"
        "    'unwrap_phase': lambda: tikernels.unwrap_phase(phase, phase, mask),\n"
        "    'correct_fringe_order': lambda: tikernels.correct_fringe_order(phase, mask),\n"
        "    'triangulate_mesh': lambda: tikernels.triangulate_mesh(phase, mask, mask.view(np.uint8)),\n"
        "}\n"
        "for name, call in calls.items():\n"
        "    try: call()\n"
        "    except tikernels.DeviceNotReady as error: print(name, error)\n"
    )
    lines = done.stdout.splitlines()
    assert len(lines) == 9, done.stderr
    assert all("could not be started: call tikernels.init with another arch, or with auto" in line for line in lines)


def test_starting_a_device_asks_no_server(tmp_path):
    """Taichi asks one on its first day on a machine, from a thread of its own."""
    program = (
        "import threading, urllib.request\n"
        "asked = []\n"
        "urllib.request.urlopen = lambda *given, **more: asked.append(given)\n"
        "import tikernels\n"
        "tikernels.init('cpu')\n"
        "for thread in threading.enumerate():\n"
        "    if thread is not threading.current_thread(): thread.join(10)\n"
        "print(asked)\n"
    )
    environment = os.environ | {"HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path)}
    environment.pop("TI_SKIP_VERSION_CHECK", None)
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
    assert done.stdout.splitlines()[-1:] == ["[]"], done.stderr


def test_the_first_call_starts_a_device_where_none_is():
    done = run(
        "import numpy as np, tikernels\n"
        "from tikernels import runtime\n"
        "before, image = runtime.is_started(), np.zeros((4, 4, 3), np.float32)\n"
        "print(before, tikernels.linearize(image).shape, runtime.is_started())\n"
    )
    assert done.stdout.splitlines()[-1] == "False (4, 4, 3) True", done.stderr


KERNELS_ARE_KEPT = """
import pathlib, sys
import numpy as np
import colorphase
import tikernels
from tikernels import runtime

tikernels.init("cpu")
tikernels.smooth_phase(np.zeros((8, 8), np.float32), np.ones((8, 8), bool), 3)
assert runtime.is_started() and not any(pathlib.Path(sys.argv[1]).rglob("*.tic"))
runtime.stop()
assert not runtime.is_started() and any(pathlib.Path(sys.argv[1]).rglob("*.tic"))
runtime.stop()
tikernels.smooth_phase(np.zeros((8, 8), np.float32), np.ones((8, 8), bool), 3)
"""


@pytest.mark.skipif(runtime.kernel_language() != "taichi", reason="the kernels' files have another name elsewhere")
def test_the_end_keeps_kernels_on_the_disk(tmp_path):
    """Before the process ends, and once for all; what comes after starts the device again."""
    environment = os.environ | {"TI_OFFLINE_CACHE_FILE_PATH": str(tmp_path)}
    command = [sys.executable, "-c", KERNELS_ARE_KEPT, str(tmp_path)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


LINEARIZE = """
import tempfile
def nowhere(*given, **more): raise FileNotFoundError("no folder")
if {nowhere}: tempfile.mkdtemp = nowhere
import numpy as np, tikernels
print(tikernels.linearize(np.zeros((4, 4, 3), np.float32)).shape)
"""


@pytest.mark.skipif(os.name == "nt", reason="its users always have a home")
@pytest.mark.parametrize("nowhere", [False, True])
@pytest.mark.parametrize(
    "folders",
    [
        {},
        {"HOME": ""},
        {"HOME": "{folder}", "XDG_CACHE_HOME": "cache"},
        {"HOME": "{file}"},
        {"HOME": "{folder}", "XDG_CACHE_HOME": "{file}"},
        {"HOME": "{folder}", "TI_OFFLINE_CACHE_FILE_PATH": "{file}", "QD_OFFLINE_CACHE_FILE_PATH": "{file}"},
    ],
    ids=["no home", "an empty home", "a relative cache", "a file as home", "a file as cache", "a file as kernels"],
)
def test_without_a_cache_kernels_are_compiled(tmp_path, folders, nowhere):
    (tmp_path / "file").touch()
    (tmp_path / "temporary").mkdir()
    environment = {name: value for name, value in os.environ.items() if not name.endswith(("HOME", "CACHE_FILE_PATH"))}
    environment |= {name: value.format(file=tmp_path / "file", folder=tmp_path) for name, value in folders.items()}
    done = run(LINEARIZE.format(nowhere=nowhere), environment | {"TMPDIR": str(tmp_path / "temporary")})
    assert (done.returncode, done.stdout) == (0, "(4, 4, 3)\n"), done.stderr
    assert "compiled kernels are not kept, so that each start takes long: set XDG_CACHE_HOME" in done.stderr
    assert not list((tmp_path / "temporary").iterdir())


@pytest.mark.parametrize(
    ("variable", "value"),
    [
        *(("TI_CPU_MAX_NUM_THREADS", value) for value in ("nonsense", "0", "-3", "100000", "1.5")),
        *(("TI_ARCH", value) for value in ("opengl", "", "cpu", "riscv")),
        *(("TI_DEBUG", value) for value in ("nonsense",)),
    ],
)
def test_an_environment_that_no_device_can_start_in_is_told_in_one_line(variable, value):
    variable = variable if runtime.kernel_language() == "taichi" else variable.replace("TI_", "QD_")
    done = run(
        "import tikernels\ntry: tikernels.init('auto')\nexcept tikernels.DeviceNotReady as error: print(error)\n",
        os.environ | {variable: value},
    )
    assert done.returncode == 0 and done.stdout.count("\n") == 1, done.stderr
    assert done.stdout.startswith("auto cannot be started here (") and repr(value) in done.stdout
    assert done.stdout.count("TI_CPU") == (variable == "TI_CPU_MAX_NUM_THREADS"), "what is so for all is said once"


FORKED = """
import multiprocessing, os, sys
import numpy as np, tikernels
from tikernels import runtime

def work(number):
    try:
        tikernels.linearize(np.zeros((4, 4, 3), np.float32))
    except tikernels.DeviceNotReady as error:
        return str(error)

assert work(0) is None
with runtime.lock:  # which nobody in the child lets go
    pool = multiprocessing.get_context("fork").Pool(1)
with pool:
    print(pool.map(work, [1])[0])
child = os.fork()
if child == 0:
    sys.exit("start processes by spawn" not in work(2))
assert os.waitpid(child, 0)[1] == 0 and work(3) is None
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system forks no processes")
def test_a_process_forked_from_a_started_device_launches_nothing():
    """It ends as any other, and its parent goes on."""
    done = run(FORKED)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("this process was forked from one in which a device had been started")


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system forks no processes")
def test_a_process_forked_before_may_start_one():
    done = run(FORKED.replace("assert work(0) is None\n", "").replace(" and work(3) is None", ""))
    assert done.stdout == "None\n", done.stderr
