"""Resolve the dependencies of a wheel for each platform and Python that it promises: `python .ci/platforms.py WHEEL`.

pip's own resolver does it. With `--platform` and `--python-version` pip selects wheels for another machine, but still
evaluates markers for this one, and `Requires-Python` for the Python that runs it; this program states the other's.
"""

import subprocess
import sys

# Names of wheels' platforms, oldest systems last; the values of markers.
PLATFORMS = {
    "Linux x86-64": (
        [f"manylinux_2_{glibc}_x86_64" for glibc in (36, 34, 31, 28, 27, 24, 17, 12, 5)],
        "linux",
        "x86_64",
    ),
    "Linux aarch64": ([f"manylinux_2_{glibc}_aarch64" for glibc in (36, 34, 31, 28, 27, 24, 17)], "linux", "aarch64"),
    "macOS 14 arm64": (["macosx_14_0_arm64"], "darwin", "arm64"),
    "Windows x86-64": (["win_amd64"], "win32", "AMD64"),
}
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
LIMIT_S = 600

_PIP = """
import sys
from pip._vendor.packaging import markers

system, machine, python = sys.argv[1:4]
here = markers.default_environment
there = {
    "sys_platform": system, "platform_machine": machine, "python_version": python, "python_full_version": python + ".0",
    "platform_system": {"linux": "Linux", "darwin": "Darwin", "win32": "Windows"}[system],
    "os_name": "nt" if system == "win32" else "posix",
}
markers.default_environment = lambda: {**here(), **there}
from pip._internal.cli.req_command import RequirementCommand
make = RequirementCommand.make_resolver.__func__
version = (*map(int, python.split(".")), 0)
RequirementCommand.make_resolver = classmethod(lambda *given, **named: make(*given, **named, py_version_info=version))
from pip._internal.cli.main import main
sys.exit(main(sys.argv[4:]))
"""


def resolve(wheel: str, platform: str, python: str) -> str:
    """Return what pip would install, or raise `subprocess.CalledProcessError`."""
    tags, system, machine = PLATFORMS[platform]
    options = [word for tag in tags for word in ("--platform", tag)]
    options += [
        "--python-version",
        python,
        "--only-binary",
        ":all:",
        "--dry-run",
        "--ignore-installed",
        "--target",
        ".",
    ]
    program = [sys.executable, "-c", _PIP, system, machine, python, "install", "--disable-pip-version-check", *options]
    done = subprocess.run([*program, wheel], capture_output=True, text=True, timeout=LIMIT_S, check=False)
    if done.returncode != 0:
        conflict = done.stdout.partition("The conflict is caused by:")[2]
        errors = [line for line in done.stderr.splitlines() if line.startswith("ERROR")]
        raise RuntimeError("\n".join([*errors, *conflict.strip().splitlines()]))
    return next(line for line in reversed(done.stdout.splitlines()) if line.startswith("Would install"))


def main(wheel: str) -> None:
    """Resolve for all, and exit with 1 where one cannot be."""
    failed = False
    for platform in PLATFORMS:
        for python in PYTHONS:
            try:
                names = resolve(wheel, platform, python).split()[2:]
                print(f"{platform}, Python {python}: {len(names)} packages", flush=True)
            except RuntimeError as error:
                failed = True
                print(f"{platform}, Python {python}: {error}", flush=True)
    sys.exit(failed)


if __name__ == "__main__":
    main(sys.argv[1])
