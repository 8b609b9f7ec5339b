"""The first moments of the program: what is imported cannot keep Ctrl-C to itself."""

import os
import signal
import subprocess
import sys

import pytest

from pipeline.cli import start

NEEDS_A_FULL_DISK = pytest.mark.skipif(not os.path.exists("/dev/full"), reason="this system has no /dev/full")
# In place of the command line, a module that takes long to import and catches whatever is raised meanwhile.
PROGRAM = """
import sys, time
from pipeline.cli import start

class Slow:
    def find_spec(self, name, path, target=None):
        if name == "pipeline.cli.main":
            print("importing", flush=True)
            try:
                time.sleep(300)
            except BaseException:
                print("caught")

sys.modules.pop("pipeline.cli.main", None)
sys.meta_path.insert(0, Slow())
sys.argv = ["colorphase", "--help"]
start.main()
"""


@pytest.mark.skipif(os.name != "posix", reason="a terminal's Ctrl-C is a signal")
def test_ctrl_c_ends_the_program_while_it_is_imported():
    arguments = [sys.executable, "-c", PROGRAM]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        assert process.stdout.readline() == "importing\n"
        process.send_signal(signal.SIGINT)
        said, _ = process.communicate(timeout=60)
    assert (process.returncode, said) == (-signal.SIGINT, "")


def test_later_it_is_the_commands_own(monkeypatch):
    before, heard = signal.getsignal(signal.SIGINT), []
    monkeypatch.setattr("pipeline.cli.main.main", lambda: heard.append(signal.getsignal(signal.SIGINT)))
    start.main()
    assert heard == [before] and signal.getsignal(signal.SIGINT) == before


def test_linear_algebra_has_one_thread_unless_the_user_wants_more(monkeypatch):
    """NumPy reads these while it is imported; processes that the command starts inherit them."""
    monkeypatch.setattr("pipeline.cli.main.main", lambda: None)
    names = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
    for name in names:
        monkeypatch.setenv(name, "")  # restored afterwards
        monkeypatch.delenv(name)
    monkeypatch.setenv("MKL_NUM_THREADS", "3")
    start.main()
    assert [os.environ[name] for name in names] == ["1", "3", "1"]


def run(words, streams, folder):
    """Run a command whose standard streams a shell has closed or sent elsewhere."""
    program = f"import sys; from pipeline.cli.start import main; sys.argv = ['colorphase', *{words}]; main()"
    return subprocess.run(
        ["sh", "-c", f'exec "$0" -c "$1" {streams}', sys.executable, program],
        capture_output=True,
        text=True,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )


@NEEDS_A_FULL_DISK
@pytest.mark.parametrize("streams", [">/dev/full", ">&-", "<&- >&-"])
@pytest.mark.parametrize("words", [["--version"], ["--help"], ["verify", "--help"], ["settings", "s.toml"]])
def test_a_result_that_cannot_be_written_is_one_line(tmp_path, words, streams):
    done = run(words, streams, tmp_path)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (1, "", 1)
    assert done.stderr.startswith("error: cannot write to standard output: ")
    assert "settings" not in words or (tmp_path / "s.toml").read_text().startswith("#")


@NEEDS_A_FULL_DISK
@pytest.mark.parametrize(
    ("words", "streams", "code"),
    [
        (["--version"], ">&- 2>&-", 1),
        (["--version"], "2>&-", 0),
        (["settings", "s.toml"], ">&- 2>&-", 1),
        (["settings", "s.toml"], ">/dev/full 2>/dev/full", 1),
        (["settings", "s.toml"], "<&- 2>&-", 0),
        (["verify", "none"], "2>&-", 1),
        (["verify", "--none"], "2>/dev/full", 1),
    ],
)
def test_without_standard_error_the_exit_code_tells(tmp_path, words, streams, code):
    done = run(words, streams, tmp_path)
    assert (done.returncode, done.stderr, bool(done.stdout)) == (code, "", code == 0)
    assert "settings" not in words or (tmp_path / "s.toml").read_text().startswith("#")


@NEEDS_A_FULL_DISK
def test_a_remark_that_cannot_be_written_ends_nothing():
    program = "from pipeline.cli.console import remark, say; remark('a'); say('b')"
    with open("/dev/full", "w") as full:
        done = subprocess.run([sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=full, text=True)
    assert (done.returncode, done.stdout) == (0, "b\n")
