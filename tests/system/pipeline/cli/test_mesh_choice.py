"""The options of a mesh's part, on the command line."""

from cyclopts import App

from pipeline.cli.export import MeshChoice
from pipeline.output.surface_mesh import MeshOptions


def parsed(*words: str) -> MeshOptions:
    app = App(result_action="return_value")

    @app.default
    def take(part: MeshChoice = MeshChoice()) -> MeshOptions:  # noqa: B008 - it is frozen
        return part.options()

    return app(list(words))


def test_left_out_nothing_is_left_out():
    assert parsed() == MeshOptions()


def test_each_option_is_one_of_a_mesh():
    crop = ("--crop", "-1", "2", "3", "4", "5", "6")
    assert parsed(*crop, "--no-background", "--triangles", "9", "--no-smooth") == MeshOptions(
        smoothed=False, crop_mm=(-1, 2, 3, 4, 5, 6), without_background=True, max_triangles=9
    )
