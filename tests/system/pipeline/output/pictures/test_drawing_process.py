"""A child process that dies, hangs or complains, and what is said of it."""

import pytest

from pipeline.errors import RenderError
from pipeline.output.pictures import drawing_process
from pipeline.output.pictures.drawing_process import PictureJob, PictureOptions, draw_apart

JOB = PictureJob(options=PictureOptions(), mesh="mesh.ply", numbers=(0,))


def run(monkeypatch, folder, program, **options):
    monkeypatch.setattr(drawing_process, "COMMAND", ["-c", program])
    return draw_apart(JOB, folder, **{"timeout_s": 60.0, **options})


@pytest.mark.parametrize(
    ("program", "said"),
    [
        (
            "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)",
            "apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri",
        ),
        ("raise SystemExit('libGL.so.1: cannot open shared object file')", "libosmesa6"),
        ("raise SystemExit(0)", "OpenGL"),
        ("raise ValueError('the moon is in the way')", "^cannot draw: ValueError: the moon is in the way$"),
        (
            "from pipeline.errors import RenderError; raise RenderError('choose another frame')",
            "^cannot draw: choose another frame$",
        ),
    ],
)
def test_a_child_that_dies_is_told_in_one_line(tmp_path, monkeypatch, program, said):
    with pytest.raises(RenderError, match=said) as caught:
        run(monkeypatch, tmp_path, program)
    assert "\n" not in str(caught.value)


def test_a_child_that_hangs_is_given_up(tmp_path, monkeypatch):
    with pytest.raises(RenderError, match=r"more than 0\.5 s: .*libosmesa6"):
        run(monkeypatch, tmp_path, "import time; time.sleep(60)", timeout_s=0.5)


def test_what_a_child_says_is_heard_and_libraries_are_not(tmp_path, monkeypatch):
    program = (
        "import os; print('a library says hello'); print('{\"part\": 3}'); print('[1]');"
        "print('{\"renderer\": \"' + os.environ['LP_NUM_THREADS'] + ' threads\"}'); open('done', 'x')"
    )
    heard = []
    monkeypatch.delenv("LP_NUM_THREADS", raising=False)
    assert run(monkeypatch, tmp_path, program, notify=heard.append, threads=1) == "0 threads"
    assert heard == [{"part": 3}, {"renderer": "0 threads"}]


def test_a_second_library_is_tried_where_the_first_one_fails(tmp_path, monkeypatch):
    monkeypatch.delenv("VTK_DEFAULT_OPENGL_WINDOW", raising=False)
    program = "import os, sys; open('done', 'x') if 'VTK_DEFAULT_OPENGL_WINDOW' in os.environ else os.abort()"
    assert run(monkeypatch, tmp_path, program) == "an unknown renderer"
